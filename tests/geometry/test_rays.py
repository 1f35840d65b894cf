"""Rays and pixels are each other's inverse."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipeline.geometry.rays import (
    MOST_FOLDED,
    _by_tensors,
    _in_one_pass,
    pixel_rays,
    project,
    undistort,
)
from pipeline.io import transforms
from pipeline.io.transforms import View


def a_camera() -> torch.Tensor:
    angle = 0.4
    c, s = math.cos(angle), math.sin(angle)
    rows = [[c, 0.0, s, 0.3], [0.0, 1.0, 0.0, -0.2], [-s, 0.0, c, 1.1]]
    return torch.tensor(rows, dtype=torch.float64)


@pytest.mark.parametrize("k1", [0.0, -0.12, 0.2])
def test_a_point_on_a_pixels_ray_lands_on_that_pixel(k1: float) -> None:
    camera = torch.tensor([320.0, 310.0, 201.0, 148.0, k1]).double()
    columns = torch.tensor([0.0, 399.0, 0.0, 399.0, 123.0]).double()
    rows = torch.tensor([0.0, 0.0, 299.0, 299.0, 45.0]).double()
    rays_o, rays_d = pixel_rays(columns, rows, camera, a_camera())
    t = torch.tensor([1.0, 2.0, 3.0, 40.0, 5.0]).double()
    u, v, depth = project(rays_o + rays_d * t, camera, a_camera())
    torch.testing.assert_close(u, columns, atol=1e-6, rtol=0)
    torch.testing.assert_close(v, rows, atol=1e-6, rtol=0)
    torch.testing.assert_close(depth, t)  # t is the depth along z


def test_the_principal_point_looks_along_the_optical_axis() -> None:
    # cx = 10.5 is the centre of column 10.
    camera = torch.tensor([50.0, 50.0, 10.5, 7.5, 0.0])
    pose = torch.eye(4)[:3]
    rays_o, rays_d = pixel_rays(torch.tensor([10]), torch.tensor([7]), camera, pose)
    assert rays_d[:, 0].tolist() == [0.0, 0.0, 1.0]
    assert rays_o[:, 0].tolist() == [0.0, 0.0, 0.0]


def test_every_ray_may_have_a_camera_of_its_own() -> None:
    poses = torch.stack([a_camera(), torch.eye(4).double()[:3]])
    cameras = torch.tensor([[300.0, 300, 200, 150, 0.1], [500.0, 500, 100, 90, 0.0]]).double()
    columns, rows = torch.tensor([7, 9]), torch.tensor([3, 250])
    together = pixel_rays(columns, rows, cameras, poses)
    for i in range(2):
        alone = pixel_rays(columns[i : i + 1], rows[i : i + 1], cameras[i], poses[i])
        torch.testing.assert_close(together[0][:, i], alone[0][:, 0])
        torch.testing.assert_close(together[1][:, i], alone[1][:, 0])


def test_undistorting_undoes_the_distortion() -> None:
    u, k1 = torch.linspace(-0.8, 0.8, 9).double(), torch.tensor(0.25).double()
    gain = 1 + k1 * (u * u + 0.09)
    x, y = undistort(u * gain, 0.3 * gain, k1)
    torch.testing.assert_close(x, u, atol=1e-6, rtol=0)
    torch.testing.assert_close(y, torch.full_like(u, 0.3), atol=1e-6, rtol=0)


@pytest.mark.parametrize("many", [True, False])
@pytest.mark.parametrize("distorted", [True, False])
def test_rays_made_in_one_pass_are_those_of_tensor_operations(many: bool, distorted: bool) -> None:
    """To the last bit: fits hang on it."""
    generator = torch.Generator().manual_seed(0)
    for count in (1, 3, 1000):
        size = (count,) if many else ()
        columns, rows = (torch.randint(0, 800, (count,), generator=generator) for _ in range(2))
        cameras = torch.rand(*size, 5, generator=generator) * torch.tensor(
            [500, 500, 400, 300, 0.4]
        )
        cameras = cameras + torch.tensor([300, 300, 100, 100, -0.2])
        poses = torch.randn(*size, 3, 4, generator=generator)
        told = columns, rows, cameras, poses, distorted
        for one, other in zip(_in_one_pass(*told), _by_tensors(*told), strict=True):
            assert torch.equal(one, other)


def test_beyond_where_a_lens_folds_back_rays_stay_at_the_fold() -> None:
    """Elsewhere they lead to their pixel; `View.without_ray` tells which is which."""
    view = View("a", np.eye(4), 400.0, 400.0, 400.0, 300.0, -0.2, 800, 600, 1.0, 9.0)
    rows, columns = (torch.from_numpy(v.ravel()) for v in np.mgrid[0:600:7, 0:800:7])
    camera = torch.tensor(view.intrinsics)
    rays_o, rays_d = pixel_rays(columns, rows, camera, torch.eye(4)[:3])
    u, v, _ = project(rays_o + rays_d, camera, torch.eye(4)[:3])
    off = torch.hypot(u - columns, v - rows)
    beyond = torch.from_numpy(view.without_ray()[::7, ::7].ravel())
    assert 0.1 < float(beyond.float().mean()) < 0.5
    assert float(off[~beyond].max()) < 0.05
    radius = torch.hypot(*rays_d[:2])
    assert float(radius[beyond].max() / radius[beyond].min()) < 1.001
    assert bool((rays_d[0] * (columns + 0.5 - 400.0) >= 0).all())
    assert MOST_FOLDED == transforms.MOST_FOLDED


def test_a_lens_that_bends_outwards_has_a_ray_for_every_pixel() -> None:
    view = View("a", np.eye(4), 400.0, 400.0, 400.0, 300.0, 0.2, 800, 600, 1.0, 9.0)
    assert not view.without_ray().any()
