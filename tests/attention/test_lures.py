"""Dry pictures made to look wet: what a lens does to points and edges."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.attention.lures import defocused, lure, overexposed
from pipeline.attention.samples import Pool, draw_batch


def test_a_lamp_becomes_a_disc_of_the_given_radius() -> None:
    lamp = np.zeros((41, 41, 3), np.float32)
    lamp[20, 20] = 1
    found = defocused(lamp, 6)[..., 0]
    y, x = np.mgrid[:41, :41] - 20
    away = np.hypot(y, x)
    assert (found[away > 7] < 1e-3).all()
    disc = found[away < 5]
    assert disc.min() > 0.1
    assert np.ptp(disc) < 1e-3  # flat, not bell-shaped
    # Four times the light of a white pixel, spread over the disc, and shown with gamma 2.2.
    assert disc.mean() == pytest.approx((4 / (np.pi * 6.0**2)) ** (1 / 2.2), rel=0.05)


def test_what_is_even_stays_as_it_is() -> None:
    even = np.full((30, 30, 3), 0.4, np.float32)
    np.testing.assert_allclose(defocused(even, 4.5), even, atol=1e-4)


def test_more_light_is_cut_off_at_white() -> None:
    image = np.array([[[0.0, 0.5, 0.9]]], np.float32)
    # 0.5 ** 2.2 doubled is (0.5 * 2 ** (1 / 2.2)) ** 2.2.
    np.testing.assert_allclose(overexposed(image, 2)[0, 0], [0, 0.5 * 2 ** (1 / 2.2), 1], rtol=1e-5)


def test_only_dry_crops_are_changed_and_each_stays_dry() -> None:
    rng = np.random.default_rng(3)
    clean = [rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)]
    pool = Pool(clean, clean, [np.full((48, 64), 255, np.uint8)])

    def drawn(clean_share: float, lures: float) -> tuple[np.ndarray, np.ndarray]:
        images, cover, _ = draw_batch([pool], np.random.default_rng(0), 6, 32, clean_share, lures)
        return images.numpy(), cover.numpy()

    np.testing.assert_array_equal(drawn(0, 1)[0], drawn(0, 0)[0])
    lured, cover = drawn(1, 1)
    assert (lured != drawn(1, 0)[0]).any()
    assert not cover.any()


def test_every_kind_stays_a_picture_and_is_told_by_the_generator() -> None:
    image = np.random.default_rng(0).random((40, 50, 3), dtype=np.float32)
    for seed in range(30):
        one, again = (lure(image.copy(), np.random.default_rng(seed)) for _ in range(2))
        np.testing.assert_array_equal(one, again)
        assert one.shape == image.shape
        assert 0 <= one.min() <= one.max() <= 1
        assert (one != image).any()
