"""A scene's pictures, masks and cameras at a smaller size, as the fits of a comparison take them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from pipeline.io.given import of_view
from pipeline.io.scene import ImageRecord
from pipeline.io.transforms import View


def smaller_size(size: tuple[int, int], factor: float) -> tuple[int, int]:
    """(width, height) divided by `factor` >= 1, rounded, at least one pixel each."""
    return max(1, round(size[0] / factor)), max(1, round(size[1] / factor))


def smaller_picture(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Colours (H, W, 3) or a map (H, W), float32, averaged over the area of each pixel of `size`."""
    if values.shape[:2] == (size[1], size[0]):
        return values.astype(np.float32)
    return cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_AREA)


def smaller_keep_mask(keep_mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The keep mask (H, W) at `size` (w, h): a pixel is kept when nothing of its area is dropped.

    Its colour is an average over that area: a little water in it is too much.
    """
    return smaller_picture((~keep_mask).astype(np.float32), size) < 1e-6


def smaller_record(record: ImageRecord, size: tuple[int, int]) -> ImageRecord:
    """The image's entry at `size`, its focal length scaled along."""
    focal = record.focal_px
    scaled = None if focal is None else focal * size[0] / record.width
    return replace(record, width=size[0], height=size[1], focal_px=scaled)


def smaller_view(view: View, size: tuple[int, int]) -> View:
    """The view with intrinsics for pictures of `size` (w, h); its pose stays.

    Pixel (0, 0)'s centre is (0.5, 0.5), so intrinsics scale with the picture and nothing is added.
    """
    return replace(of_view(view).view(view.name, size), origin=view.origin)
