"""The unit cube holds the scene, and lines keep their shape where they should."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.geometry.spaces import Space, contract, fit_space, is_forward_facing, ndc


def looking(centre: list[float], target: list[float]) -> np.ndarray:
    forward = np.subtract(target, centre)
    forward = forward / np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    out[:3, 3] = -out[:3, :3] @ np.array(centre)
    return out


def corners(cams: np.ndarray) -> np.ndarray:
    cam = np.array([[x, y, 1.0] for x in (-0.6, 0.6) for y in (-0.4, 0.4)])
    return np.einsum("vji,cj->vci", cams[:, :3, :3], cam)


FACING = np.stack([looking([x, 0.1 * x, 0.0], [0.0, 0.0, 6.0]) for x in (-0.5, 0.0, 0.5)])
AROUND = np.stack(
    [looking([4 * np.sin(a), 0.3, 4 * np.cos(a)], [0.0, 0.0, 0.0]) for a in (0, 1, 2, 3, 4, 5)]
)


def test_ndc_keeps_lines_straight_and_depth_between_near_and_infinity() -> None:
    origin, direction = torch.tensor([[0.2], [-0.1], [0.5]]), torch.tensor([[0.3], [0.2], [1.0]])
    t = torch.tensor([[0.5, 1.0, 3.0, 20.0, 1e6]])
    mapped = ndc((origin + direction * t).double(), 1.0)
    chord = mapped[:, -1] - mapped[:, 0]
    away = torch.linalg.cross(mapped - mapped[:, :1], chord[:, None].expand(-1, 5), dim=0)
    assert float(away.abs().max()) < 1e-6
    # Worked by hand: z = 1 is the near plane (0), z = 1.5 gives 1 - 1/1.5 = 1/3, far away gives 1.
    assert mapped[2, :2].tolist() == pytest.approx([0.0, 1 / 3])
    assert float(mapped[2, -1]) == pytest.approx(1.0, abs=1e-5)


def test_contraction_is_the_identity_inside_and_keeps_directions_outside() -> None:
    # (0, 3, 4) has length 5: (2 - 1/5) / 5 = 0.36 times it.
    points = torch.tensor([[0.1, 0.0, 1e6], [-0.5, 3.0, 0.0], [0.3, 4.0, 0.0]])
    out = contract(points)
    assert out[:, 0].tolist() == pytest.approx([0.1, -0.5, 0.3])
    assert out[:, 1].tolist() == pytest.approx([0.0, 1.08, 1.44])
    assert float(out[:, 2].norm()) == pytest.approx(2.0, abs=1e-5)


@pytest.mark.parametrize(("cams", "kind"), [(FACING, "ndc"), (AROUND, "contract")])
def test_the_kind_of_capture_decides_the_space(cams: np.ndarray, kind: str) -> None:
    near, far = np.full(len(cams), 2.0), np.full(len(cams), 50.0)
    assert is_forward_facing(cams, corners(cams), near) == (kind == "ndc")
    assert fit_space("auto", cams, corners(cams), near, far).kind == kind


@pytest.mark.parametrize("kind", ["ndc", "contract"])
def test_what_the_cameras_see_fits_into_the_unit_cube(kind: str) -> None:
    near, far = np.full(3, 2.0), np.full(3, 50.0)
    space = fit_space(kind, FACING, corners(FACING), near, far)
    centres = -np.einsum("vji,vj->vi", FACING[:, :3, :3], FACING[:, :3, 3])
    rays = corners(FACING)
    # Bounds ten times as wide in all directions: what lies outside the own ones is not clamped to them there.
    middle, half = ((np.array(space.high) + s * np.array(space.low)) / 2 for s in (1, -1))
    wide = replace(space, low=tuple(middle - 10 * half), high=tuple(middle + 10 * half))

    def placed(space: Space, t: float) -> torch.Tensor:
        return space.warp(torch.from_numpy((centres[:, None] + rays * t).reshape(-1, 3).T.copy()))

    depths = (2.0, 5.0, 20.0, 50.0)
    free = torch.stack([(placed(wide, t) - 0.5) * 10 + 0.5 for t in depths])
    assert float(free.min()) >= -1e-4 and float(free.max()) <= 1.0 + 1e-4
    mapped = torch.stack([placed(space, t) for t in depths])
    # Nothing was clamped onto one another: different depths stay different.
    assert float((mapped[1:] - mapped[:-1]).norm(dim=1).min()) > 1e-3


def test_a_space_survives_json() -> None:
    space = fit_space("ndc", FACING, corners(FACING), np.full(3, 2.0), np.full(3, 9.0))
    assert Space.from_json(json.loads(json.dumps(space.to_json()))) == space
