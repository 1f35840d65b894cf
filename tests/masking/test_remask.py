from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from pipeline.masking.glass import EVERY, LensGlass
from pipeline.masking.masks import automatic_threshold, otsu
from pipeline.masking.remask import SPILL, opened, redraw, without_holes, without_spill
from pipeline.masking.residual import exposure, residual
from pipeline.masking.views import (
    attention_on_glass,
    changed_share,
    fewest_votes,
    redraw_views,
)


def test_otsu_parts_two_heaps_in_their_middle() -> None:
    values = np.array([0.0, 0.1, 0.2, 4.0, 4.1, 4.2, 4.3])
    assert 0.2 < otsu(values) < 4.0
    assert otsu(np.array([3.0, 3.0])) == 3.0
    # By hand: of the cuts of 0, 1, 5 the one after 1 leaves (0.5 ** 2) * 2, after 0 it leaves 4 * 2.
    assert 1.0 < otsu(np.array([0.0, 1.0, 5.0])) < 5.0


def test_the_automatic_threshold_parts_wet_from_dry_within_bounds() -> None:
    wet = np.concatenate([np.full(700, 0.1), np.full(300, 0.9)]).reshape(20, 50)
    assert automatic_threshold([wet]) == 0.5
    assert automatic_threshold([wet * 0.1]) == 0.2
    assert automatic_threshold([1 - 0.1 * wet]) == 0.6


def test_water_has_no_holes_but_a_ring_of_drops_may_stand_around_dry_glass() -> None:
    drop_mask = np.zeros((40, 60), bool)
    drop_mask[5:15, 5:15] = True
    drop_mask[9:11, 9:12] = False  # 6 of 100: a hole
    drop_mask[10:35, 25:50] = True
    drop_mask[12:33, 27:48] = False  # 441 inside a frame of 184: dry
    drop_mask[20, 0] = True
    filled = without_holes(drop_mask)
    assert filled[5:15, 5:15].all()
    assert not filled[20, 30]
    assert filled.sum() == drop_mask.sum() + 6
    assert not without_holes(np.zeros((4, 4), bool)).any()


def test_a_hole_that_another_drop_stands_in_is_still_a_hole() -> None:
    drop_mask = np.zeros((30, 30), bool)
    drop_mask[2:28, 2:28] = True  # 676 less the hole
    drop_mask[10:20, 10:20] = False
    drop_mask[14, 14] = True  # labelled after the drop around it, and smaller
    assert without_holes(drop_mask)[2:28, 2:28].all()
    turned = without_holes(drop_mask[::-1, ::-1])
    assert np.array_equal(turned, without_holes(drop_mask)[::-1, ::-1])
    # Dry glass inside a thin ring stays dry, with a drop in it or without.
    ring = np.zeros((30, 30), bool)
    ring[2:28, 2:28] = True
    ring[3:27, 3:27] = False
    ring[14, 14] = True
    assert np.array_equal(without_holes(ring), ring)


def test_opening_keeps_squares_and_drops_lines() -> None:
    drop_mask = np.zeros((9, 9), bool)
    drop_mask[1:4, 1:4] = True
    drop_mask[7, :] = True
    assert np.array_equal(np.argwhere(opened(drop_mask)), np.argwhere(drop_mask[:6]))


def test_a_drop_is_where_the_residual_is_large_and_old_masks_stay_where_nobody_votes() -> None:
    gathered = np.full((30, 40), 0.01, np.float32)
    gathered[5:15, 5:15] = 0.1
    votes = np.full((30, 40), 5)
    votes[:, 30:] = 1
    gathered[:, 35:] = np.nan
    previous = np.zeros((30, 40), bool)
    previous[20:25, 28:38] = True
    found = redraw(gathered, votes, previous, 2, reach=8, spill=2, join=0.5)
    expected = np.zeros((30, 40), bool)
    expected[5:15, 5:15] = True
    expected[20:25, 30:38] = True
    assert np.array_equal(found.drop_mask, expected)
    assert found.known.mean() == pytest.approx(0.75)
    assert found.contrast == pytest.approx(10.0, rel=1e-3)
    assert 1 < found.level < 10


