from __future__ import annotations

import numpy as np
import pytest

from pipeline.masking.agreement import agreement
from pipeline.masking.align import aligned
from pipeline.masking.glass import GlassCamera, PaneGlass, gather, pane_before
from pipeline.masking.seek import cover
from pipeline.masking.sweep import agreement_on
from tests.masking.pane_scene import cameras, wetness


def _scene(off: tuple[float, float, float]) -> tuple[PaneGlass, list[np.ndarray]]:
    """A pane 1.5 away and its maps; the glass knows the cameras only to within `off`."""
    views = cameras(8)
    pane = pane_before(np.stack([v.cam_from_world for v in views]), 1.5)
    maps = [wetness(pane, view) for view in views]
    rng = np.random.default_rng(2)
    wrong: list[GlassCamera] = []
    for view in views:
        pose = view.cam_from_world.copy()
        pose[:3, 3] += rng.uniform(-1, 1, 3) * off
        wrong.append(view._replace(cam_from_world=pose))
    return PaneGlass(pane, wrong), maps


def _blur(glass: PaneGlass, maps: list[np.ndarray]) -> float:
    """How far the mean of maps of zeros and ones is from both, where three views look."""
    mean, votes = gather(glass, maps, range(len(maps)), None)
    return float(np.minimum(mean, 1 - mean)[votes >= 3].mean())


# 0.04 across is two pixels on the pane; 0.08 along the axis makes a drop at the frame's side stand two
# pixels farther out.
@pytest.mark.parametrize("off", [(0.04, 0.04, 0.0), (0.0, 0.0, 0.08), (0.04, 0.04, 0.08)])
def test_views_with_poses_a_little_off_are_brought_to_cover(
    off: tuple[float, float, float],
) -> None:
    exact, maps = _scene((0.0, 0.0, 0.0))
    glass, _ = _scene(off)
    before, best = _blur(glass, maps), _blur(exact, maps)
    agreed = agreement_on(glass, maps)
    glass.moved = aligned(glass, maps, 6)
    # What is lost by the poses is won back, but for a third at most.
    assert _blur(glass, maps) - best < (before - best) / 3
    assert agreement_on(glass, maps) > agreed


def test_views_that_cover_each_other_stay_and_so_do_those_without_maps() -> None:
    glass, maps = _scene((0.0, 0.0, 0.0))
    moved = aligned(glass, maps, 6)
    pixel = 1.5 / 70
    assert np.abs(moved[:, :2]).max() < 0.5 * pixel
    assert not aligned(glass, [None, *maps[1:]], 6)[0].any()
    assert not aligned(glass, [*maps[:2], *[None] * 6], 6).any()


def test_how_well_views_cover_each_other_is_their_agreement_cell_by_cell() -> None:
    glass, maps = _scene((0.02, 0.02, 0.0))
    stack = np.stack([glass.from_view(view, seen) for view, seen in enumerate(maps)])
    assert cover(glass, maps) == pytest.approx(agreement(stack), abs=5e-3)


def test_a_dry_pane_moves_no_camera() -> None:
    glass, maps = _scene((0.0, 0.0, 0.0))
    assert np.abs(aligned(glass, [np.zeros_like(one) for one in maps], 6)).max() < 1e-9
