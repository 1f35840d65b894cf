"""Clean photographs to paint drops on: kept while they are painted on, and named in what came of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.io.images import read_photo, shrink

LONGEST = 1200


@lru_cache(maxsize=256)
def still(path: Path) -> np.ndarray:
    """The photo (H,W,3) uint8, shrunk to LONGEST pixels on its longest side; read once per process."""
    return shrink(read_photo(path)[0], LONGEST)


def painted_name(kind: str, seed: int, photos: Sequence[Path]) -> str:
    """A name for what was painted from this seed and these photos, whatever folder they lie in."""
    digest = hashlib.sha256(str(seed).encode())
    for photo in photos:
        digest.update(photo.read_bytes())
    return f"{kind}-{digest.hexdigest()[:12]}"
