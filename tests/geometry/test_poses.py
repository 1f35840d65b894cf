from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.cameras import (
    field_of_view_deg,
    intrinsic_matrix,
    project,
)
from pipeline.geometry.poses import (
    Similarity,
    align_cameras,
    as_4x4,
    average_pose,
    centre,
    invert,
    mean_rotation,
    nearest_rotation,
    pose_errors,
    rotation_angle_deg,
)
from pipeline.geometry.trajectory import look_at

DOWN = np.array([0.0, 1.0, 0.0])


def random_rotation(random: np.random.Generator) -> np.ndarray:
    return nearest_rotation(random.normal(size=(3, 3)))


def random_pose(random: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = random_rotation(random), random.normal(size=3)
    return pose


def turn(axis: int, degrees: float) -> np.ndarray:
    a = np.radians(degrees)
    i, j = [k for k in range(3) if k != axis]
    rotation = np.eye(3)
    rotation[[i, i, j, j], [i, j, i, j]] = np.cos(a), -np.sin(a), np.sin(a), np.cos(a)
    return rotation


@pytest.fixture
def cams() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    return {f"{i}.png": random_pose(random) for i in range(9)}


@pytest.fixture
def similarity() -> Similarity:
    random = np.random.default_rng(7)
    return Similarity(2.5, random_rotation(random), random.normal(size=3))


def test_the_inverse_takes_a_motion_back(cams):
    for cam in cams.values():
        assert np.allclose(invert(invert(cam)), cam)
        assert np.allclose(cam @ invert(cam), np.eye(4))


def test_a_camera_worked_by_hand():
    # At (1, 2, 3), looking along the world's +x, the world's +z downwards: right is y.
    cam = look_at(np.array([1.0, 2, 3]), np.array([5.0, 2, 3]), np.array([0.0, 0, 1]))
    assert np.allclose(centre(cam), [1, 2, 3])
    assert np.allclose(cam[:3, :3], [[0, 1, 0], [0, 0, 1], [1, 0, 0]])


def test_field_of_view():
    assert field_of_view_deg(100, 200) == pytest.approx(90)


def test_a_pose_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="3x4 or 4x4"):
        as_4x4(np.eye(3))


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.01, 45.0, 179.99, 180.0])
def test_rotation_angle_is_exact_at_the_ends_too(angle):
    assert rotation_angle_deg(turn(1, angle)) == pytest.approx(angle, rel=1e-9, abs=1e-12)


def test_nearest_rotation_never_mirrors():
    mirrored = np.diag([1.0, 1.0, -0.5])
    assert np.linalg.det(nearest_rotation(mirrored)) == pytest.approx(1)
    assert np.allclose(nearest_rotation(3.0 * turn(2, 30)), turn(2, 30))


def test_mean_rotation_lies_in_the_middle_and_ignores_one_that_is_upside_down():
    assert np.allclose(mean_rotation(np.stack([turn(0, -20), turn(0, 0), turn(0, 20)])), np.eye(3))
    many = np.stack([turn(0, 0.1), turn(0, -0.1), turn(1, 0.1), turn(1, -0.1)] * 2 + [turn(2, 180)])
    assert rotation_angle_deg(mean_rotation(many)) < 0.1


def test_average_pose_of_mirrored_cameras_is_the_one_between():
    middle = average_pose(
        [look_at(np.array([x, 0.0, 0.0]), np.array([0.0, 0.0, 4.0]), DOWN) for x in (-1.0, 1.0)]
    )
    assert np.allclose(middle, np.eye(4), atol=1e-12)


def test_a_pose_moved_by_a_similarity_sees_the_moved_points_at_the_same_pixels(cams, similarity):
    points = np.random.default_rng(2).normal(size=(30, 3)) * 3
    camera = intrinsic_matrix(200, 210, 100, 80)
    for cam in cams.values():
        before, depth = project(points, cam, camera, 0.02)
        moved = similarity.apply_to_pose(cam)
        after, moved_depth = project(similarity.apply(points), moved, camera, 0.02)
        assert np.allclose(before, after)
        assert np.allclose(moved_depth, similarity.scale * depth)
        assert np.allclose(centre(moved), similarity.apply(centre(cam)))


@pytest.mark.parametrize("shape", ["anywhere", "grid", "line"])
def test_cameras_align_even_when_their_centres_leave_a_turn_open(shape, similarity):
    random = np.random.default_rng(3)
    spread = {"anywhere": (1, 1, 1), "grid": (1, 1, 0), "line": (1, 0, 0)}[shape]
    cams = {}
    for index in range(8):
        pose = np.eye(4)
        pose[:3, :3] = random_rotation(random)
        pose[:3, 3] = -pose[:3, :3] @ (random.normal(size=3) * spread)
        cams[str(index)] = pose
    true = {name: similarity.apply_to_pose(cam) for name, cam in cams.items()}
    found = align_cameras(cams, true)
    assert found.scale == pytest.approx(similarity.scale)
    assert np.allclose(found.rotation, similarity.rotation)
    assert np.allclose(found.translation, similarity.translation)
    errors = pose_errors(cams, true)
    assert max(errors.rotation_deg.values()) < 1e-5
    assert max(errors.centre.values()) < 1e-9


def test_pose_errors_tell_what_was_put_in_and_leave_strangers_out(cams, similarity):
    true = {name: similarity.apply_to_pose(cam) for name, cam in cams.items()}
    wrong = dict(cams)
    turned = np.eye(4)
    turned[:3, :3] = turn(2, 3.0)
    wrong["4.png"] = turned @ cams["4.png"]  # the camera rolls about its own axis, its centre stays
    wrong["stranger.png"] = np.eye(4)
    errors = pose_errors(wrong, true)
    assert "stranger.png" not in errors.rotation_deg
    assert errors.rotation_deg["4.png"] == pytest.approx(3.0, abs=0.01)
    assert max(e for n, e in errors.rotation_deg.items() if n != "4.png") < 0.01
    with pytest.raises(ValueError, match="two or more"):
        pose_errors({"0.png": cams["0.png"]}, true)


def test_projection_worked_by_hand():
    pixels, depth = project(
        np.array([[1.0, 0.0, 2.0]]), np.eye(4), intrinsic_matrix(100, 100, 50, 40), k1=0.4
    )
    # x / z = 0.5, r^2 = 0.25, factor 1.1: 50 + 100 * 0.55
    assert np.allclose(pixels, [[105, 40]]) and depth[0] == 2