def test_evidence_spills_from_the_strongest_cell_nearby_by_hand() -> None:
    score = np.zeros((7, 9), np.float32)
    score[3, 3] = 10.0
    score[3, 8] = 50.0
    known = np.ones(score.shape, bool)
    known[3, 8] = False
    found = without_spill(score, known, 2.3)
    expected = np.zeros(score.shape)
    rows, columns = np.indices(score.shape)
    expected[(rows - 3) ** 2 + (columns - 3) ** 2 <= 5] = -10 * SPILL  # a knight's move away, too
    expected[3, 3] = 10 - 10 * SPILL
    assert np.allclose(found[known], expected[known])
    # Reaching no neighbour, every cell gives up the same share, and their order stays.
    assert np.allclose(without_spill(score, known, 0.9)[known], (1 - SPILL) * score[known])


def test_blur_carries_a_strong_drop_no_farther_over_its_rim_than_need_be() -> None:
    rows, columns = np.indices((80, 160))
    strong, faint = (np.hypot(rows - 40, columns - middle) < 12 for middle in (40, 120))
    gathered = cv2.GaussianBlur(
        (0.01 + 0.29 * strong + 0.05 * faint).astype(np.float32), (0, 0), 1.0
    )
    votes, nowhere = np.full(strong.shape, 9), np.zeros(strong.shape, bool)

    def radii(spill: float) -> list[float]:
        found = redraw(gathered, votes, nowhere, 1, reach=20, spill=spill, join=0.5).drop_mask
        return [math.sqrt(half.sum() / math.pi) for half in (found[:, :80], found[:, 80:])]

    (before, faint_before), (after, faint_after) = radii(0), radii(4.5)
    assert faint_after < after < before  # and all of them beyond the true 11.8
    assert faint_after > math.sqrt(faint.sum() / math.pi)
    assert after - faint_after < 0.6 * (before - faint_before)


def test_with_attention_one_vote_is_enough_and_without_it_more_must_look() -> None:
    assert fewest_votes(LensGlass(4, 4), 21, with_attention=True) == 1
    assert fewest_votes(LensGlass(4, 4), 21, with_attention=False) == 5
    assert fewest_votes(LensGlass(4, 4), 3, with_attention=False) == 2
    drop = np.zeros((30, 40), bool)
    drop[8:20, 8:20] = True
    residuals: list[np.ndarray | None] = []
    for view in range(8):
        values = np.where(drop, 0.1, 0.01).astype(np.float32)
        values[:, :14] = values[:, :14] if view == 5 else np.nan  # half the drop: seen by one
        residuals.append(values)
    attentions = [np.where(drop, 0.8, 0.1).astype(np.float32)] * 8
    old = [np.zeros(drop.shape, bool)] * 8
    told = redraw_views(LensGlass(30, 40), residuals, old, quantile=0.5, attentions=attentions)
    assert np.array_equal(told.drop_masks[0], drop)
    alone = redraw_views(LensGlass(30, 40), residuals, old, quantile=0.5)
    assert not alone.drop_masks[0][:, :14].any() and alone.drop_masks[0][8:20, 15:19].all()


def test_cells_without_votes_do_not_eat_the_drop_around_them() -> None:
    rng = np.random.default_rng(0)
    wet = np.hypot(*(np.indices((60, 60)) - 30)) < 12
    gathered = np.where(wet, 0.1, 0.01 + 0.002 * rng.random(wet.shape)).astype(np.float32)
    votes = np.where(rng.random(wet.shape) < 0.4, 0, 9)  # scattered: no 3x3 square is without one
    found = redraw(gathered, votes, wet, 2, reach=10, spill=2, join=0.5)
    # But for corners that no 3x3 square fits into.
    assert (found.drop_mask & wet).sum() > 0.97 * wet.sum()
    assert not (found.drop_mask & ~wet).any()


