"""Whether a camera moved or only turned, told from matches alone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pipeline.geometry.cameras import intrinsic_matrix
from pipeline.geometry.trajectory import look_at
from pipeline.sfm.turning import Matches, turned_px

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
UP = np.array([0.0, 1.0, 0.0])


def matches(places, *, known: bool, depth, looks=0.8, focal=FOCAL, noise=0.0) -> Matches:
    """Exact matches of points at `depth(x, y)` between cameras at `places`, each with the next one."""
    random = np.random.default_rng(3)
    x, y = random.uniform(-2.5, 2.5, 300), random.uniform(-2, 2, 300)
    points = np.column_stack([x, y, depth(x, y)])
    lens = intrinsic_matrix(focal, focal, 0.0, 0.0)
    pixels = []
    for index, place in enumerate(np.asarray(places, float)):
        ahead = place + np.array([looks * (-1) ** index, 0.3 * index, 4.0])
        cam = look_at(place, ahead, UP)
        seen = (points @ cam[:3, :3].T + cam[:3, 3]) @ lens.T
        pixels.append(seen[:, :2] / seen[:, 2:] + random.normal(0, noise, (len(points), 2)))
    inside = [(np.abs(xy) < [WIDTH / 2, HEIGHT / 2]).all(axis=1) for xy in pixels]
    both = [a & b for a, b in pairwise(inside)]
    first = [xy[use] for xy, use in zip(pixels, both, strict=False)]
    second = [xy[use] for xy, use in zip(pixels[1:], both, strict=True)]
    unit = FOCAL if known else float(WIDTH)
    count = sum(map(len, first))
    return Matches(
        np.concatenate(first), np.concatenate(second), np.cumsum([0, *map(len, first[:-1])]),
        np.full((count, 2), unit), np.hypot(WIDTH, HEIGHT) / 2 / unit, known,
    )  # fmt: skip


def rough(x, y):
    return 4 + np.sin(3 * x) + np.cos(2 * y)


def bare(x, y):
    return np.full_like(x, 4.0)


SPOT = np.zeros((4, 3))
WALK = np.array([[0.4 * i, 0.1 * (-1) ** i, 0.0] for i in range(4)])


@pytest.mark.parametrize("known", [False, True])
def test_a_turn_explains_what_a_turn_made_at_any_depth(known):
    assert turned_px(matches(SPOT, known=known, depth=rough)) < 0.02
    noisy = turned_px(matches(SPOT, known=known, depth=rough, noise=0.1))
    # Of two photos' noise of 0.1 px in x and y, 9 of 10 lie within 0.1 * sqrt(2) * 2.146.
    assert noisy == pytest.approx(0.1 * np.sqrt(2) * 2.146, rel=0.15)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("looks", [0.0, 0.8])
def test_no_turn_explains_a_walk_not_even_along_a_bare_wall(known, looks):
    """A step of 0.4 at 4 m moves the wall by 22 px: parallax of the rough one is a quarter of that."""
    assert turned_px(matches(WALK, known=known, depth=rough, looks=looks)) > 4
    assert turned_px(matches(WALK, known=known, depth=bare, looks=looks)) > 0.7


def test_a_turn_behind_a_lens_other_than_the_known_one_is_left_alone():
    assert turned_px(matches(SPOT, known=True, depth=rough, focal=2 * FOCAL)) > 2
