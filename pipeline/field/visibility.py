"""Which pixels of a view show a surface that no photo saw uncovered."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from pipeline.geometry.rays import undistort

TOLERANCE = 0.05


class Witness(NamedTuple):
    """A photo that was fitted: pose ``(4, 4)``, fx, fy, cx, cy, k1, keep mask, rendered depth."""

    cam_from_world: np.ndarray
    intrinsics: tuple[float, float, float, float, float]
    keep_mask: np.ndarray
    depth: np.ndarray


def witness_count(view: Witness, witnesses: Sequence[Witness], stride: int = 2) -> np.ndarray:
    """How many photos saw each pixel's surface uncovered, at every ``stride``-th pixel, uint16.

    The surface is where the field's own depth puts it; a photo saw it when the point falls on a
    kept pixel whose depth agrees within 5 per cent.
    """
    points, shape = _surface(view, stride)
    count = np.zeros(points.shape[1], np.uint16)
    for other in witnesses:
        count += _sees(other, points)
    return count.reshape(shape)


def _surface(view: Witness, stride: int) -> tuple[np.ndarray, tuple[int, ...]]:
    """The points (3, N), in the world, at every ``stride``-th pixel of a view, and these' rows and columns."""
    fx, fy, cx, cy, k1 = view.intrinsics
    height, width = view.depth.shape
    rows, columns = np.mgrid[0:height:stride, 0:width:stride]
    depth = view.depth[::stride, ::stride].astype(np.float64).ravel()
    x, y = (columns.ravel() + 0.5 - cx) / fx, (rows.ravel() + 0.5 - cy) / fy
    if k1:
        bent = torch.from_numpy(x), torch.from_numpy(y)
        x, y = (flat.numpy() for flat in undistort(*bent, torch.tensor(k1, dtype=bent[0].dtype)))
    world_from_cam = np.linalg.inv(view.cam_from_world)
    cam = np.stack([x * depth, y * depth, depth])
    return world_from_cam[:3, :3] @ cam + world_from_cam[:3, 3:], rows.shape


def shares(count: np.ndarray) -> dict[str, float]:
    """The shares of pixels that no photo saw uncovered (``never``) and that ``fewer_than_3`` saw."""
    return {
        "never": round(float((count == 0).mean()), 6),
        "fewer_than_3": round(float((count < 3).mean()), 6),
    }


def seen_by_others(index: int, witnesses: Sequence[Witness], fewest: int) -> np.ndarray:
    """Which pixels ``(H, W)`` of one witness show a surface that ``fewest`` others saw uncovered.

    The others are asked in order of their distance in the row, about what is open still.
    """
    own, (height, width) = witnesses[index], witnesses[index].depth.shape
    points, shape = _surface(own, stride=2)
    count, left = np.zeros(points.shape[1], np.uint16), np.arange(points.shape[1])
    for other in sorted(range(len(witnesses)), key=lambda number: abs(number - index)):
        left = left[count[left] < fewest]
        if other != index and left.size:
            count[left] += _sees(witnesses[other], points[:, left])
    seen = (count >= fewest).reshape(shape)
    return np.repeat(np.repeat(seen, 2, axis=0), 2, axis=1)[:height, :width]


def _sees(other: Witness, points: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy, k1 = other.intrinsics
    x, y, z = other.cam_from_world[:3, :3] @ points + other.cam_from_world[:3, 3:]
    safe = np.maximum(z, 1e-9)
    x, y = x / safe, y / safe
    radial = k1 * (x * x + y * y)
    gain = 1.0 + radial
    height, width = other.keep_mask.shape
    column = np.clip(np.floor(fx * x * gain + cx), -1, width).astype(np.int64)
    row = np.clip(np.floor(fy * y * gain + cy), -1, height).astype(np.int64)
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    # Farther out a lens with k1 < 0 folds points back into its frame.
    inside &= 1.0 + 3.0 * radial > 0.0
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    agrees = np.abs(other.depth[row, column] - z) < TOLERANCE * z
    return inside & other.keep_mask[row, column] & agrees
