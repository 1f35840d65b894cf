from __future__ import annotations

import itertools

import numpy as np
import pytest

from pipeline.geometry.poses import average_pose, centre, invert, rotation_angle_deg
from pipeline.geometry.trajectory import (
    interpolated_path,
    look_at,
    spiral_path,
    tour_order,
)

DOWN = np.array([0.0, 1.0, 0.0])


@pytest.fixture
def wall() -> list[np.ndarray]:
    """A grid of cameras that look at one point before them."""
    target = np.array([0.0, 0.0, 6.0])
    return [
        look_at(np.array([x, y, 0.1 * x * y]), target, DOWN)
        for x in (-1.0, -0.5, 0.0, 0.5, 1.0)
        for y in (-0.4, 0.0, 0.4)
    ]


@pytest.fixture
def ring() -> list[np.ndarray]:
    """Cameras on a circle that look at its centre."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    return [
        look_at(np.array([3 * np.cos(a), 0.0, 3 * np.sin(a)]), np.zeros(3), DOWN) for a in angles
    ]


def assert_rigid(path: list[np.ndarray]) -> None:
    for cam in path:
        assert cam.shape == (4, 4)
        assert np.allclose(cam[:3, :3] @ cam[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(cam[:3, :3]) == pytest.approx(1)


def test_look_at_puts_the_target_on_the_axis():
    eye, target = np.array([1.0, -2.0, 0.5]), np.array([3.0, 1.0, 7.0])
    cam = look_at(eye, target, DOWN)
    seen = cam[:3, :3] @ target + cam[:3, 3]
    assert np.allclose(seen, [0, 0, np.linalg.norm(target - eye)])
    assert invert(cam)[1, 1] > 0  # the image's y points down


def test_the_spiral_closes_stays_among_the_cameras_and_looks_at_one_point(wall):
    near, far = 4.0, 12.0
    path = spiral_path(wall, near=near, far=far, frames=120)
    assert len(path) == 120
    assert_rigid(path)
    centres = np.stack([centre(cam) for cam in path])
    cameras = np.stack([centre(cam) for cam in wall])
    assert (np.abs(centres) <= np.abs(cameras).max(axis=0) + 1e-9).all()
    steps = np.linalg.norm(np.roll(centres, -1, axis=0) - centres, axis=1)
    assert steps[-1] < 1.5 * steps[:-1].max()  # from the last frame to the first as well
    assert np.ptp(centres[:, 0]) > 0.5
    focus = np.array([0.0, 0.0, 1 / (0.25 / near + 0.75 / far), 1.0])
    target = invert(average_pose(wall)) @ focus
    for cam in path:
        seen = cam @ target
        assert np.allclose(seen[:2], 0, atol=1e-9) and near < seen[2] < far


def test_the_tour_visits_every_camera_once_and_goes_round_the_ring(ring):
    shuffled = np.random.default_rng(0).permutation(len(ring))
    order = tour_order([ring[i] for i in shuffled])
    assert sorted(order) == list(range(len(ring)))
    places = shuffled[order]
    steps = np.abs(np.diff(places))
    assert np.minimum(steps, len(ring) - steps).max() == 1


def test_the_tour_is_smooth_and_keeps_looking_inwards(ring):
    path = interpolated_path(ring, frames=90)
    assert len(path) == 90
    assert_rigid(path)
    centres = np.stack([centre(cam) for cam in path])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.mean()
    turns = [rotation_angle_deg(b[:3, :3] @ a[:3, :3].T) for a, b in itertools.pairwise(path)]
    assert max(turns) < 8
    for cam in path:
        towards = invert(cam)[:3, 2]
        assert towards @ -centre(cam) / np.linalg.norm(centre(cam)) > 0.98


def test_without_smoothing_the_tour_begins_and_ends_at_cameras(wall):
    path = interpolated_path(wall, frames=50, smoothing=0)
    order = tour_order(wall)
    assert np.allclose(path[0], wall[order[0]]) and np.allclose(path[-1], wall[order[-1]])


def test_the_same_cameras_give_the_same_path(ring):
    first, second = (np.stack(interpolated_path(ring, frames=20)) for _ in range(2))
    assert (first == second).all()
    with pytest.raises(ValueError, match="two cameras"):
        interpolated_path(ring[:1], frames=20)
