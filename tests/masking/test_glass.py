from __future__ import annotations

import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from pipeline.masking.agreement import tally_of
from pipeline.masking.glass import (
    GlassCamera,
    LensGlass,
    PaneGlass,
    gather,
    neighbours,
    pane_before,
    quantile_over_views,
)

sys.path.insert(0, str(Path(__file__).parent))

from pane_scene import cameras, wetness


def test_the_pane_lies_where_it_was_asked_for() -> None:
    facing = pane_before(np.eye(4)[None], 2.0)
    assert np.allclose(facing @ [0.3, -0.1, 2.0, 1], [0.3, -0.1, 0, 1])
    # Turned by 45 degrees about y: the axis still meets it at 2, and its x axis runs away from us.
    turned = pane_before(np.eye(4)[None], 2.0, 0.0, 45.0)
    assert np.allclose(turned @ [0, 0, 2.0, 1], [0, 0, 0, 1])
    assert np.allclose(turned @ [1, 0, 1.0, 1], [np.sqrt(2), 0, 0, 1])
    turned = pane_before(np.eye(4)[None], 2.0, 45.0, 0.0)
    assert np.allclose(turned @ [0, 1, 3.0, 1], [0, np.sqrt(2), 0, 1])


@pytest.mark.parametrize("tilts", [(0.0, 0.0), (20.0, -25.0)])
def test_views_agree_on_the_pane_and_get_their_map_back(tilts: tuple[float, float]) -> None:
    views = cameras(8)
    pane = pane_before(np.stack([v.cam_from_world for v in views]), 1.5, *tilts)
    maps = [wetness(pane, view) for view in views]
    glass = PaneGlass(pane, views)
    mean, votes = gather(glass, maps, range(8), None)
    shared = votes >= 2
    # Cells away from the discs' rims are wholly wet or wholly dry, whoever looks.
    assert (np.minimum(mean, 1 - mean)[shared] < 0.02).mean() > 0.75
    for index, own in enumerate(maps):
        back = glass.to_view(index, mean)
        assert np.isfinite(back).mean() > 0.98
        assert ((back > 0.5) == (own > 0.5))[np.isfinite(back)].mean() > 0.97


def test_a_tally_is_that_of_the_views_maps_on_the_glass() -> None:
    views = cameras(6, k1=-0.12)
    pane = pane_before(np.stack([v.cam_from_world for v in views]), 1.5, 10, 5)
    # Steep nowhere, so that the 32nds of a pixel in which maps are otherwise read do not show.
    maps = [np.hypot(*np.mgrid[0 : v.height, 0 : v.width]).astype(np.float32) / 99 for v in views]
    maps[2][20:30, 30:50] = np.nan  # has no vote there
    glass = PaneGlass(pane, views)
    found = glass.tally(maps)
    stacked = tally_of(np.stack([glass.from_view(v, values) for v, values in enumerate(maps)]))
    assert found.votes.min() == 0 and found.votes.max() == 6
    assert (found.votes != stacked.votes).mean() < 0.005  # beside NaN at a 64th of a pixel
    same = found.votes == stacked.votes
    assert np.allclose(found.total[same], stacked.total[same], atol=2e-3)
    assert np.allclose(found.squares[same], stacked.squares[same], atol=5e-3)


def test_there_and_back_through_a_lens_with_distortion() -> None:
    views = cameras(2, k1=-0.12)
    glass = PaneGlass(pane_before(np.stack([v.cam_from_world for v in views]), 1.5, 10, 5), views)
    rows, columns = np.mgrid[0 : views[0].height, 0 : views[0].width]
    for plane in (rows, columns):
        own = plane.astype(np.float32)
        back = glass.to_view(1, glass.from_view(1, own))
        inside = np.isfinite(back)
        inside[[0, -1]] = inside[:, [0, -1]] = False  # beside the rim there is no neighbour to mix
        assert inside.mean() > 0.8
        assert np.abs(back - own)[inside].max() < 0.05


def test_a_wide_lens_shows_nothing_from_beyond_its_fold() -> None:
    """At 90 degrees across and k1 = -0.12 the picture turns back 59 degrees off the axis."""
    width, height, focal, k1 = 160, 120, 80.0, -0.12
    views = []
    for x in (-0.9, -0.3, 0.3, 0.9):
        pose = np.eye(4)
        pose[0, 3] = x
        views.append(GlassCamera(pose, (focal, focal, width / 2, height / 2, k1), width, height))
    glass = PaneGlass(pane_before(np.stack([v.cam_from_world for v in views]), 1.0), views)
    ones = np.ones((height, width), np.float32)
    rows, columns = np.indices(glass.shape)
    cells = [glass.low[0] + (columns + 0.5) * glass.cell, glass.low[1] + (rows + 0.5) * glass.cell]
    folded = 0
    for view in range(len(views)):
        x, y, z = np.einsum(
            "ij,jrc->irc", glass.view_from_glass(view), [*cells, np.ones(glass.shape)]
        )
        beyond = 1 + 3 * k1 * (x**2 + y**2) / z**2 <= 0
        assert not np.isfinite(glass.from_view(view, ones))[beyond].any()
        folded += int(beyond.sum())
    votes = sum(np.isfinite(glass.from_view(view, ones)) for view in range(len(views)))
    assert folded > 1000 and np.array_equal(glass.tally([ones] * len(views)).votes, votes)


