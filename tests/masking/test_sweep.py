from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.masking import seek
from pipeline.masking.agreement import agreement
from pipeline.masking.sweep import Found, agreement_on, find_glass, prepared

sys.path.insert(0, str(Path(__file__).parent))

from pane_scene import cameras, wetness

from pipeline.masking.glass import GlassCamera, LensGlass, PaneGlass, pane_before


def test_agreement_by_hand() -> None:
    # Two cells, three views: between cells 6 (1 degree of freedom), within 4 / 4; (6 - 1) / (6 + 2 * 1).
    stack = np.array([[1, 3], [2, 4], [3, 5]], np.float32)
    assert agreement(stack) == pytest.approx(0.625)
    # A cell that two views see does not count; one that a fourth view does not see counts as before.
    more = np.array([[1, 3, 9], [2, 4, 0], [3, 5, np.nan], [np.nan, np.nan, np.nan]], np.float32)
    assert agreement(more) == pytest.approx(0.625)
    assert more[0, 2] == 9 and stack.sum() == 18  # they are looked at, not changed


def test_agreement_is_one_for_the_same_map_and_none_for_noise() -> None:
    rng = np.random.default_rng(1)
    same = rng.random((30, 40)).astype(np.float32)
    assert agreement(np.stack([same] * 4)) == pytest.approx(1.0)
    assert abs(agreement(rng.random((4, 60, 80)))) < 0.03
    assert agreement(np.zeros((4, 5, 5))) == 0.0
    assert agreement(np.stack([same] * 2)) == 0.0  # two views are too few


@pytest.mark.parametrize("tilts", [(0.0, 0.0), (20.0, -10.0)])
def test_the_plane_finds_itself(tilts: tuple[float, float]) -> None:
    views = cameras(10)
    cams = np.stack([v.cam_from_world for v in views])
    pane = pane_before(cams, 1.5, *tilts)
    rng = np.random.default_rng(0)
    # Attention of a detector that misses a fifth of the drops' pixels and sees some that are not there.
    maps = []
    for view in views:
        wet = wetness(pane, view)
        maps.append(np.where(rng.random(wet.shape) < 0.2, rng.random(wet.shape), wet))
    found = find_glass(maps, views, 4.0, at_least=0.3)
    assert found.mode == "pane"
    assert found.distance == pytest.approx(1.5, rel=0.02)
    assert abs(found.tilt_x_deg - tilts[0]) < 3
    assert abs(found.tilt_y_deg - tilts[1]) < 3
    assert found.pane_agreement > 0.4 > found.lens_agreement + 0.3


def test_drops_on_the_lens_are_known_by_their_pixels() -> None:
    views = cameras(10)
    pane = pane_before(np.stack([v.cam_from_world for v in views]), 1.5)
    still = wetness(pane, views[0])
    rng = np.random.default_rng(0)
    maps = [np.where(rng.random(still.shape) < 0.2, 0.5, still) for _ in views]
    assert find_glass(maps, views, 4.0, at_least=0.3).mode == "lens"


def test_no_glass_in_unrelated_maps_nor_in_a_common_gradient() -> None:
    views = cameras(10)
    rng = np.random.default_rng(0)
    shade = np.linspace(0, 1, views[0].height)[:, None]
    maps = [(shade + 0.3 * rng.random((60, 80))).astype(np.float32) for _ in views]
    assert find_glass(maps, views, 4.0, at_least=0.3).mode == "none"


def _turned(half_turns: list[int]) -> list[GlassCamera]:
    """Cameras side by side that look along z, or, where that is 1, the other way."""
    found = []
    for number, back in enumerate(half_turns):
        pose = np.diag([1.0 - 2 * back, 1.0, 1.0 - 2 * back, 1.0])
        pose[:3, 3] = [0.1 * number, 0, 0]
        found.append(GlassCamera(pose, (70.0, 70.0, 40.0, 30.0, 0.0), 80, 60))
    return found


def test_a_pane_on_which_some_agree_and_from_which_all_look_away_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of cameras all around, those that were swept may have another mean than all of them."""
    views = _turned([0, 0, 1, 1, 1, 1])
    pane = pane_before(np.stack([view.cam_from_world for view in views[:2]]), 0.5)
    with pytest.raises(ValueError, match="looks away"):
        PaneGlass(pane, views)
    found = Found("pane", 0.1, 0.8, pane, 0.5, 0.0, 0.0)
    monkeypatch.setattr(seek, "find_glass", lambda *told, **how: found)
    maps = [np.zeros((60, 80), np.float32) for _ in views]
    where, glass = seek.Seeker(views, 2.0, 0.3, "auto").first(maps)
    assert where.mode == "none" and isinstance(glass, LensGlass)


def test_some_views_agree_on_the_pane_of_all_wherever_their_own_mean_looks() -> None:
    views = _turned([0, 0, 0, 0, 1, 1])
    pane = pane_before(np.stack([view.cam_from_world for view in views[:4]]), 0.5)
    glass = PaneGlass(pane, views)
    maps = [None] * 3 + [np.random.default_rng(3).random((60, 80)).astype(np.float32)] * 3
    with pytest.raises(ValueError, match="looks away"):
        PaneGlass(pane, views[3:])
    assert np.isfinite(agreement_on(glass, maps))


def test_a_broad_gradient_is_taken_out_of_a_map_that_is_made_smaller() -> None:
    """A paraboloid stays one when areas are averaged; what is unknown of it changes nothing."""
    y, x = np.mgrid[-1:1:150j, -1:1:200j]
    values = (0.3 + 0.2 * x - 0.1 * y + 0.4 * x * y - 0.3 * x**2 + 0.2 * y**2).astype(np.float32)
    values[30:60, 80:120] = np.nan
    camera = GlassCamera(np.eye(4), (100, 100, 100, 75, 0), 200, 150)
    (small,), (smaller,) = prepared([values], [camera], 50)
    assert small.shape == (smaller.height, smaller.width) == (38, 50)
    # Ten cells by eight are wholly unknown; those at the rim count as long as half of them is known.
    assert 60 <= np.isnan(small).sum() <= 80 and np.nanmax(np.abs(small)) < 5e-3
