"""The project's own code as something that what is kept may hang on."""

from __future__ import annotations

import hashlib
from pathlib import Path

PIPELINE = Path(__file__).parents[1]


def code_key(*places: str) -> str:
    """A digest of the code in folders and files of `pipeline/`: what other code began is begun anew.

    DVC runs a stage again when its code changes, but knows nothing of what a stage keeps for itself between
    runs. Raises FileNotFoundError where a place holds no code.
    """
    digest = hashlib.sha256()
    for place in places:
        path = PIPELINE / place
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        if not files:
            raise FileNotFoundError(path)
        for file in files:
            digest.update(file.relative_to(PIPELINE).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()