def test_without_any_votes_the_old_mask_stays() -> None:
    previous = np.eye(5, dtype=bool)
    found = redraw(
        np.full((5, 5), np.nan, np.float32),
        np.zeros((5, 5)),
        previous,
        1,
        reach=2,
        spill=1,
        join=0.5,
    )
    assert np.array_equal(found.drop_mask, previous)
    assert math.isnan(found.contrast)


def test_the_exposure_is_matched_and_the_rest_is_residual() -> None:
    rng = np.random.default_rng(0)
    render = rng.uniform(0.2, 0.6, (40, 40, 3)).astype(np.float32)
    gain = np.array([1.2, 0.9, 1.1], np.float32)
    photo = render * gain
    keep_mask = np.ones((40, 40), bool)
    keep_mask[10:20, 10:20] = False
    photo[10:20, 10:20] = 0.0  # a black drop: covered, so it does not count for the exposure
    assert np.allclose(exposure(render, photo, keep_mask), gain, atol=1e-4)
    sure = np.ones((40, 40), bool)
    sure[30:] = False
    found = residual(render, photo, keep_mask, sure)
    assert np.isnan(found[30:]).all()
    assert found[24:30].max() < 1e-4  # unsure neighbours do not bleed in
    assert found[14:16, 14:16].min() > 0.2
    assert np.nanmax(found) <= 0.3 + 1e-6


def test_grain_is_blurred_before_its_absolute_value_in_proportion_to_the_picture() -> None:
    grain = np.float32(0.1) * (1 - 2 * (np.indices((60, 1000)).sum(axis=0) % 2))
    photo = np.full((60, 1000, 3), 0.5, np.float32)
    render = photo + grain[..., None]
    nowhere = np.zeros(grain.shape, bool)  # kept: the exposure is taken as it is

    def left(width: int) -> float:
        part = render[:, :width], photo[:, :width], nowhere[:, :width], ~nowhere[:, :width]
        return float(residual(*part)[5:-5, 5:-5].mean())

    # A chequerboard falls by exp(-pi^2 sigma^2), sigma 2 px at 1000 pixels, 0.2 at 100.
    assert left(1000) < 1e-3
    assert left(400) == pytest.approx(0.1 * np.exp(-(np.pi**2) * 0.8**2), abs=2e-3)
    assert left(100) > 0.06


def _drop_scene() -> tuple[list[np.ndarray | None], np.ndarray]:
    """Residuals of six views with one drop on the lens; each view has a false blob elsewhere."""
    rng = np.random.default_rng(3)
    drop = np.zeros((40, 50), bool)
    drop[10:20, 10:22] = True
    residuals: list[np.ndarray | None] = []
    for view in range(6):
        values = rng.uniform(0.008, 0.012, drop.shape).astype(np.float32)
        values[drop] = 0.12
        values[25:32, 7 * view : 7 * view + 6] = 0.2
        residuals.append(values)
    residuals[2] = None  # held out
    return residuals, drop


def test_what_stays_on_the_lens_is_a_drop_and_what_does_not_is_given_back() -> None:
    residuals, drop = _drop_scene()
    old = [np.zeros(drop.shape, bool) for _ in residuals]
    for mask in old:
        mask[30:38, 40:48] = True  # clean, as the residual shows
    found = redraw_views(LensGlass(40, 50), residuals, old, quantile=0.5)
    assert all(np.array_equal(mask, drop) for mask in found.drop_masks)
    assert found.known == 1.0
    assert changed_share(old, found.drop_masks) == pytest.approx((120 + 64) / 2000)


class _CoarseGlass:
    """Cells of 4x4 pixels."""

    shape = (16, 16)

    def from_view(self, view: int, values: np.ndarray, rows: slice = EVERY) -> np.ndarray:
        return cv2.resize(values.astype(np.float32), self.shape, interpolation=cv2.INTER_AREA)[rows]

    def to_view(self, view: int, values: np.ndarray) -> np.ndarray:
        return cv2.resize(values.astype(np.float32), (64, 64), interpolation=cv2.INTER_LINEAR)