def test_a_pane_behind_the_cameras_is_refused() -> None:
    views = cameras(2)
    with pytest.raises(ValueError, match="looks away"):
        PaneGlass(pane_before(np.stack([v.cam_from_world for v in views]), -2.0), views)


def test_the_raster_stays_within_its_limit() -> None:
    views = cameras(3)
    pane = pane_before(np.stack([v.cam_from_world for v in views]), 1.5)
    rows, columns = PaneGlass(pane, views, max_cells=1000).shape
    assert 800 < rows * columns < 1100


def test_on_the_lens_the_mean_is_the_one_of_equation_5() -> None:
    maps = [np.array([[0.9, 0.0]], np.float32), np.array([[0.3, np.nan]], np.float32), None]
    mean, votes = gather(LensGlass(1, 2), maps, range(3), None)
    assert np.allclose(mean, [[0.6, 0.0]])
    assert votes.tolist() == [[2, 1]]


def test_quantiles_by_hand() -> None:
    stack = np.array([[4.0, np.nan, np.nan], [1.0, 7.0, np.nan], [2.0, 5.0, np.nan]], np.float32)
    assert np.allclose(quantile_over_views(stack, 0.5), [2.0, 6.0, np.nan], equal_nan=True)
    assert np.allclose(quantile_over_views(stack, 0.25)[:2], [1.5, 5.5])
    assert np.allclose(quantile_over_views(stack, 1.0)[:2], [4.0, 7.0])


def test_windows_hold_neighbours_and_stay_inside() -> None:
    assert neighbours(10, 4, 0) == range(10)
    assert neighbours(10, 4, 3) == range(3, 6)
    assert neighbours(10, 0, 3) == range(3)
    assert neighbours(10, 9, 3) == range(7, 10)
    assert neighbours(5, 2, 9) == range(5)


def test_some_rows_of_the_glass_are_those_of_all() -> None:
    views = cameras(3, k1=-0.1)
    glass = PaneGlass(pane_before(np.stack([v.cam_from_world for v in views]), 1.5, 10, 5), views)
    own = np.random.default_rng(0).random((views[1].height, views[1].width)).astype(np.float32)
    some = slice(30, 50)
    for one in (glass, LensGlass(*own.shape)):
        whole = one.from_view(1, own)
        assert np.array_equal(one.from_view(1, own, some), whole[some], equal_nan=True)


def test_what_is_gathered_a_few_rows_at_a_time_is_what_all_at_once_give() -> None:
    rng = np.random.default_rng(3)
    stack = rng.random((5, 150, 7)).astype(np.float32)
    stack[rng.random(stack.shape) < 0.3] = np.nan
    stack[:, 140] = np.nan
    known = np.isfinite(stack)
    for quantile in (None, 0.3):
        found, votes = gather(LensGlass(150, 7), list(stack), range(5), quantile)
        assert np.array_equal(votes, known.sum(axis=0)) and found.dtype == np.float32
        with np.errstate(invalid="ignore"):
            means = np.nansum(stack, axis=0, dtype=np.float64) / known.sum(axis=0)
        whole = quantile_over_views(stack, quantile) if quantile else means.astype(np.float32)
        assert np.array_equal(found, whole, equal_nan=True)
    masks = [stack[view] > 0.5 for view in range(5)]
    assert np.allclose(gather(LensGlass(150, 7), masks, range(5), None)[0], np.mean(masks, axis=0))


def test_a_quantile_does_not_hold_every_view_on_the_glass() -> None:
    views = cameras(40)
    glass = PaneGlass(pane_before(np.stack([v.cam_from_world for v in views]), 1.5), views)
    glass.cell /= 5  # many more cells than pixels, as on a pane along which the photos go
    glass.shape = (5 * glass.shape[0], 5 * glass.shape[1])
    maps = [wetness(glass.pane_from_world, view) for view in views]
    glass.from_view(0, maps[0])  # compiled
    tracemalloc.start()
    gather(glass, maps, range(40), 0.5)
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 0.6 * 40 * 4 * glass.shape[0] * glass.shape[1]
