"""Where a fitted scene disagrees with a photo."""

from __future__ import annotations

import cv2
import numpy as np

MOST = 0.3  # a larger difference says nothing more
BLUR = 500  # the longer side over this, in pixels: at half the size rims are half as wide
DARK = 0.02  # pixels darker than this say nothing about the exposure


def residual(
    render: np.ndarray, photo: np.ndarray, keep_mask: np.ndarray, sure: np.ndarray | bool
) -> np.ndarray:
    """|render - photo|, mean over RGB, (H, W) float32 in [0, 0.3]; the difference is blurred first.

    `render` and `photo` (H, W, 3) in [0, 1]. Blurring before the absolute value cancels the grain of a
    field that was fitted briefly; water moves the picture by more than that. The blur grows with the
    picture. The photo's exposure is matched before, one gain per channel: the median ratio over the pixels
    of `keep_mask`. NaN where not `sure`: where the field has no reason to know the scene, its
    disagreement tells nothing.
    """
    difference = render * exposure(render, photo, keep_mask) - photo
    smooth = cv2.GaussianBlur(difference.astype(np.float32), (0, 0), max(photo.shape) / BLUR)
    values = np.minimum(np.abs(smooth).mean(axis=2), MOST)
    return np.where(sure, values, np.nan).astype(np.float32)


def exposure(render: np.ndarray, photo: np.ndarray, keep_mask: np.ndarray) -> np.ndarray:
    """The gain (3,) per channel, between 1/2 and 2, that takes the render to the photo; 1 if unknown."""
    usable = keep_mask & (render.min(axis=2) > DARK) & (photo.max(axis=2) < 1.0)
    if usable.sum() < 100:
        return np.ones(3, np.float32)
    gain = np.median(photo[usable] / render[usable], axis=0)
    return np.clip(gain, 0.5, 2.0).astype(np.float32)
