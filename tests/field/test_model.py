"""The space around what cameras see."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.errors import UserError
from pipeline.field.model import build_around, scene_space
from pipeline.geometry.rays import pixel_rays
from pipeline.geometry.spaces import fit_space, ndc


@pytest.mark.parametrize("k1", [0.0, -0.05, -0.1, -0.15])
def test_corners_lie_within_the_space_through_any_lens(k1: float) -> None:
    """Within a two hundredth of its sides: what lies beyond is laid flat onto them."""
    pose, size, intrinsics = np.eye(4), (800, 600), (560.0, 560.0, 400.0, 300.0, k1)
    views = 3
    space = scene_space(
        "ndc", np.stack([pose] * views), np.array([intrinsics] * views), np.array([size] * views), 2.0, 20.0
    )  # fmt: skip
    columns, rows = torch.tensor([0.0, 799.0, 0.0, 799.0]), torch.tensor([0.0, 0.0, 599.0, 599.0])
    rays_o, rays_d = pixel_rays(
        columns, rows, torch.tensor(intrinsics), torch.eye(4)[:3], distorted=True
    )
    for depth in (2.0, 20.0):
        x, y, _ = ndc(space.ref(rays_o) + space.turned(rays_d) * depth, space.near).numpy()
        for value, low, high in zip((x, y), space.low, space.high, strict=False):
            share = (value - low) / (high - low)
            assert share.min() > -0.005 and share.max() < 1.005


def border(width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Columns and rows of the pixels along a photo's four sides."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    outer = (columns % (width - 1) == 0) | (rows % (height - 1) == 0)
    return tuple(torch.from_numpy(v[outer].astype(np.float64)) for v in (columns, rows))  # type: ignore[return-value]


@pytest.mark.parametrize("centre", [(400.0, 300.0), (250.0, 420.0)])
@pytest.mark.parametrize("k1", [0.02, 0.1, 0.2])
def test_the_sides_lie_within_the_space_where_they_bulge_beyond_the_corners(
    k1: float, centre: tuple[float, float]
) -> None:
    size, intrinsics = (800, 600), (800.0, 800.0, *centre, k1)
    turn = np.radians([-0.4, 0.0, 0.3])
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(turn)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(turn), -np.sin(turn)
    space = scene_space("ndc", poses, np.array([intrinsics] * 3), np.array([size] * 3), 2.0, 20.0)
    for pose in poses:
        rays_o, rays_d = pixel_rays(
            *border(*size), torch.tensor(intrinsics, dtype=torch.float64),
            torch.from_numpy(pose[:3]), distorted=True,
        )  # fmt: skip
        x, y, _ = ndc(space.ref(rays_o) + space.turned(rays_d) * 5.0, space.near).numpy()
        for value, low, high in zip((x, y), space.low, space.high, strict=False):
            share = (value - low) / (high - low)
            assert share.min() > -0.001 and share.max() < 1.001


def test_sides_that_do_not_bulge_leave_the_bounds_to_the_corners_themselves() -> None:
    """To the bit, through lenses without k1, with k1 < 0 or with so little that nothing is cut off."""
    size, near, far = (800, 600), 2.0, 20.0
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 3] = [-0.3, 0.0, 0.2]
    for k1 in (0.0, -0.08, 0.015):
        intrinsics = np.array([(560.0, 550.0, 390.0, 310.0, k1)] * 3)
        space = scene_space("ndc", poses, intrinsics, np.array([size] * 3), near, far)
        corners = np.empty((3, 4, 3))
        for i, (column, row) in enumerate(((0, 0), (800, 0), (0, 600), (800, 600))):
            x, y = (column - 390.0) / 560.0, (row - 310.0) / 550.0
            gain = 1.0 + k1 * (x * x + y * y)
            for _ in range(24):
                better = 1.0 + k1 * (x * x + y * y) / gain**2
                if abs(better / gain - 1.0) < 1e-3:
                    break
                gain = better
            corners[:, i] = x / gain, y / gain, 1.0
        assert space == fit_space("ndc", poses, corners, np.full(3, near), np.full(3, far))


def test_normalised_coordinates_are_refused_where_cameras_look_at_each_other() -> None:
    """Half a turn apart one camera's near points lie behind the mean camera, whatever is asked for."""
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    back[2, 3] = 8.0
    cameras = [SimpleNamespace(cam_from_world=pose, intrinsics=(50.0, 50.0, 20.0, 15.0, 0.0), width=40,
                               height=30) for pose in (np.eye(4), back)]  # fmt: skip
    with pytest.raises(UserError, match=r"nerf\.space: ndc cannot hold this scene"):
        build_around("fast", cameras, 1.0, 6.0, space="ndc", table_log2=8)
    assert build_around("fast", cameras, 1.0, 6.0, table_log2=8).space.kind == "contract"
