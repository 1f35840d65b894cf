"""A scene with known cameras: three textured planes, drawn exactly by their homographies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.geometry.cameras import intrinsic_matrix
from pipeline.geometry.trajectory import look_at
from pipeline.io.images import write_image

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
# Left, right (in metres at the plane), depth: the nearer planes hide the wall behind them.
PLANES = ((-4.0, 4.0, 5.0), (-1.7, -0.2, 3.6), (0.4, 1.5, 2.9))
TEXELS = 420


@dataclass(frozen=True)
class Scene:
    """Image folder, names, true cam_from_world by name."""

    images: Path
    cams: dict[str, np.ndarray]

    @property
    def names(self) -> list[str]:
        return sorted(self.cams)


def texture(seed: int) -> np.ndarray:
    """Blobs of several sizes (TEXELS, TEXELS, 3), something for every octave of a detector."""
    random = np.random.default_rng(seed)
    total = np.zeros((TEXELS, TEXELS, 3), np.float32)
    for cells in (12, 30, 70):
        noise = random.random((cells, cells, 3), dtype=np.float32)
        total += cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC) / 3
    return np.clip((total - 0.5) * 2.2 + 0.5, 0, 1)


def draw(cam_from_world: np.ndarray, scale: int = 2) -> np.ndarray:
    """The picture (HEIGHT, WIDTH, 3) that a camera takes of the planes, `scale` x supersampled."""
    picture = np.zeros((HEIGHT * scale, WIDTH * scale, 3), np.float32)
    camera = intrinsic_matrix(FOCAL * scale, FOCAL * scale, WIDTH * scale / 2, HEIGHT * scale / 2)
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # pixel centres lie at .5
    for index, (left, right, depth) in enumerate(PLANES):
        step = (right - left) / TEXELS
        plane = np.array([[step, 0, left], [0, step, -step * TEXELS / 2], [0, 0, depth], [0, 0, 1]])
        to_pixel = camera @ cam_from_world[:3] @ plane
        warp = np.linalg.inv(half) @ to_pixel @ half
        size = (picture.shape[1], picture.shape[0])
        drawn = cv2.warpPerspective(texture(index), warp, size, flags=cv2.INTER_LINEAR)
        inside = cv2.warpPerspective(np.ones((TEXELS, TEXELS), np.float32), warp, size)[..., None]
        picture = picture * (1 - inside) + drawn * inside
    return cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def camera_at(x: float, y: float, z: float = 0.0) -> np.ndarray:
    return look_at(np.array([x, y, z]), np.array([0.2 * x, 0.1, 3.8]), np.array([0.0, 1.0, 0.0]))


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("planes")
    places = [
        (-0.9, -0.2, 0.0),
        (-0.3, 0.25, 0.1),
        (0.3, -0.25, -0.1),
        (0.9, 0.2, 0.0),
        (0, 0, 0.3),
    ]
    cams = {f"v{index}.png": camera_at(*place) for index, place in enumerate(places)}
    for name, cam in cams.items():
        write_image(folder / name, draw(cam))
    return Scene(folder, cams)
