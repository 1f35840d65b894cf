"""Drops: area, closedness, volume, contact angle, coverage."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from pipeline.drops.shape import (
    Drop,
    coverage_raster,
    height,
    mesh,
    outline,
    reach,
    sample_drop,
    sample_drops,
)
from pipeline.errors import UserError


def random_drops(n: int) -> list[Drop]:
    rng = np.random.default_rng(3)
    return [
        sample_drop(rng, (0.01, -0.02), 0.003, merged_share=0.5, run_share=0.4) for _ in range(n)
    ]


def test_outline_has_the_area_of_the_radius() -> None:
    for drop in random_drops(40):
        x, y = outline(drop, 256).T
        area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
        assert area == pytest.approx(np.pi * drop.radius**2, rel=5e-3)
        distance = np.hypot(x - drop.center[0], y - drop.center[1])
        assert distance.max() <= reach(drop) * (1 + 1e-6)


def test_mesh_is_closed_and_holds_the_water() -> None:
    for drop in random_drops(8):
        vertices, faces = mesh(drop)
        edges = Counter(
            (int(a), int(b)) for f in faces for a, b in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))
        )
        assert all(count == 1 and edges[b, a] == 1 for (a, b), count in edges.items())
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
        axis = np.linspace(-1, 1, 301) * 1.02 * reach(drop)
        x, y = np.meshgrid(axis + drop.center[0], axis + drop.center[1])
        poured = height(drop, x, y).sum() * (axis[1] - axis[0]) ** 2
        assert volume > 0
        assert volume == pytest.approx(poured, rel=0.03)
        assert vertices[:, 2].min() == 0


@pytest.mark.parametrize("degrees", [30, 55, 80])
def test_rim_rises_at_the_contact_angle(degrees: float) -> None:
    drop = Drop((0.0, 0.0), 0.004, np.radians(degrees), wobble=((0.08, 0.3), (0.04, 1.0)))
    points = outline(drop, 90)
    step = 1e-5
    ahead, behind = np.roll(points, -1, axis=0), np.roll(points, 1, axis=0)
    along = (ahead - behind) / np.linalg.norm(ahead - behind, axis=1, keepdims=True)
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    inner = points + step * inward * drop.radius
    slope = height(drop, inner[:, 0], inner[:, 1]) / (step * drop.radius)
    assert np.degrees(np.arctan(slope)) == pytest.approx(np.full(90, degrees), abs=1.0)


def test_round_drop_is_a_spherical_cap() -> None:
    angle = np.radians(60)
    drop = Drop((0.0, 0.0), 0.002, angle)
    apex = height(drop, np.zeros(1), np.zeros(1))[0]
    assert apex == pytest.approx(0.002 * np.tan(angle / 2), rel=1e-6)
    cap = np.pi * apex * (3 * 0.002**2 + apex**2) / 6
    vertices, faces = mesh(drop, 96, 40)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(cap, rel=5e-3)


def test_sag_moves_the_highest_point_down() -> None:
    y = np.linspace(-0.003, 0.003, 401)
    straight = Drop((0.0, 0.0), 0.003, 1.0)
    sagging = Drop((0.0, 0.0), 0.003, 1.0, sag=0.3)
    assert y[height(straight, 0 * y, y).argmax()] == pytest.approx(0, abs=1e-5)
    assert y[height(sagging, 0 * y, y).argmax()] > 2e-4


@pytest.mark.parametrize("coverage", [0.05, 0.25])
def test_wanted_coverage_is_reached_without_overlap(coverage: float) -> None:
    rng = np.random.default_rng(7)
    drops = sample_drops(rng, 0.06, 0.045, coverage, (0.0008, 0.008))
    share = coverage_raster(drops, 0.06, 0.045, 0.12 / 900).mean()
    assert share == pytest.approx(coverage, abs=0.01)
    alone = sum(coverage_raster([d], 0.06, 0.045, 0.12 / 900).mean() for d in drops)
    assert alone == pytest.approx(share, rel=1e-3)  # nothing counted twice
    radii = np.array([d.radius for d in drops])
    assert radii.max() > 3 * radii.min()


def test_same_seed_same_drops_and_impossible_coverage_is_refused() -> None:
    first, second = (
        sample_drops(np.random.default_rng(1), 0.05, 0.04, 0.1, (0.002, 0.006)) for _ in range(2)
    )
    assert first == second
    with pytest.raises(UserError, match="cover only"):
        sample_drops(np.random.default_rng(1), 0.01, 0.01, 0.99, (0.002, 0.003), max_tries=60)


def test_bad_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="contact angle"):
        outline(Drop((0.0, 0.0), 0.001, 1.7))
    with pytest.raises(ValueError, match="lobe"):
        outline(Drop((0.0, 0.0), 0.001, 1.0, lobes=((1.0, 0.0, 0.5),)))
    with pytest.raises(ValueError, match="tail"):
        outline(Drop((0.0, 0.0), 0.001, 1.0, tail_length=9.0))
