"""Painted clips: drops that stay on the lens while what is behind them moves."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.drops import stills
from pipeline.drops.backgrounds import sample_background
from pipeline.drops.pairs import sample_shots
from pipeline.io.atomic import write_npy
from pipeline.io.images import as_bytes
from pipeline.removal.wen import FRAMES

CHUNK = 20
SIZE = 160
PHOTO_SHARE = 0.8


def pan(rng: np.random.Generator, still: np.ndarray, size: int) -> np.ndarray:
    """FRAMES views (T,size,size,3) of a picture (H,W,3) in [0,1], by a camera that moves across it.

    From one view to the next it goes 1 to 20 % of its view aside and up to 4 % nearer or farther.
    """
    height, width = still.shape[:2]
    shortest = min(height, width)
    side = float(np.exp(rng.uniform(np.log(0.35 * shortest), np.log(0.75 * shortest))))
    way = rng.uniform(0, 2 * np.pi)
    step = (
        np.exp(rng.uniform(np.log(0.01), np.log(0.2)))
        * side
        * np.array([np.cos(way), 0.5 * np.sin(way)])
    )
    zoom = np.exp(rng.uniform(-0.04, 0.04))
    sides = side * zoom ** (np.arange(FRAMES) - FRAMES // 2)
    free = np.array([width, height]) - sides.max()
    travel = step * np.minimum(1, 0.95 * free / np.maximum(np.abs(step) * (FRAMES - 1), 1e-9)).min()
    reach = travel * (FRAMES - 1)
    start = rng.uniform(np.maximum(0, -reach), free - np.maximum(0, reach))
    views = []
    for k in range(FRAMES):
        corner = start + k * travel + (sides.max() - sides[k]) / 2
        scale = sides[k] / size
        shift = corner + (scale - 1) / 2
        place = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
        source = cv2.GaussianBlur(still, (0, 0), 0.5 * scale) if scale > 1.3 else still
        views.append(
            cv2.warpAffine(source, place, (size, size),
                           flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                           borderMode=cv2.BORDER_REFLECT)
        )  # fmt: skip
    return np.clip(np.stack(views), 0, 1).astype(np.float32)


def paint_clip(
    rng: np.random.Generator, still: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rainy and dry frames (T,size,size,3) and their one coverage (size,size), all in [0,1].

    Pane, drops, camera and its noise are the same in every frame, only the view changes.
    """
    views = pan(rng, still, size)
    shots = [sample_shots(copy.deepcopy(rng), view) for view in views]
    return np.stack([s[0] for s in shots]), np.stack([s[1] for s in shots]), shots[0][2]


def paint_chunk(path: Path, seed: int, chunk: int, photos: tuple[Path, ...] = ()) -> None:
    """Writes CHUNK painted clips, each from a generator of its own, unless they exist.

    One array (CHUNK,2T+1,SIZE,SIZE,3) uint8: rainy frames, dry frames, coverage (three times).
    """
    if path.is_file():
        return
    clips = np.empty((CHUNK, 2 * FRAMES + 1, SIZE, SIZE, 3), np.uint8)
    for k in range(CHUNK):
        rng = np.random.default_rng([seed, chunk, k, 5])
        rainy, clean, coverage = paint_clip(rng, _still(rng, photos), SIZE)
        stacked = np.concatenate([rainy, clean, np.dstack([coverage] * 3)[None]])
        clips[k] = as_bytes(stacked)
    write_npy(path, clips)


def read_chunk(path: Path) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Rainy clips, dry clips and coverage that `paint_chunk` wrote, left in the file until looked at."""
    clips = np.load(path, mmap_mode="r")
    return (
        [clip[:FRAMES] for clip in clips],
        [clip[FRAMES : 2 * FRAMES] for clip in clips],
        [clip[-1, ..., 0] for clip in clips],
    )


def painted_name(seed: int, photos: Sequence[Path]) -> str:
    """A name for clips painted from this seed and these photos, whatever folder they lie in."""
    return stills.painted_name("clips", seed, photos, "removal/clips.py")


def painted_chunks(
    work: Path, seed: int, count: int, photos: tuple[Path, ...]
) -> dict[str, tuple[Path, int, int, tuple[Path, ...]]]:
    """What `paint_chunk` needs for the first `count` clips, below `work`, by the chunk's name."""
    folder = work / painted_name(seed, photos)
    names = [f"{k:04d}" for k in range(-(-count // CHUNK))]
    return {name: (folder / f"{name}.npy", seed, int(name), photos) for name in names}


def _still(rng: np.random.Generator, photos: Sequence[Path]) -> np.ndarray:
    """A picture (H,W,3) float32 in [0,1] to pan across: a photo, or a procedural one."""
    if not photos or rng.random() >= PHOTO_SHARE:
        return sample_background(rng, 3 * SIZE)
    return stills.still(photos[int(rng.integers(len(photos)))]).astype(np.float32) / 255
