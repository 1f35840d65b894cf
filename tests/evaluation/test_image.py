from __future__ import annotations

import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from pipeline.evaluation.image import psnr, ssim, ssim_map


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    a = np.cumsum(random.normal(size=(40, 52, 3)), axis=1)
    a = ((a - a.min()) / np.ptp(a)).astype(np.float32)
    return a, np.clip(a + random.normal(0, 0.05, a.shape), 0, 1).astype(np.float32)


def test_psnr_of_a_constant_error_of_a_tenth_is_20_db():
    a = np.full((4, 5, 3), 0.5, np.float32)
    assert psnr(a, a + np.float32(0.1)) == pytest.approx(20.0, abs=1e-5)


def test_psnr_worked_by_hand():
    # One of four pixels is off by (0.3, 0, 0): MSE = 0.09 / 12 = 0.0075, -10 log10 = 21.249 dB.
    a = np.zeros((2, 2, 3), np.float32)
    b = a.copy()
    b[0, 0, 0] = 0.3
    assert psnr(a, b) == pytest.approx(21.249387, abs=1e-5)
    # Over that pixel alone: MSE = 0.09 / 3 = 0.03, 15.229 dB; over the others there is no error.
    only = np.array([[True, False], [False, False]])
    assert psnr(a, b, only) == pytest.approx(15.228787, abs=1e-5)
    assert psnr(a, b, ~only) == math.inf
    # With weight 1/4 there and 1 on one other pixel: 0.03 / 5 = 0.006, 22.218 dB.
    assert psnr(a, b, np.array([[0.25, 1.0], [0.0, 0.0]])) == pytest.approx(22.218487, abs=1e-5)


def test_identical_images_and_empty_selections(pair):
    a, _ = pair
    assert psnr(a, a) == math.inf
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-6)
    nothing = np.zeros(a.shape[:2], bool)
    assert math.isnan(psnr(a, a, nothing))
    assert math.isnan(ssim(a, a, nothing))


def test_selected_psnr_ignores_changes_elsewhere(pair):
    a, b = pair
    chosen = np.zeros(a.shape[:2], bool)
    chosen[10:20, 10:30] = True
    spoilt = np.where(chosen[..., None], b, 0)
    assert psnr(a, b, chosen) == psnr(a, spoilt, chosen)
    assert psnr(a, b) != psnr(a, spoilt)


def test_ssim_agrees_with_scikit_image(pair):
    a, b = pair
    how = dict(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0)
    expected, full = structural_similarity(a, b, channel_axis=2, full=True, **how)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-4)
    inside = np.isfinite(ssim_map(a, b))
    assert inside.sum() == 30 * 42
    chosen = np.zeros(a.shape[:2], bool)
    chosen[8:25, 9:31] = True
    assert ssim(a, b, chosen) == pytest.approx(full.mean(axis=2)[chosen].mean(), abs=1e-4)


def test_selected_ssim_ignores_changes_beyond_its_windows(pair):
    a, b = pair
    chosen = np.zeros(a.shape[:2], bool)
    chosen[15:20, 15:30] = True
    spoilt = b.copy()
    spoilt[26:] = 0
    assert ssim(a, b, chosen) == ssim(a, spoilt, chosen)
    spoilt[24:] = 0
    assert ssim(a, b, chosen) != ssim(a, spoilt, chosen)


def test_shapes_must_agree(pair):
    a, b = pair
    for metric in (psnr, ssim):
        with pytest.raises(ValueError, match="different shapes"):
            metric(a, b[1:])
    with pytest.raises(ValueError, match="weights"):
        psnr(a, b, np.ones((3, 3), bool))
    with pytest.raises(ValueError, match="more than 10 pixels"):
        ssim(a[:10], b[:10])
