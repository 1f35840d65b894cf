from __future__ import annotations

import numpy as np
import pytest

from pipeline.masking.masks import (
    automatic_threshold,
    chosen_threshold,
    dilate,
    drop_mask_of,
    enhanced,
    lens_fixedness,
    on_the_lens,
    otsu,
    threshold,
    together,
    without_specks,
)


def test_equation_3_by_hand() -> None:
    attention = np.array([[0.1, 0.3, 0.31], [0.9, 0.0, 0.29]], np.float32)
    assert np.array_equal(threshold(attention, 0.3), attention > 0.3)
    assert threshold(attention, 0.305).tolist() == [[False, False, True], [True, False, False]]


def test_equation_5_by_hand() -> None:
    # The drop at the left is seen in the first two of three maps: its mean is 0.6 > 0.5, so the third
    # view's mask has it too. The false alarm in the middle stays in its own view (mean 0.3).
    maps = [
        np.array([[0.9, 0.0, 0.1]], np.float32),
        np.array([[0.9, 0.9, 0.1]], np.float32),
        np.array([[0.0, 0.0, 0.1]], np.float32),
    ]
    count, votes, mean = together(iter(maps), 0.5)
    assert np.allclose(mean, [[0.6, 0.3, 0.1]]) and mean.dtype == np.float32
    assert count == 3 and votes.tolist() == [[2, 1, 0]]
    assert enhanced(maps[0], mean, 0.5).tolist() == [[True, False, False]]
    assert enhanced(maps[1], mean, 0.5).tolist() == [[True, True, False]]
    assert enhanced(maps[2], mean, 0.5).tolist() == [[True, False, False]]


@pytest.mark.parametrize("apart", [0, 1, 40, 100_000])
def test_values_that_are_all_but_equal_have_nothing_above(apart: int) -> None:
    """256 steps need floats between them: of single precision some hundred apart, next to 0.1."""
    low = np.float32(0.1)
    values = np.array([low, low + apart * np.spacing(low), low])
    assert values.dtype == np.float32
    t = otsu(values)
    assert (values <= t).all() if apart < 256 else (values > t).tolist() == [False, True, False]


def test_the_mean_alone_forgets_what_one_view_sees() -> None:
    attention, mean = np.array([[0.9, 0.9, 0.1]]), np.array([[0.6, 0.3, 0.1]])
    assert drop_mask_of(attention, None, 0.5).tolist() == [[True, True, False]]
    assert drop_mask_of(attention * 0.5, mean, 0.5).tolist() == [[True, False, False]]
    assert drop_mask_of(attention, mean, 0.5).tolist() == [[True, True, False]]
    assert drop_mask_of(attention, mean, 0.5, mean_alone=True).tolist() == [[True, False, False]]


def test_a_mean_needs_a_map() -> None:
    with pytest.raises(ValueError, match="no attention maps"):
        together([], 0.5)


def test_dilation_grows_a_point_to_a_disc() -> None:
    drop_mask = np.zeros((11, 11), bool)
    drop_mask[5, 5] = True
    grown = dilate(drop_mask, 2)
    rows, columns = np.nonzero(grown)
    assert np.hypot(rows - 5, columns - 5).max() == 2
    assert grown[5, 3:8].all()
    assert grown[3:8, 5].all()
    assert np.array_equal(dilate(drop_mask, 0), drop_mask)
    assert np.array_equal(dilate(drop_mask, 1) & drop_mask, drop_mask)


def test_specks_go_and_drops_stay() -> None:
    drop_mask = np.zeros((8, 8), bool)
    drop_mask[0, 0] = True
    drop_mask[4:7, 4:7] = True
    cleaned = without_specks(drop_mask, 4)
    assert not cleaned[0, 0]
    assert cleaned.sum() == 9
    assert np.array_equal(without_specks(drop_mask, 0), drop_mask)


def test_drops_that_never_move_agree_and_independent_ones_do_not() -> None:
    rng = np.random.default_rng(0)
    still = (rng.random((60, 80)) > 0.8).astype(np.float32)
    assert lens_fixedness(together([still] * 5, 0.5)) == pytest.approx(1.0)
    moving = [(rng.random((60, 80)) > 0.8).astype(np.float32) for _ in range(5)]
    assert abs(lens_fixedness(together(moving, 0.5))) < 0.02


def test_nothing_marked_is_not_lens_fixed() -> None:
    assert lens_fixedness(together([np.zeros((4, 4), np.float32)] * 3, 0.5)) == 0.0
    assert lens_fixedness(together([np.ones((4, 4), np.float32)] * 3, 0.5)) == 0.0


def test_whether_drops_are_on_the_lens_is_what_the_maps_say_or_the_user() -> None:
    # Of two pixels each map marks one: chance would have half of the pairs agree (p = 1/2).
    left, right = np.array([[0.9, 0.1]], np.float32), np.array([[0.1, 0.9]], np.float32)
    still, moving = together([left] * 3, 0.5), together([left, right, left], 0.5)
    # Of six ordered pairs of marks two agree: (1/3 - 1/2) / (1 - 1/2).
    assert lens_fixedness(moving) == pytest.approx(-1 / 3)
    assert on_the_lens(still, "auto", 0.3) == (True, "the maps agree to 1.00 >= 0.3 per pixel")
    assert on_the_lens(still, "auto", 1.0)[0]  # as much as is asked for is enough
    assert on_the_lens(moving, "auto", 0.3) == (False, "the maps agree to -0.33 < 0.3 per pixel")
    assert on_the_lens(moving, "on", 0.3) == (True, "masks.temporal_mean is on")
    assert on_the_lens(still, "off", 0.3) == (False, "masks.temporal_mean is off")


def test_the_threshold_is_the_users_or_parts_the_values_of_all_maps() -> None:
    rng = np.random.default_rng(0)
    maps = [rng.beta(0.3, 0.9, (30, 40)).astype(np.float16).astype(np.float32) for _ in range(5)]
    assert chosen_threshold(iter(maps), 0.25) == (0.25, "masks.threshold")
    t, why = chosen_threshold(iter(maps), "auto")
    assert why.startswith("auto") and t == automatic_threshold(maps)
    # One map after the other, as all values at once.
    assert t == round(float(np.clip(otsu(np.stack(maps).ravel()), 0.2, 0.6)), 2)
