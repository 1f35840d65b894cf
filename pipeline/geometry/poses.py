"""Poses: averages, and the alignment of one set of cameras to another.

A pose is `cam_from_world`, 4x4 float64, camera axes x right, y down, z forward (OpenCV, COLMAP). Other
programs' conventions are met where their files are: `pipeline.io.transforms`, `pipeline.io.llff`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

_FEW_CENTRES = 1e-9


def as_4x4(pose: np.ndarray) -> np.ndarray:
    """A 4x4 float64 copy of a 3x4 or 4x4 pose; ValueError for another shape."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"a pose is 3x4 or 4x4, not {pose.shape}")
    full = np.eye(4)
    full[:3] = pose[:3]
    return full


def invert(pose: np.ndarray) -> np.ndarray:
    """The inverse (4, 4) of a rigid motion: world_from_cam of a cam_from_world, and back."""
    pose = as_4x4(pose)
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def centre(cam_from_world: np.ndarray) -> np.ndarray:
    """The camera's centre (3,) in the world."""
    return invert(cam_from_world)[:3, 3]


def rotation_angle_deg(rotation: np.ndarray) -> float:
    """The angle in degrees, [0, 180], by which a 3x3 rotation turns; exact near 0 and near 180."""
    rotation = np.asarray(rotation, dtype=np.float64)
    skew = rotation - rotation.T
    sine = 0.5 * float(np.linalg.norm([skew[2, 1], skew[0, 2], skew[1, 0]]))
    cosine = 0.5 * (float(np.trace(rotation)) - 1.0)
    return float(np.degrees(np.arctan2(sine, cosine)))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to `matrix` in the Frobenius norm (orthogonal Procrustes)."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def mean_rotation(rotations: np.ndarray, steps: int = 20) -> np.ndarray:
    """The rotation (3, 3) in the middle of `rotations` (N, 3, 3), little moved by a few wrong ones.

    Chordal L1 mean by reweighting (Weiszfeld): each step is the nearest rotation to a weighted sum,
    with weights one over the distance to the last estimate (Hartley et al. 2013, doi
    10.1007/s11263-012-0601-0).
    """
    rotations = np.asarray(rotations, dtype=np.float64)
    middle = nearest_rotation(rotations.sum(axis=0))
    for _ in range(steps):
        distance = np.linalg.norm(rotations - middle, axis=(1, 2))
        weights = 1.0 / np.maximum(distance, 1e-6)
        middle = nearest_rotation(np.tensordot(weights, rotations, axes=1))
    return middle


def average_pose(cams: Sequence[np.ndarray]) -> np.ndarray:
    """The cam_from_world (4, 4) at the mean centre, looking along the mean direction, mean up."""
    world = np.stack([invert(cam) for cam in cams])
    forward = world[:, :3, 2].mean(axis=0)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(world[:, :3, 1].mean(axis=0), forward)
    right = right / np.linalg.norm(right)
    middle = np.eye(4)
    middle[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    middle[:3, 3] = world[:, :3, 3].mean(axis=0)
    return invert(middle)


@dataclass(frozen=True)
class Similarity:
    """target = scale * rotation @ source + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the source world in the target world."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.translation

    def apply_to_pose(self, cam_from_world: np.ndarray) -> np.ndarray:
        """A cam_from_world (4, 4) of the source world in the target world; it stays rigid."""
        pose = as_4x4(cam_from_world)
        moved = np.eye(4)
        moved[:3, :3] = pose[:3, :3] @ self.rotation.T
        moved[:3, 3] = self.scale * pose[:3, 3] - moved[:3, :3] @ self.translation
        return moved


def align_cameras(
    estimated: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]
) -> Similarity:
    """The similarity that takes the world of `estimated` cameras to that of the `true` ones.

    The turn is the mean of the cameras' own relative rotations, so that centres on a line or a
    small grid (where centres alone leave a turn open) do no harm; scale and shift are then least
    squares on the centres. Cameras are paired by name; ValueError with fewer than two pairs or one
    common centre.
    """
    names = sorted(estimated.keys() & true.keys())
    if len(names) < 2:
        raise ValueError(f"needs two or more cameras known to both sides, got {len(names)}")
    found = [as_4x4(estimated[name]) for name in names]
    truth = [as_4x4(true[name]) for name in names]
    pairs = zip(found, truth, strict=True)
    rotation = mean_rotation(np.stack([b[:3, :3].T @ a[:3, :3] for a, b in pairs]))
    source = np.stack([centre(cam) for cam in found])
    target = np.stack([centre(cam) for cam in truth])
    around_source = (source - source.mean(axis=0)) @ rotation.T
    spread = float((around_source**2).sum())
    if spread < _FEW_CENTRES:
        raise ValueError("all camera centres coincide: no scale can be found")
    scale = float((around_source * (target - target.mean(axis=0))).sum() / spread)
    shift = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    return Similarity(scale, rotation, shift)


@dataclass(frozen=True)
class PoseErrors:
    """Per camera after alignment: turn in degrees, distance of centres in the true world's unit.

    `extent` is the largest distance of a true centre from their mean, to put `centre` in
    proportion.
    """

    rotation_deg: dict[str, float]
    centre: dict[str, float]
    extent: float
    alignment: Similarity


def pose_errors(estimated: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]) -> PoseErrors:
    """How far the estimated cameras (cam_from_world by name) are from the true ones, once aligned.

    Cameras that only one side knows are left out. ValueError as align_cameras.
    """
    alignment = align_cameras(estimated, true)
    rotation_deg: dict[str, float] = {}
    distance: dict[str, float] = {}
    for name in sorted(estimated.keys() & true.keys()):
        moved = alignment.apply_to_pose(estimated[name])
        rotation_deg[name] = rotation_angle_deg(moved[:3, :3] @ as_4x4(true[name])[:3, :3].T)
        distance[name] = float(np.linalg.norm(centre(moved) - centre(true[name])))
    centres = np.stack([centre(true[name]) for name in rotation_deg])
    extent = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    return PoseErrors(rotation_deg, distance, extent, alignment)
