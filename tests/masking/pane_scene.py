"""Views of discs on a pane that stands before the cameras, cast by hand."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import invert
from pipeline.masking.glass import GlassCamera

WIDTH, HEIGHT, FOCAL = 80, 60, 70.0


def cameras(count: int, k1: float = 0.0) -> list[GlassCamera]:
    """Cameras within half a unit of the origin, looking along z, each turned a little."""
    rng = np.random.default_rng(5)
    found = []
    for _ in range(count):
        turn = rng.normal(0, 0.02, 3)
        x, y, z = turn
        rotation = np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]])
        u, _, vt = np.linalg.svd(rotation)
        pose = np.eye(4)
        pose[:3, :3] = u @ vt
        pose[:3, 3] = -pose[:3, :3] @ (rng.uniform(-0.5, 0.5, 3) * [1, 0.7, 0.1])
        intrinsics = (FOCAL, FOCAL, WIDTH / 2 + 1, HEIGHT / 2 - 1, k1)
        found.append(GlassCamera(pose, intrinsics, WIDTH, HEIGHT))
    return found


def wetness(pane_from_world: np.ndarray, camera: GlassCamera, seed: int = 0) -> np.ndarray:
    """(H, W) float32: 1 where the view looks at a disc on the pane, 0 elsewhere; no lens distortion."""
    rng = np.random.default_rng(seed)
    middles = rng.uniform(-2.5, 2.5, (160, 2))
    radii = rng.uniform(0.04, 0.15, 160)
    fx, fy, cx, cy, _ = camera.intrinsics
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones(rows.shape)], -1)
    pane_from_cam = pane_from_world @ invert(camera.cam_from_world)
    start, along = pane_from_cam[:3, 3], rays @ pane_from_cam[:3, :3].T
    spots = (start - along * (start[2] / along[..., 2])[..., None])[..., :2]
    apart = np.linalg.norm(spots[:, :, None] - middles, axis=-1)
    return (apart < radii).any(axis=2).astype(np.float32)
