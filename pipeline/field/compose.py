"""A clean photo: its own pixels where they are dry, the field's inside the drops."""

from __future__ import annotations

import cv2
import numpy as np

MAX_GAIN = 1.3


def local_gain(
    photo: np.ndarray, rendered: np.ndarray, keep_mask: np.ndarray, reach_px: float
) -> np.ndarray:
    """``(H, W, 3)`` factors that bring the rendering to the photo's exposure near each pixel.

    The ratio of photo to rendering over the kept pixels around, Gaussian-weighted with
    ``reach_px``; within 1/1.3 .. 1.3; 1 where no kept pixel is near.
    """
    weight = keep_mask.astype(np.float32)[..., None]
    prior = 1e-3  # far from every kept pixel the factor falls back to 1

    def near(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(np.ascontiguousarray(values), (0, 0), reach_px)

    gain = (near(photo * weight) + prior) / (near(rendered * weight) + prior)
    return np.clip(gain, 1.0 / MAX_GAIN, MAX_GAIN).astype(np.float32)


def composite_photo(
    photo: np.ndarray,
    rendered: np.ndarray,
    keep_mask: np.ndarray,
    *,
    feather_px: float = 3.0,
    reach_px: float = 12.0,
) -> np.ndarray:
    """The photo with its covered pixels filled from the rendering; ``(H, W, 3)`` in [0, 1].

    Covered pixels are the field's alone. Kept pixels fade from the field's to the photo's own over
    ``feather_px`` from the border of a drop, and are the photo's own, bit for bit, beyond.
    """
    if keep_mask.all():
        return photo.astype(np.float32)
    matched = np.clip(rendered * local_gain(photo, rendered, keep_mask, reach_px), 0.0, 1.0)
    distance = cv2.distanceTransform(keep_mask.astype(np.uint8), cv2.DIST_L2, 5)
    own = keep_mask.astype(np.float32)[..., None]
    if feather_px > 0:
        own *= np.clip((distance - 1.0) / feather_px, 0.0, 1.0)[..., None]
    mixed = own * photo + (1.0 - own) * matched
    return np.where(own >= 1.0, photo, mixed).astype(np.float32)
