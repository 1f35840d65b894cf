"""Rays through pixels: pinhole with one radial coefficient, world frame, OpenCV camera axes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pipeline.geometry.compiled import compiled
from pipeline.geometry.constants import constant

UNDISTORT_STEPS = 24
# -k1 r^2 of the distorted radius r from which 24 steps are off by more than 0.03 px; at 4/27 a lens with k1 < 0
# folds back, and no ray leads to what lies beyond.
MOST_FOLDED = 0.145
FOLDS = (
    2.0 / 3.0
)  # the same of the undistorted radius: where 1 + k1 r^2 is less, the picture has folded back


def undistort(
    x: Tensor, y: Tensor, k1: Tensor, steps: int = UNDISTORT_STEPS
) -> tuple[Tensor, Tensor]:
    """Undistorted normalised image coordinates.

    Solves ``x_distorted = x (1 + k1 (x^2 + y^2))`` by fixed-point iteration, which converges for
    the lenses of cameras and phones (``k1 r^2`` below about 0.3). All shapes broadcast. Where
    ``-k1 r^2`` exceeds MOST_FOLDED, the place on the same radius where it does not.
    """
    over = -k1 * (x * x + y * y)
    inwards = torch.sqrt(constant((MOST_FOLDED,), over)[0] / over.clamp_min(MOST_FOLDED))
    x, y = x * inwards, y * inwards
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
    k1 = intrinsics[..., 4]
    distorted = bool((k1 != 0).any()) if distorted is None else distorted
    if intrinsics.device.type == "cpu" and intrinsics.dtype == torch.float32:
        return _in_one_pass(columns, rows, intrinsics, cam_from_world, distorted)
    return _by_tensors(columns, rows, intrinsics, cam_from_world, distorted)


def _by_tensors(
    columns: Tensor, rows: Tensor, intrinsics: Tensor, cam_from_world: Tensor, distorted: bool
) -> tuple[Tensor, Tensor]:
    fx, fy, cx, cy, k1 = intrinsics.unbind(-1)
    x = (columns.to(intrinsics.dtype) + 0.5 - cx) / fx
    y = (rows.to(intrinsics.dtype) + 0.5 - cy) / fy
    if distorted:
        x, y = undistort(x, y, k1)
    rotation, translation = cam_from_world[..., :3], cam_from_world[..., 3]
    # world_from_cam applies the transposed rotation: rows of R are the camera axes in the world.
    rays_d = torch.stack(
        [x * rotation[..., 0, i] + y * rotation[..., 1, i] + rotation[..., 2, i] for i in range(3)]
    )
    centre = -(rotation * translation[..., :, None]).sum(-2)
    rays_o = centre.expand(*x.shape, 3).t() if centre.dim() == 1 else centre.t()
    return rays_o, rays_d


def _in_one_pass(
    columns: Tensor, rows: Tensor, intrinsics: Tensor, cam_from_world: Tensor, distorted: bool
) -> tuple[Tensor, Tensor]:
    """To the last bit what :func:`_by_tensors` makes in two hundred operations."""
    rays = torch.empty(2, 3, *columns.shape)
    _fill_rays(
        columns.numpy(), rows.numpy(), intrinsics.reshape(-1, 5).numpy(),
        cam_from_world.reshape(-1, 3, 4).numpy(), UNDISTORT_STEPS if distorted else 0, rays.numpy(),
    )  # fmt: skip
    return rays[0], rays[1]


@compiled
def _fill_rays(columns, rows, intrinsics, poses, steps, rays):  # type: ignore[no-untyped-def]
    """Fills ``rays`` (2, 3, N), float32: origins and directions. Cameras: one, or one per ray."""
    one, half, most = np.float32(1.0), np.float32(0.5), np.float32(MOST_FOLDED)
    x, y, k1 = rays[0, 0], rays[0, 1], rays[0, 2]  # until the origins are put there
    u, v = rays[1, 0], rays[1, 1]
    for n in range(rays.shape[2]):
        camera = intrinsics[n if intrinsics.shape[0] > 1 else 0]
        x[n] = (np.float32(columns[n]) + half - camera[2]) / camera[0]
        y[n] = (np.float32(rows[n]) + half - camera[3]) / camera[1]
        k1[n] = camera[4]
        over = -k1[n] * (x[n] * x[n] + y[n] * y[n])
        if steps > 0 and over > most:
            inwards = np.sqrt(most / over)
            x[n], y[n] = x[n] * inwards, y[n] * inwards
        u[n], v[n] = x[n], y[n]
    for _ in range(steps):  # outside, so that pixels are taken several at a time
        for n in range(rays.shape[2]):
            gain = one + k1[n] * (u[n] * u[n] + v[n] * v[n])
            u[n], v[n] = x[n] / gain, y[n] / gain
    for n in range(rays.shape[2]):
        pose = poses[n if poses.shape[0] > 1 else 0]
        right, down = u[n], v[n]
        for i in range(3):
            centre = pose[0, i] * pose[0, 3] + pose[1, i] * pose[1, 3] + pose[2, i] * pose[2, 3]
            rays[0, i, n] = -centre
            rays[1, i, n] = right * pose[0, i] + down * pose[1, i] + pose[2, i]


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
