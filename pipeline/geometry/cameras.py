"""Small sums on pinhole cameras. Pixel (0, 0) is centred at (0.5, 0.5), so scaling is a product."""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry.poses import as_4x4


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """K (3, 3) float64, pixels from camera rays."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def field_of_view_deg(focal_px: float, size_px: float) -> float:
    """The angle in degrees that `size_px` pixels cover at focal length `focal_px`."""
    return math.degrees(2.0 * math.atan2(0.5 * size_px, focal_px))


def project(
    points: np.ndarray, cam_from_world: np.ndarray, intrinsics: np.ndarray, k1: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of world points (N, 3) and their depth along z (N,), one radial term `k1`.

    Distortion as in COLMAP's SIMPLE_RADIAL and OpenCV: x (1 + k1 r^2). Points with depth <= 0 are
    behind the camera; their pixels mean nothing.
    """
    pose = as_4x4(cam_from_world)
    in_camera = np.asarray(points) @ pose[:3, :3].T + pose[:3, 3]
    depth = in_camera[:, 2]
    plane = in_camera[:, :2] / depth[:, None]
    plane = plane * (1.0 + k1 * (plane**2).sum(axis=1, keepdims=True))
    pixels = plane @ intrinsics[:2, :2].T + intrinsics[:2, 2]
    return pixels, depth
