"""LLFF's poses_bounds.npy, the poses that DerainNeRF's code and nerf-pytorch read.

Each row is a (3, 5) matrix, world-from-camera with the axes down, right, back, then (height, width,
focal), and the near and far depth. The reader there takes one focal length, the first row's, and the
middle of the image for the principal point, and knows no distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from pipeline.io.atomic import read_npy
from pipeline.io.given import GivenView, checked_camera, checked_rigid, inverse_rigid
from pipeline.io.transforms import View


def poses_bounds(views: Sequence[View]) -> np.ndarray:
    """The (N, 17) float64 array of `views`, which are without distortion, in name order.

    Places lie in the views' own world, near its origin: the readers count in 32 bits.
    """
    rows = []
    for view in sorted(views, key=lambda view: view.name):
        right, down, ahead, place = view.world_from_cam[:3].T
        size = np.array([view.height, view.width, view.fx])
        matrix = np.stack([down, right, -ahead, place, size], axis=1)
        rows.append(np.concatenate([matrix.ravel(), [view.near, view.far]]))
    return np.stack(rows)


def read_poses_bounds(path: Path, photos: Sequence[Path]) -> list[GivenView]:
    """The cameras of LLFF's poses_bounds.npy for `photos`, which are its rows in name order.

    Each row is a (3, 5) matrix, world-from-camera with the axes down, right, back, then (H, W, f),
    and the near and far depth. The principal point is the centre. UserError for a damaged file or
    another number of photos.
    """
    rows = read_npy(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fiu":
        raise UserError(
            f"{path} has shape {rows.shape} of {rows.dtype}; N rows of 17 numbers are expected."
        )
    if len(rows) != len(photos):
        raise UserError(
            f"{path} holds {len(rows)} poses, but there are {len(photos)} photos.",
            "LLFF pairs them by name order; every photo needs its row.",
        )
    views = []
    for photo, row in zip(sorted(photos), rows.astype(np.float64), strict=True):
        matrix = row[:15].reshape(3, 5)
        down, right, back, place, (height, width, focal) = matrix.T
        world_from_cam = np.eye(4)
        world_from_cam[:3] = np.stack([right, down, -back, place], axis=1)
        world_from_cam = checked_rigid(world_from_cam, f"{path}: the pose of {photo.name}")
        view = GivenView(
            photo=photo,
            cam_from_world=inverse_rigid(world_from_cam),
            width=_pixels(width),
            height=_pixels(height),
            fx=focal,
            fy=focal,
            cx=width / 2,
            cy=height / 2,
            near=float(row[15]),
            far=float(row[16]),
        )
        views.append(checked_camera(view, str(path)))
    return views


def _pixels(side: float) -> int:
    return round(side) if np.isfinite(side) else 0
