"""A place of three textured planes, drawn exactly by their homographies, and cameras before it."""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np

from pipeline.geometry.cameras import intrinsic_matrix
from pipeline.geometry.trajectory import look_at

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
# Left, right (in metres at the plane), depth: the nearer planes hide the wall behind them.
PLANES = ((-4.0, 4.0, 5.0), (-1.7, -0.2, 3.6), (0.4, 1.5, 2.9))
TEXELS = 420


@functools.cache
def texture(seed: int) -> np.ndarray:
    """Blobs of several sizes (TEXELS, TEXELS, 3), something for every octave of a detector."""
    random = np.random.default_rng(seed)
    total = np.zeros((TEXELS, TEXELS, 3), np.float32)
    for cells in (12, 30, 70):
        noise = random.random((cells, cells, 3), dtype=np.float32)
        total += cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC) / 3
    return np.clip((total - 0.5) * 2.2 + 0.5, 0, 1)


@functools.cache
def masonry(seed: int, courses: int = 14) -> np.ndarray:
    """Courses of bricks, each of its own shade (TEXELS, TEXELS, 3): what walls look like."""
    random = np.random.default_rng(seed)
    wall = np.full((TEXELS, TEXELS, 3), 0.62, np.float32)
    high, wide = TEXELS // courses, 2 * TEXELS // courses
    for row in range(courses):
        for column in range(-1, courses // 2):
            left = column * wide + (row % 2) * wide // 2
            shade = np.array([0.5, 0.4, 0.34]) + random.normal(0, 0.13) + random.normal(0, 0.02, 3)
            wall[row * high + 2 : (row + 1) * high, max(left + 2, 0) : max(left + wide, 0)] = shade
    grain = random.normal(0, 0.05, (TEXELS, TEXELS, 1)).astype(np.float32)
    return np.clip(wall + grain, 0, 1)


def draw(
    cam_from_world: np.ndarray, scale: int = 2, cover: Callable[[int], np.ndarray] = texture
) -> np.ndarray:
    """The picture (HEIGHT, WIDTH, 3) that a camera takes of the planes, `scale` x supersampled.

    cover: what is on the planes, (TEXELS, TEXELS, 3) in [0, 1], by their number.
    """
    picture = np.zeros((HEIGHT * scale, WIDTH * scale, 3), np.float32)
    camera = intrinsic_matrix(FOCAL * scale, FOCAL * scale, WIDTH * scale / 2, HEIGHT * scale / 2)
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # pixel centres lie at .5
    for index, (left, right, depth) in enumerate(PLANES):
        step = (right - left) / TEXELS
        plane = np.array([[step, 0, left], [0, step, -step * TEXELS / 2], [0, 0, depth], [0, 0, 1]])
        to_pixel = camera @ cam_from_world[:3] @ plane
        warp = np.linalg.inv(half) @ to_pixel @ half
        size = (picture.shape[1], picture.shape[0])
        drawn = cv2.warpPerspective(cover(index), warp, size, flags=cv2.INTER_LINEAR)
        inside = cv2.warpPerspective(np.ones((TEXELS, TEXELS), np.float32), warp, size)[..., None]
        picture = picture * (1 - inside) + drawn * inside
    return cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def camera_at(x: float, y: float, z: float = 0.0) -> np.ndarray:
    """(4, 4) cam_from_world of a camera there that looks at the planes."""
    return look_at(np.array([x, y, z]), np.array([0.2 * x, 0.1, 3.8]), np.array([0.0, 1.0, 0.0]))
