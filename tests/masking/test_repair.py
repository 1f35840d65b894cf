from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
import pytest

from pipeline.masking.account import account
from pipeline.masking.glass import GlassCamera, pane_before
from pipeline.masking.loop import repair
from tests.masking.pane_scene import cameras, wetness


def _look_at(wet: list[np.ndarray]):  # type: ignore[no-untyped-def]
    """A scene that disagrees with the photos exactly where they are wet."""
    rng = np.random.default_rng(0)

    def look(drop_masks: Sequence[np.ndarray], found: object) -> list[np.ndarray | None]:
        residuals: list[np.ndarray | None] = [
            np.where(one > 0.5, 0.1, rng.uniform(0.008, 0.012, one.shape)).astype(np.float32)
            for one in wet
        ]
        residuals[0] = None
        return residuals

    return look


def _iou(drop_masks: Sequence[np.ndarray], wet: list[np.ndarray]) -> float:
    pairs = [(mask, one > 0.5) for mask, one in zip(drop_masks, wet, strict=True)]
    return sum((a & b).sum() for a, b in pairs) / sum((a | b).sum() for a, b in pairs)


def _views() -> tuple[list[GlassCamera], np.ndarray]:
    views = cameras(10)
    return views, pane_before(np.stack([view.cam_from_world for view in views]), 1.5)


def test_drops_on_a_pane_are_found_from_what_the_scene_says() -> None:
    views, pane = _views()
    wet = [wetness(pane, view) for view in views]
    rng = np.random.default_rng(1)
    maps = [np.where(rng.random(one.shape) < 0.1, rng.random(one.shape), one) for one in wet]
    drawn = [seen > 0.3 for seen in maps]
    done = repair(_look_at(wet), maps, views, drawn, 4.0, rounds=2)
    assert done.rounds[-1].found.mode == "pane"
    assert len(done.rounds) > 1
    assert _iou(done.rounds[-1].drop_masks, wet) > max(0.8, _iou(drawn, wet))
    # The attention showed the pane: how the residuals agree on the lens was not looked at.
    told = account(done, [str(view) for view in range(len(views))])["rounds"]
    assert told["0"]["lens_agreement"] < 0.3 and told["1"]["lens_agreement"] is None
    assert told["1"]["pane_agreement"] > 0.3
    json.dumps(told, allow_nan=False)


def test_drops_on_the_lens_and_no_drops() -> None:
    views, pane = _views()
    views = views[:6]
    wet = [wetness(pane, views[0])] * len(views)
    done = repair(_look_at(wet), wet, views, [one > 2 for one in wet], 4.0, rounds=3)
    assert done.rounds[-1].found.mode == "lens"
    assert done.ended == "the masks have settled"
    assert _iou(done.rounds[-1].drop_masks, wet) > 0.95

    dry = [np.zeros(one.shape, np.float32) for one in wet]
    drawn = [np.zeros(one.shape, bool) for one in wet]
    drawn[3][10:20, 10:20] = True
    rng = np.random.default_rng(2)
    noise = [rng.random(one.shape).astype(np.float32) * 0.1 for one in dry]
    done = repair(_look_at(dry), noise, views, drawn, 4.0, rounds=3)
    assert len(done.rounds) == 1
    assert all(np.array_equal(a, b) for a, b in zip(done.rounds[-1].drop_masks, drawn, strict=True))


def test_a_scene_that_is_wrong_everywhere_does_not_redraw_good_masks() -> None:
    views, pane = _views()
    wet = [wetness(pane, views[0])] * len(views)
    rng = np.random.default_rng(3)

    def look(drop_masks: Sequence[np.ndarray], found: object) -> list[np.ndarray | None]:
        """Wet pixels differ, and so do patches that lie elsewhere in every view."""
        height, width = wet[0].shape
        patches = [rng.random((height // 12, width // 12)) < 0.25 for _ in wet]
        return [
            np.where((one > 0.5) | (cv2.resize(patch.astype(np.uint8), (width, height)) > 0), 0.1, 0.01)
            .astype(np.float32)
            for one, patch in zip(wet, patches, strict=True)
        ]  # fmt: skip

    drawn = [one > 0.3 for one in wet]
    done = repair(look, wet, views, drawn, 4.0, rounds=3, gather_attention=False)
    assert len(done.rounds) == 1
    assert "agrees too little on the lens" in done.ended
    assert all(np.array_equal(a, b) for a, b in zip(done.rounds[0].drop_masks, drawn, strict=True))
    # Where no attention was asked, the residual is all there is, and it is followed.
    alone = repair(look, wet, views, drawn, 4.0, rounds=1, use_attention=False, contrast=1.0)
    assert len(alone.rounds) == 2


@pytest.mark.parametrize(("standing", "farthest"), [(True, 4.0), (False, 0.2)])
def test_a_pane_that_nobody_can_find_is_not_taken_for_the_lens(
    standing: bool, farthest: float
) -> None:
    """From one place, or from places too far apart for what they see, no distance of a pane can be told."""
    views, pane = _views()
    views = [views[0]] * 6 if standing else views
    wet = [wetness(pane, views[0])] * len(views)
    drawn = [one > 0.5 for one in wet]
    fits: list[object] = []

    def look(drop_masks: Sequence[np.ndarray], found: object) -> list[np.ndarray | None]:
        fits.append(found)
        return list(wet)

    done = repair(look, wet, views, drawn, farthest, rounds=2, mode="pane")
    assert [one.found.mode for one in done.rounds] == ["none"] and not fits
    assert done.ended.startswith("refine.mode is pane, but no plane is within reach")
    assert all(np.array_equal(a, b) for a, b in zip(done.rounds[0].drop_masks, drawn, strict=True))


@pytest.mark.parametrize("mode", ["pane", "lens"])
@pytest.mark.parametrize("size", [(3, 39), (24, 32)])
def test_a_residual_that_is_the_same_everywhere_redraws_nothing(
    mode: Literal["pane", "lens"], size: tuple[int, int]
) -> None:
    """But for the rounding of its floats."""
    height, width = size
    lens = (35.0, 35.0, width / 2, height / 2, 0.0)
    views = [one._replace(intrinsics=lens, width=width, height=height) for one in cameras(5)]
    pane = pane_before(np.stack([view.cam_from_world for view in views]), 1.5)
    wet = [wetness(pane, view) for view in views]
    drawn = [one > 0.5 for one in wet]
    rng = np.random.default_rng(0)

    def look(drop_masks: Sequence[np.ndarray], found: object) -> list[np.ndarray | None]:
        return [rng.uniform(0.1, 0.1 + 1e-6, size).astype(np.float32) for _ in views]

    done = repair(look, wet, views, drawn, 4.0, rounds=1, mode=mode, use_attention=False,
                  gather_attention=False)  # fmt: skip
    assert len(done.rounds) == 1 and done.rounds[0].found.mode == mode
    assert all(np.array_equal(a, b) for a, b in zip(done.rounds[0].drop_masks, drawn, strict=True))


def test_where_no_surface_has_witnesses_it_is_told_so() -> None:
    views = cameras(4)
    shape = (views[0].height, views[0].width)
    masks, dry = [np.zeros(shape, bool)] * 4, [np.zeros(shape, np.float32)] * 4
    blind: list[np.ndarray | None] = [np.full(shape, np.nan, np.float32)] * 4
    done = repair(
        lambda drop_masks, found: blind, dry, views, masks, 3.0,
        rounds=2, mode="lens", use_attention=False, gather_attention=False,
    )  # fmt: skip
    assert (
        len(done.rounds) == 1 and done.ended == "there is too little to tell drops from the rest by"
    )
