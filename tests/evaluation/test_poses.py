from __future__ import annotations

import json

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.evaluation.poses import pose_numbers, read_true_cameras
from pipeline.io.atomic import write_json
from pipeline.io.scene import ImageRecord


def turned_about(axis: int, degrees: float, shift) -> np.ndarray:
    pose, angle = np.eye(4), np.radians(degrees)
    i, j = [k for k in range(3) if k != axis]
    pose[i, i] = pose[j, j] = np.cos(angle)
    pose[i, j], pose[j, i] = -np.sin(angle), np.sin(angle)
    pose[:3, 3] = shift
    return pose


@pytest.fixture
def cameras():
    shifts = np.random.default_rng(0).normal(size=(5, 3))
    return {f"v{i}.png": turned_about(1, 10 * i, shift) for i, shift in enumerate(shifts)}


def test_a_similar_world_has_no_error(cameras):
    world = turned_about(2, 30, [1, 2, 3])
    moved = {}
    for name, pose in cameras.items():
        moved[name] = pose @ world
        moved[name][:3, 3] *= 2.5
    numbers = pose_numbers(moved, (cameras, "m"), 6, "")
    assert (numbers["registered"], numbers["total"], numbers["unit"]) == (5, 6, "m")
    for name in ("rotation_deg", "rotation_deg_max", "translation", "translation_max"):
        assert numbers[name] == pytest.approx(0, abs=1e-5)


def test_what_cannot_be_compared_is_null_with_a_reason(cameras):
    numbers = pose_numbers(cameras, None, 5, "no truth here")
    assert numbers["rotation_deg"] is None and numbers["rotation_deg_reason"] == "no truth here"
    alone = pose_numbers(dict([*cameras.items()][:1]), (cameras, "m"), 5, "")
    assert alone["translation"] is None and "aligned" in alone["translation_reason"]


def test_true_cameras_turn_with_their_images(tmp_path):
    path = tmp_path / "cameras.json"
    records = [ImageRecord("a.png", "a.jpg", "", 4, 6, None, "train", 90)]
    assert read_true_cameras(path, records) is None
    write_json(path, {"frames": {"a": {"cam_from_world": np.eye(4).tolist()}}, "unit": "m"})
    cameras, unit = read_true_cameras(path, records)
    # Turned counter-clockwise, what was right of the middle is above it, and y points down.
    np.testing.assert_allclose(cameras["a.png"] @ [1, 0, 5, 1], [0, -1, 5, 1], atol=1e-12)
    assert unit == "m"


def test_a_true_camera_bears_its_photos_name(tmp_path):
    path = tmp_path / "cameras.json"
    write_json(path, {"frames": {"IMG 1.a": {"cam_from_world": np.eye(4).tolist()}}})
    records = [ImageRecord("IMG_1.a.png", "IMG 1.a.jpg", "", 6, 4, None, "train", 0)]
    assert [*read_true_cameras(path, records)[0]] == ["IMG_1.a.png"]


def test_damaged_truth_is_told(tmp_path):
    path = tmp_path / "cameras.json"
    write_json(path, {"frames": {"a": {"cam_from_world": [1, 2]}}})
    with pytest.raises(UserError, match="not a list of true cameras"):
        read_true_cameras(path, [])
    for odd in (float("nan"), 10**400):
        frames = {"a": {"cam_from_world": [[odd] * 4] * 4}}
        path.write_text(json.dumps({"frames": frames}))
        with pytest.raises(UserError, match="not a list of true cameras"):
            read_true_cameras(path, [])
