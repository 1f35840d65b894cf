"""PSNR and SSIM between two images, over all pixels or over some of them."""

from __future__ import annotations

import math

import numpy as np
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

WINDOW_RADIUS = 5  # the Gaussian window of sigma 1.5 spans 11 pixels


def psnr(a: np.ndarray, b: np.ndarray, weights: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10 of the mean squared error; the peak is 1.

    a, b: (H, W, 3) or (H, W) in [0, 1]. weights: (H, W) bool or non-negative; the mean runs over
    the selected pixels alone, so that what lies outside them neither helps nor harms.
    Infinite for identical images, NaN when no pixel is selected. ValueError when shapes differ.
    """
    if a.shape != b.shape:
        raise ValueError(f"images of different shapes: {a.shape} and {b.shape}")
    error = np.square(a.astype(np.float64) - b.astype(np.float64))
    if error.ndim == 3:
        error = error.mean(axis=2)
    mean = _weighted_mean(error, weights)
    return math.inf if mean == 0 else -10 * math.log10(mean) if mean > 0 else math.nan


def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Structural similarity of the window around each pixel, (H, W) float64, channels averaged.

    a, b: (H, W, 3) in [0, 1]. Gaussian window of sigma 1.5 and 11 pixels, K1 = 0.01, K2 = 0.03,
    data range 1 (Wang et al. 2004, doi:10.1109/TIP.2003.819861). NaN where the window leaves the
    image.
    """
    if a.shape != b.shape:
        raise ValueError(f"images of different shapes: {a.shape} and {b.shape}")
    if min(a.shape[:2]) <= 2 * WINDOW_RADIUS:
        raise ValueError(f"SSIM needs more than {2 * WINDOW_RADIUS} pixels each way, got {a.shape}")
    _, full = structural_similarity_index_measure(
        as_batch(a), as_batch(b), data_range=1.0, return_full_image=True
    )
    values = full[0].mean(dim=0).numpy().astype(np.float64)
    inside = slice(WINDOW_RADIUS, -WINDOW_RADIUS)
    framed = np.full(values.shape, np.nan)
    framed[inside, inside] = values[inside, inside]
    return framed


def ssim(a: np.ndarray, b: np.ndarray, keep: np.ndarray | None = None) -> float:
    """Mean structural similarity of two images (H, W, 3) in [0, 1], see `ssim_map`.

    keep: (H, W) bool; only windows centred on these pixels count. A window reaches 5 pixels beyond
    its centre, so pixels just outside have some influence. NaN when no window is selected.
    """
    values = ssim_map(a, b)
    inside = np.isfinite(values)
    return _weighted_mean(values, inside if keep is None else inside & keep)


def as_batch(image: np.ndarray) -> torch.Tensor:
    """An image (H, W, 3) as a float32 tensor (1, 3, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]


def _weighted_mean(values: np.ndarray, weights: np.ndarray | None) -> float:
    if weights is None:
        return float(values.mean())
    if weights.shape != values.shape:
        raise ValueError(f"weights {weights.shape} for an image {values.shape}")
    chosen = weights > 0
    if not chosen.any():
        return math.nan
    return float(np.average(values[chosen], weights=weights[chosen].astype(np.float64)))
