"""Rays through pixels: pinhole with one radial coefficient, world frame, OpenCV camera axes."""

from __future__ import annotations

import torch
from torch import Tensor

UNDISTORT_STEPS = 24


def undistort(
    x: Tensor, y: Tensor, k1: Tensor, steps: int = UNDISTORT_STEPS
) -> tuple[Tensor, Tensor]:
    """Undistorted normalised image coordinates.

    Solves ``x_distorted = x (1 + k1 (x^2 + y^2))`` by fixed-point iteration, which converges for
    the lenses of cameras and phones (``|k1| r^2`` below about 0.3). All shapes broadcast.
    """
    u, v = x, y
    for _ in range(steps):
        gain = 1.0 + k1 * (u * u + v * v)
        u, v = x / gain, y / gain
    return u, v


def pixel_rays(
    columns: Tensor,
    rows: Tensor,
    intrinsics: Tensor,
    cam_from_world: Tensor,
    distorted: bool | None = None,
) -> tuple[Tensor, Tensor]:
    """Origins and directions ``(3, N)`` of the rays through pixel centres, components first.

    ``columns`` and ``rows`` ``(N,)`` are pixel indices (the centre of pixel (0, 0) is at
    (0.5, 0.5)); ``intrinsics`` ``(N, 5)`` or ``(5,)`` holds fx, fy, cx, cy, k1;
    ``cam_from_world`` ``(N, 3, 4)`` or ``(3, 4)``. The direction has length 1 along the camera's
    optical axis, so the ray parameter ``t`` is the depth along z, in the unit of the poses.
    ``distorted``: whether any k1 is not 0; None looks, for which a GPU has to be waited for.
    """
    fx, fy, cx, cy, k1 = intrinsics.unbind(-1)
    x = (columns.to(intrinsics.dtype) + 0.5 - cx) / fx
    y = (rows.to(intrinsics.dtype) + 0.5 - cy) / fy
    if bool((k1 != 0).any()) if distorted is None else distorted:
        x, y = undistort(x, y, k1)
    rotation, translation = cam_from_world[..., :3], cam_from_world[..., 3]
    # world_from_cam applies the transposed rotation: rows of R are the camera axes in the world.
    rays_d = torch.stack(
        [x * rotation[..., 0, i] + y * rotation[..., 1, i] + rotation[..., 2, i] for i in range(3)]
    )
    centre = -(rotation * translation[..., :, None]).sum(-2)
    rays_o = centre.expand(*x.shape, 3).t() if centre.dim() == 1 else centre.t()
    return rays_o, rays_d


def project(
    points: Tensor, intrinsics: Tensor, cam_from_world: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Columns, rows (pixel index units, as :func:`pixel_rays` takes them) and depths of points.

    ``points`` ``(3, N)`` in the world; other shapes as in :func:`pixel_rays`. The inverse of
    :func:`pixel_rays` for points in front of the camera.
    """
    fx, fy, cx, cy, k1 = intrinsics.unbind(-1)
    rotation, translation = cam_from_world[..., :3], cam_from_world[..., 3]
    cam = [(rotation[..., i, :] * points.t()).sum(-1) + translation[..., i] for i in range(3)]
    x, y = cam[0] / cam[2], cam[1] / cam[2]
    gain = 1.0 + k1 * (x * x + y * y)
    return fx * x * gain + cx - 0.5, fy * y * gain + cy - 0.5, cam[2]
