"""FLIP's fixed points: nothing to see between equal images, everything between black and white."""

import numpy as np
import pytest

from pipeline.evaluation import flip

pytestmark = pytest.mark.skipif(not flip.AVAILABLE, reason=flip.UNAVAILABLE)


def grey(value: float) -> np.ndarray:
    return np.full((40, 60, 3), value, np.float32)


def test_equal_images_look_the_same() -> None:
    noise = np.random.default_rng(0).random((40, 60, 3), np.float32)
    assert flip.flip(noise, noise) == 0.0


def test_black_and_white_look_nearly_as_different_as_can_be() -> None:
    # The scale ends at green against blue (section 4.1.3 of the paper), a little farther apart.
    assert 0.95 < flip.flip(grey(0.0), grey(1.0)) < 1.0


def test_more_difference_shows_more_and_the_order_does_not_matter() -> None:
    near, far = flip.flip(grey(0.5), grey(0.52)), flip.flip(grey(0.5), grey(0.7))
    assert 0.0 < near < far < 1.0
    assert flip.flip(grey(0.7), grey(0.5)) == pytest.approx(far, rel=1e-5)


def test_a_difference_shows_where_it_is() -> None:
    view = grey(0.5)
    view[10:20, 10:20] = 0.9
    found = flip.flip_map(view, grey(0.5))
    assert found.shape == (40, 60)
    assert found[15, 15] > 0.2 > found[35, 50]


def test_other_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="different shapes"):
        flip.flip(grey(0.1), grey(0.1)[1:])
