"""Pictures to train on: painted ones, kept in files, and folders of pairs."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from pipeline.attention.samples import coverage_of_pair
from pipeline.drops.backgrounds import sample_background
from pipeline.drops.pairs import sample_pair
from pipeline.errors import UserError
from pipeline.io.atomic import write_bytes
from pipeline.io.images import PHOTO_SUFFIXES, read_photo

CHUNK = 100
SIZE = 256
KINDS = ("rainy", "clean", "coverage")
# Rainy (H,W,3), clean (H,W,3) and coverage (H,W), all uint8, in the same order.
Pictures = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]


def paint_chunk(path: Path, seed: int, chunk: int) -> None:
    """Writes a hundred painted pairs, each from a generator of its own, unless they exist."""
    if path.is_file():
        return
    parts: Pictures = ([], [], [])
    for k in range(CHUNK):
        rng = np.random.default_rng([seed, chunk, k])
        clean = sample_background(rng, SIZE)
        rainy, coverage = sample_pair(rng, clean)
        for part, picture in zip(parts, (rainy, clean, coverage), strict=True):
            part.append(np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8))
    buffer = io.BytesIO()
    np.savez(buffer, rainy=parts[0], clean=parts[1], coverage=parts[2])
    write_bytes(path, buffer.getvalue())


def read_chunk(path: Path) -> Pictures:
    """The pictures that `paint_chunk` wrote."""
    with np.load(path) as parts:
        return list(parts["rainy"]), list(parts["clean"]), list(parts["coverage"])


def read_rendered(folder: Path) -> Pictures:
    """Pairs of a renderer: folders rainy, clean and coverage (8-bit grey) with the same names.

    Raises UserError where a folder is empty, a partner is missing or the sizes differ.
    """
    pictures: Pictures = ([], [], [])
    for name in _names(folder / "rainy"):
        wet, dry, cover = (_partner(folder / kind / name) for kind in KINDS)
        _same_size(folder / "rainy" / name, wet, dry, cover)
        for part, picture in zip(pictures, (wet, dry, cover[..., 0]), strict=True):
            part.append(picture)
    return pictures


def read_photo_pairs(folder: Path) -> Pictures:
    """Pairs of photos in the published layout: data/N_rain.png and gt/N_clean.png.

    Their coverage is where they differ; see samples.coverage_of_pair. Raises UserError where the
    folder is empty, a partner is missing or the sizes differ.
    """
    pictures: Pictures = ([], [], [])
    for name in _names(folder / "data"):
        wet = _partner(folder / "data" / name)
        dry = _partner(folder / "gt" / name.replace("_rain", "_clean"))
        _same_size(folder / "data" / name, wet, dry)
        for part, picture in zip(pictures, (wet, dry, coverage_of_pair(wet, dry)), strict=True):
            part.append(picture)
    return pictures


def _partner(path: Path) -> np.ndarray:
    if not path.is_file():
        raise UserError(f"{path} does not exist.", "Every rainy picture needs its partners.")
    return read_photo(path)[0]


def _same_size(path: Path, *pictures: np.ndarray) -> None:
    if len({picture.shape for picture in pictures}) > 1:
        raise UserError(f"{path} and its partners differ in size.", "Crop them to the same view.")


def _names(folder: Path) -> list[str]:
    found = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    names = sorted(name for name in found if Path(name).suffix.lower() in PHOTO_SUFFIXES)
    if not names:
        raise UserError(f"{folder} holds no images.", "weights/README.md tells the layouts.")
    return names
