"""Dry pictures that are easily taken for wet ones: what a lens does to a photo without any drop."""

from __future__ import annotations

import cv2
import numpy as np

GAMMA = 2.2
CLIPPED = 0.85  # from here on a pixel may have been many times brighter than the photo can tell


def lure(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A dry picture (H,W,3) in [0,1], out of focus in part or whole, overexposed, or lights at night.

    Bright points out of focus become discs, as drops on the lens do; only their ground tells them apart.
    """
    kind = rng.random()
    if kind < 0.25:
        return overexposed(image, float(np.exp(rng.uniform(np.log(1.3), np.log(3.0)))))
    radius = float(np.exp(rng.uniform(np.log(1.5), np.log(12.0))))
    if kind < 0.4:
        return defocused(at_night(image, rng), radius)
    blurred = defocused(image, radius)
    if rng.random() < 0.4:
        return blurred
    near = _subject(image.shape[:2], rng)[..., None]
    return near * image + (1 - near) * blurred


def overexposed(image: np.ndarray, gain: float) -> np.ndarray:
    """The picture with `gain` times the light, cut off at white."""
    return np.minimum(image * np.float32(gain ** (1 / GAMMA)), 1).astype(np.float32)


def defocused(image: np.ndarray, radius: float) -> np.ndarray:
    """The picture (H,W,3) in [0,1] through a lens out of focus: discs of `radius` pixels, in linear light.

    What is nearly white is taken for up to four times as bright, so that lights become discs of their own.
    """
    light = np.power(np.clip(image, 0, 1), GAMMA)
    over = np.clip((image.min(axis=2, keepdims=True) - CLIPPED) / (1 - CLIPPED), 0, 1)
    size = 2 * int(np.ceil(radius)) + 1
    y, x = np.mgrid[:size, :size] - size // 2
    disc = np.clip(radius + 0.5 - np.hypot(y, x), 0, 1)
    spread = cv2.filter2D(
        light * (1 + 3 * over), -1, disc / disc.sum(), borderType=cv2.BORDER_REFLECT
    )
    return np.power(np.clip(spread, 0, 1), 1 / GAMMA).astype(np.float32)


def at_night(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The picture (H,W,3) in [0,1] darkened, with small lights in a few colours."""
    dark = image * np.float32(rng.uniform(0.15, 0.5))
    height, width = image.shape[:2]
    for _ in range(int(rng.integers(4, 30))):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        colour = np.clip(rng.uniform(0.5, 1.6) * (1 + rng.normal(0, 0.2, 3)), 0, 1)
        cv2.circle(dark, centre, int(rng.integers(1, 4)), colour.tolist(), -1)
    return dark


def _subject(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """1 where the picture is in focus, falling softly to 0: a side of it, or something round in it."""
    y, x = np.mgrid[: shape[0], : shape[1]] / max(shape) - rng.uniform(0.2, 0.8, 2)[:, None, None]
    angle = rng.uniform(0, 2 * np.pi)
    inside = x * np.cos(angle) + y * np.sin(angle)
    if rng.random() < 0.5:
        inside = rng.uniform(0.15, 0.4) - np.hypot(x, y)
    return np.clip(0.5 + inside / rng.uniform(0.02, 0.3), 0, 1).astype(np.float32)
