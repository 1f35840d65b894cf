"""Cameras moved after a reconstruction: points follow, and features may object."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from pipeline.field.align import moved
from pipeline.geometry.poses import invert
from pipeline.sfm import Reconstructed, Settings, account, reconstruct, with_poses

SETTINGS = Settings(
    camera="single", matcher="exhaustive", mapper="incremental", max_features=800, max_image_size=0,
    masked=False, still=False, refine_focal=False, refine_distortion=False,
)  # fmt: skip


@pytest.fixture(scope="module")
def found(scene, tmp_path_factory: pytest.TempPathFactory) -> Reconstructed:
    work: Path = tmp_path_factory.mktemp("work")
    focal = dict.fromkeys(scene.names, 220.0)
    return reconstruct(
        scene.images, None, scene.names, work_dir=work, settings=SETTINGS, focal_px=focal
    )


def poses_of(found: Reconstructed) -> dict[str, np.ndarray]:
    return {name: view.cam_from_world for name, view in found.views.items()}


def test_points_follow_when_the_whole_world_is_moved(found: Reconstructed) -> None:
    world = moved(np.eye(4), np.array([0.01, -0.02, 0.01, 0.002, 0.001, -0.002]))
    new = with_poses(found, {n: pose @ invert(world) for n, pose in poses_of(found).items()}, 0.2)
    assert new.aligned and not found.aligned
    expected = found.points_xyz @ world[:3, :3].T + world[:3, 3]
    assert np.median(np.linalg.norm(new.points_xyz - expected, axis=1)) < 1e-3
    assert new.reprojection_px == pytest.approx(found.reprojection_px, rel=0.01)
    assert account(new, len(new.views))["aligned"] is True


def test_the_new_poses_are_taken_as_they_are_and_the_old_ones_stay(found: Reconstructed) -> None:
    before = poses_of(found)
    nudged = {name: moved(pose, np.full(6, 1e-4)) for name, pose in before.items()}
    new = poses_of(with_poses(found, nudged, 0.2))
    for name, pose in nudged.items():
        np.testing.assert_allclose(new[name], pose, atol=1e-9)
        np.testing.assert_array_equal(found.views[name].cam_from_world, before[name])
        model = {
            image.name: image.cam_from_world().matrix() for image in found.model.images.values()
        }
        np.testing.assert_allclose(model[name], before[name][:3], atol=1e-9)


def test_features_object_to_poses_that_are_not_theirs(
    found: Reconstructed, caplog: pytest.LogCaptureFixture
) -> None:
    poses = poses_of(found)
    names = sorted(poses)
    turned = {name: poses[other] for name, other in zip(names, names[1:] + names[:1], strict=True)}
    with caplog.at_level(logging.WARNING):
        assert with_poses(found, turned, 0.2) is found
    assert "stay as the features tell" in caplog.text