def test_rims_run_between_cells() -> None:
    apart = np.hypot(*(np.indices((64, 64)) - 31.5))
    residuals = [
        np.float32(0.01) * 10 ** np.clip(0.5 + (18 - apart) / 12, 0, 1).astype(np.float32)
    ] * 3
    old = [np.zeros((64, 64), bool)] * 3

    def roundness(drop_mask: np.ndarray) -> float:
        discs = [apart < radius for radius in np.arange(14, 24, 0.25)]
        return max((disc & drop_mask).sum() / (disc | drop_mask).sum() for disc in discs)

    glass = _CoarseGlass()
    found = redraw_views(glass, residuals, old, quantile=0.5)
    assert roundness(found.drop_masks[0]) > 0.97
    cells = redraw(
        glass.from_view(0, residuals[0]), np.full((16, 16), 3), np.zeros((16, 16), bool), 1,
        reach=3.2, spill=1, join=0.5,
    )  # fmt: skip
    assert np.array_equal(cells.margin > 0, cells.drop_mask)
    blocks = np.kron(cells.drop_mask, np.ones((4, 4), bool))
    assert roundness(blocks) < 0.96


def test_a_window_follows_a_creeping_drop() -> None:
    count = 12
    residuals: list[np.ndarray | None] = []
    truth = []
    for view in range(count):
        drop = np.zeros((30, 60), bool)
        drop[10:20, 3 * view : 3 * view + 10] = True
        residuals.append(np.where(drop, 0.1, 0.01).astype(np.float32))
        truth.append(drop)
    old = [np.zeros((30, 60), bool)] * count

    def overlap(width: int) -> float:
        found = redraw_views(LensGlass(30, 60), residuals, old, quantile=0.5, width=width)
        pairs = list(zip(found.drop_masks, truth, strict=True))
        return sum((a & b).sum() for a, b in pairs) / sum((a | b).sum() for a, b in pairs)

    assert overlap(3) > 0.85
    assert overlap(0) < 0.2


def test_attention_averaged_on_the_glass_by_hand() -> None:
    maps = [np.array([[0.9, 0.5, 0.0]], np.float32), np.array([[0.5, 0.0, 0.1]], np.float32)]
    old = [np.zeros((1, 3), bool)] * 2
    # Otsu parts 0.1 from 0.5 in the middle: 0.3, of which 0.6 are 0.18. The means: 0.7, 0.25, 0.05.
    found = attention_on_glass(LensGlass(1, 3), maps, old)
    assert [mask.tolist() for mask in found] == [[[True, True, False]]] * 2


def test_what_is_kept_of_an_old_mask_is_grown_once() -> None:
    """An old drop lies where nobody votes; in round after round it stays as it was drawn."""
    drop, kept = np.zeros((60, 90), bool), np.zeros((60, 90), bool)
    drop[20:40, 50:70], kept[10:20, 5:15] = True, True
    residual = np.where(drop, 0.1, 0.01).astype(np.float32)
    residual[:, :25] = np.nan
    masks = [drop | kept] * 6
    for _ in range(3):
        found = redraw_views(LensGlass(60, 90), [residual] * 6, masks, quantile=0.5, dilation=2)
        masks = found.drop_masks
        assert np.array_equal(masks[0][:, :25], kept[:, :25])
        assert masks[0][30, 48] and masks[0][30, 71] and not masks[0][30, 47]


def test_neighbours_without_a_residual_leave_the_others_believed() -> None:
    drop = np.zeros((30, 60), bool)
    drop[10:20, 10:20] = True
    blind = np.full(drop.shape, np.nan, np.float32)
    seen = np.where(drop, 0.1, 0.01).astype(np.float32)
    nothing = [np.zeros(drop.shape, bool)] * 12
    found = redraw_views(
        LensGlass(30, 60), [blind] * 6 + [seen] * 6, nothing, quantile=0.5, width=3
    )
    assert found.contrast == pytest.approx(10)
    assert np.array_equal(found.drop_masks[-1], drop) and not found.drop_masks[0].any()
    found = redraw_views(LensGlass(30, 60), [blind] * 12, nothing, quantile=0.5, width=3)
    assert math.isnan(found.contrast) and math.isnan(found.level)
