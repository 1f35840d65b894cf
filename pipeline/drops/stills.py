"""Clean photographs to paint drops on: kept while they are painted on, and named in what came of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.io.code import code_key
from pipeline.io.images import read_photo, shrink

LONGEST = 1200


@lru_cache(maxsize=256)
def still(path: Path) -> np.ndarray:
    """The photo (H,W,3) uint8, shrunk to LONGEST pixels on its longest side; read once per process."""
    return shrink(read_photo(path)[0], LONGEST)


def painted_name(kind: str, seed: int, photos: Sequence[Path], painter: str) -> str:
    """A name for what is painted from this seed and these photos, whatever folder they lie in.

    painter: the file of `pipeline/` that paints; other code there or in this room gives another name.
    """
    digest = hashlib.sha256(f"{seed} {code_key('drops', painter)}".encode())
    for photo in photos:
        digest.update(photo.read_bytes())
    return f"{kind}-{digest.hexdigest()[:12]}"
