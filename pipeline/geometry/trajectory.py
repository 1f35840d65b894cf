"""Camera paths for a video: a spiral before a scene that all cameras face, else a tour of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.geometry.poses import average_pose, centre, invert, nearest_rotation


def look_at(eye: np.ndarray, target: np.ndarray, down: np.ndarray) -> np.ndarray:
    """The cam_from_world (4, 4) at `eye` that looks at `target`, image y towards `down`."""
    forward = np.asarray(target, dtype=np.float64) - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(down, forward)
    right = right / np.linalg.norm(right)
    world = np.eye(4)
    world[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    world[:3, 3] = eye
    return invert(world)


def spiral_path(
    cams: Sequence[np.ndarray],
    *,
    near: float,
    far: float,
    frames: int,
    turns: int = 2,
    size: float = 0.6,
) -> list[np.ndarray]:
    """A closed spiral around the mean camera: `frames` poses (4, 4) that look at one point.

    The radii are `size` times the 90th percentile of the cameras' offsets in each direction, so the
    path stays where photos were taken; the point looked at lies between near and far, weighted
    towards far in inverse depth as LLFF's renderer does (doi 10.1145/3306346.3322980, and its
    public code).
    """
    world_from_mean = invert(average_pose(cams))
    focus = 1.0 / (0.25 / near + 0.75 / far)
    offsets = (np.stack([centre(cam) for cam in cams]) - world_from_mean[:3, 3]) @ (
        world_from_mean[:3, :3]
    )
    radii = size * np.percentile(np.abs(offsets), 90, axis=0)
    target = world_from_mean[:3, :3] @ np.array([0.0, 0.0, focus]) + world_from_mean[:3, 3]
    path = []
    for angle in np.linspace(0.0, 2.0 * np.pi * turns, frames, endpoint=False):
        swing = np.array([np.cos(angle), np.sin(angle), np.sin(angle / turns)]) * radii
        eye = world_from_mean[:3, :3] @ swing + world_from_mean[:3, 3]
        path.append(look_at(eye, target, world_from_mean[:3, 1]))
    return path


def tour_order(cams: Sequence[np.ndarray]) -> list[int]:
    """The cameras by index, in an order with short steps: nearest next, then 2-opt.

    The step between two cameras counts the distance of centres, over their mean distance, and the
    angle between their directions.
    """
    world = np.stack([invert(cam) for cam in cams])
    gaps = np.linalg.norm(world[:, None, :3, 3] - world[None, :, :3, 3], axis=2)
    angles = np.arccos(np.clip(world[:, :3, 2] @ world[:, :3, 2].T, -1.0, 1.0))
    cost = gaps / max(float(gaps.mean()), 1e-12) + angles
    order = [int(np.argmax(cost.sum(axis=1)))]
    while len(order) < len(cams):
        steps = cost[order[-1]].copy()
        steps[order] = np.inf
        order.append(int(np.argmin(steps)))
    improved = True
    while improved:
        improved = False
        for i in range(len(order) - 2):
            for j in range(i + 2, len(order)):
                after = cost[order[j], order[j + 1]] if j + 1 < len(order) else 0.0
                joined = cost[order[i + 1], order[j + 1]] if j + 1 < len(order) else 0.0
                gain = cost[order[i], order[i + 1]] + after - cost[order[i], order[j]] - joined
                if gain > 1e-9:
                    order[i + 1 : j + 1] = order[i + 1 : j + 1][::-1]
                    improved = True
    return order


def interpolated_path(
    cams: Sequence[np.ndarray], *, frames: int, smoothing: float = 1.0
) -> list[np.ndarray]:
    """A smooth tour past the cameras: `frames` poses (4, 4) from one end to the other.

    Cameras are visited in `tour_order`; centres and axes are blended with Gaussian weights of width
    `smoothing` (in steps between cameras; towards 0 the path passes through them), the axes made a
    rotation again, and the frames spread evenly over the length of the way.
    """
    if frames < 2 or len(cams) < 2:
        raise ValueError("a tour needs two cameras and two frames")
    world = np.stack([invert(cams[index]) for index in tour_order(cams)])
    width = max(smoothing, 1e-3)
    fine = np.linspace(0.0, len(cams) - 1.0, max(8 * len(cams), 4 * frames))
    blended = np.stack([_blend(world, place, width) for place in fine])
    steps = np.linalg.norm(np.diff(blended[:, :, 3], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    places = np.interp(np.linspace(0.0, way[-1], frames), way, fine)
    return [_pose(_blend(world, place, width)) for place in places]


def camera_path(
    cams: Sequence[np.ndarray], bounds: tuple[float, float] | None, frames: int
) -> list[np.ndarray]:
    """`frames` poses for a video: a spiral with the depth `bounds`, a tour of the cameras without."""
    if bounds is not None:
        return spiral_path(cams, near=bounds[0], far=bounds[1], frames=frames)
    return interpolated_path(cams, frames=frames)


def _blend(world: np.ndarray, place: float, width: float) -> np.ndarray:
    """The (3, 4) mean of poses around `place`: weights of the two neighbours, smoothed."""
    index = np.arange(len(world), dtype=np.float64)
    if width < 0.05:
        weights = np.maximum(1.0 - np.abs(index - place), 0.0)
    else:
        exponent = -0.5 * ((index - place) / width) ** 2
        weights = np.exp(exponent - exponent.max())
    weights = weights / weights.sum()
    return np.tensordot(weights, world[:, :3], axes=1)


def _pose(blended: np.ndarray) -> np.ndarray:
    world = np.eye(4)
    world[:3, :3] = nearest_rotation(blended[:, :3])
    world[:3, 3] = blended[:, 3]
    return invert(world)
