"""The space around what cameras see."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.field.model import scene_space
from pipeline.geometry.rays import pixel_rays
from pipeline.geometry.spaces import ndc


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
