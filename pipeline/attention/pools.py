"""Pictures to train on: painted ones, kept in files, and folders of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.attention.samples import Pool, coverage_of_pair
from pipeline.drops import stills
from pipeline.drops.backgrounds import sample_background
from pipeline.drops.pairs import Kind, sample_shots
from pipeline.errors import UserError
from pipeline.io.atomic import write_npy
from pipeline.io.images import PHOTO_SUFFIXES, as_bytes, read_photo, shrink

CHUNK = 100
SIZE = 256
PHOTO_SHARE = 0.7
KINDS = ("rainy", "clean", "coverage")
# Rainy (H,W,3), clean (H,W,3) and coverage (H,W), all uint8, in the same order.
Pictures = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]


def paint_chunk(
    path: Path, seed: int, chunk: int, photos: tuple[Path, ...] = (), kind: Kind = "drops"
) -> None:
    """Writes a hundred painted pictures, each from a generator of its own, unless they exist.

    photos: clean photographs; PHOTO_SHARE of the backgrounds are crops of them, the others are
    procedural. kind: see pairs.sample_shots. One array (100,256,256,7) uint8: rainy, clean, coverage.
    """
    if path.is_file():
        return
    pictures = np.empty((CHUNK, SIZE, SIZE, 7), np.uint8)
    for k in range(CHUNK):
        rng = np.random.default_rng([seed, chunk, k])
        shots = sample_shots(rng, background(rng, photos), kind=kind)
        stacked = np.dstack(shots)
        pictures[k] = as_bytes(stacked)
    write_npy(path, pictures)


def painted_name(seed: int, photos: Sequence[Path], kind: Kind = "drops") -> str:
    """A name for pictures painted from this seed and these photos, whatever folder they lie in."""
    name = "painted" if kind == "drops" else kind
    return stills.painted_name(name, seed, photos, "attention/pools.py")


def painted_chunks(
    work: Path, seed: int, count: int, photos: tuple[Path, ...], kind: Kind = "drops"
) -> dict[str, tuple[Path, int, int, tuple[Path, ...], Kind]]:
    """What `paint_chunk` needs for the first `count` pictures, below `work`, by the chunk's name."""
    folder = work / painted_name(seed, photos, kind)
    names = [f"{k:04d}" for k in range(-(-count // CHUNK))]
    return {name: (folder / f"{name}.npy", seed, int(name), photos, kind) for name in names}


def background(rng: np.random.Generator, photos: Sequence[Path]) -> np.ndarray:
    """A clean picture (256,256,3) in [0,1]: a crop of a photo at any scale, or a procedural one."""
    if not photos or rng.random() >= PHOTO_SHARE:
        return sample_background(rng, SIZE)
    photo = stills.still(photos[int(rng.integers(len(photos)))])
    shortest = min(photo.shape[:2])
    # From detail at full size to a whole photo made small, as if seen from further away.
    side = round(float(np.exp(rng.uniform(np.log(min(0.6 * SIZE, shortest)), np.log(shortest)))))
    top, left = (int(rng.integers(length - side + 1)) for length in photo.shape[:2])
    crop = photo[top : top + side, left : left + side].astype(np.float32) / 255
    how = cv2.INTER_AREA if side > SIZE else cv2.INTER_CUBIC
    crop = cv2.resize(crop, (SIZE, SIZE), interpolation=how)
    if rng.random() < 0.5:
        crop = crop[:, ::-1]
    crop = crop * np.exp(rng.normal(0, 0.2)) * rng.uniform(0.92, 1.08, 3)
    return np.clip(crop, 0, 1).astype(np.float32)


def read_chunk(path: Path) -> Pictures:
    """The pictures that `paint_chunk` wrote, left in the file until they are looked at."""
    pictures = np.load(path, mmap_mode="r")
    return (
        [picture[..., :3] for picture in pictures],
        [picture[..., 3:6] for picture in pictures],
        [picture[..., 6] for picture in pictures],
    )


def list_pictures(folder: Path) -> tuple[Path, ...]:
    """The pictures of a folder in name order; UserError where there are none."""
    return tuple(folder / name for name in _names(folder))


def read_rendered(folder: Path) -> Pictures:
    """Pairs of a renderer: folders rainy, clean and coverage (8-bit grey) with the same names.

    Larger ones are shrunk to stills.LONGEST pixels on their longest side, as the photos are that drops
    are painted on. Raises UserError where a folder is empty, a partner is missing or the sizes differ.
    """
    pictures: Pictures = ([], [], [])
    for name in _names(folder / "rainy"):
        partners = [folder / kind / name for kind in KINDS]
        wet, dry, cover = _of_one_view(*partners)
        for part, picture in zip(pictures, (wet, dry, cover[..., 0]), strict=True):
            part.append(picture)
    return pictures


def read_by_name(folders: Sequence[Path], *others: str) -> dict[str, Pictures]:
    """`read_rendered` of each folder, under its last name, which a validation curve tells it by.

    UserError where two folders have one name, or one has that of another set.
    """
    names = [*(folder.name for folder in folders), *others]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise UserError(
            f"Two validation sets are called {twice[0]}; the curve would show one of them.",
            "Rename a folder of train_detector.validation_rendered; `painted` is the painted set.",
        )
    return {folder.name: read_rendered(folder) for folder in folders}


def read_photo_pairs(folder: Path) -> Pictures:
    """Pairs of photos in the published layout: data/N_rain.png and gt/N_clean.png.

    Their coverage is where they differ, once shrunk as in `read_rendered`; see samples.coverage_of_pair.
    Raises UserError where the folder is empty, a partner is missing or the sizes differ.
    """
    pictures: Pictures = ([], [], [])
    for name in _names(folder / "data"):
        partner = folder / "gt" / name.replace("_rain", "_clean")
        wet, dry = _of_one_view(folder / "data" / name, partner)
        for part, picture in zip(pictures, (wet, dry, coverage_of_pair(wet, dry)), strict=True):
            part.append(picture)
    return pictures


def aimed(pictures: Pictures, target: str) -> Pictures:
    """The pictures with, in place of the coverage, what is to be found in them.

    target: `coverage`, the water itself; `difference`: 255 where it changes a colour by more than 30 of
    255, as the masks of published photo pairs are made, see samples.coverage_of_pair.
    """
    if target == "coverage":
        return pictures
    rainy, clean, coverage = pictures
    seen = [
        np.where(cover > 0, coverage_of_pair(wet, dry), 0).astype(np.uint8)
        for wet, dry, cover in zip(rainy, clean, coverage, strict=True)
    ]
    return rainy, clean, seen


def together(parts: Sequence[Pictures], count: int | None = None) -> Pictures:
    """All pictures of the parts in order, or the first `count` of them."""
    whole: Pictures = ([], [], [])
    for part in parts:
        for kept, pictures in zip(whole, part, strict=True):
            kept.extend(pictures)
    return whole[0][:count], whole[1][:count], whole[2][:count]


def weighted(sources: Sequence[Pictures], shares: Sequence[float]) -> list[Pool]:
    """Pools of the sources that hold pictures and have a share above zero; UserError for none."""
    pools = [
        Pool(*source, share=share)
        for source, share in zip(sources, shares, strict=True)
        if source[0] and share > 0
    ]
    if not pools:
        raise UserError("There is nothing to train on.", "Raise train_detector.shares.")
    return pools


def _partner(path: Path) -> np.ndarray:
    if not path.is_file():
        raise UserError(f"{path} does not exist.", "Every rainy picture needs its partners.")
    return read_photo(path)[0]


def _of_one_view(*paths: Path) -> list[np.ndarray]:
    """The pictures of a view, rainy first: of one size, and none larger than clean stills are."""
    pictures = [_partner(path) for path in paths]
    if len({picture.shape for picture in pictures}) > 1:
        raise UserError(
            f"{paths[0]} and its partners differ in size.", "Crop them to the same view."
        )
    return [shrink(picture, stills.LONGEST) for picture in pictures]


def _names(folder: Path) -> list[str]:
    found = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    names = sorted(name for name in found if Path(name).suffix.lower() in PHOTO_SUFFIXES)
    if not names:
        raise UserError(f"{folder} holds no images.", "docs/detector.md tells the layouts.")
    return names
