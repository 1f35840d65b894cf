"""Keep masks on disk: 8-bit PNG, 255 = keep, 0 = drop, as COLMAP and nerfstudio read them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UserError
from pipeline.io.atomic import write_bytes


def write_keep_mask(path: Path, keep_mask: np.ndarray) -> None:
    """Writes an (H, W) boolean keep mask (True = use) as a PNG of 255 and 0."""
    if keep_mask.dtype != np.bool_ or keep_mask.ndim != 2:
        raise ValueError(f"a keep mask is (H, W) bool, got {keep_mask.shape} {keep_mask.dtype}")
    done, data = cv2.imencode(".png", keep_mask.astype(np.uint8) * 255)
    if not done:
        raise OSError(f"{path}: the mask could not be encoded")
    write_bytes(path, data.tobytes())


def read_keep_mask(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """An (H, W) boolean keep mask, True = use.

    `size` is the image's (width, height). UserError when the file is missing or unreadable, has more
    than one channel, holds values other than 0 and 255, or is not of that size.
    """
    if not path.is_file():
        raise UserError(f"{path} does not exist.", "Run `python -m stages.masks` first.")
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise UserError(f"{path} is not a readable image.", "Run `python -m stages.masks` again.")
    if values.ndim != 2:
        raise UserError(
            f"{path} has {values.shape[2]} channels; a mask has one.", "Save it as 8-bit grey."
        )
    if size is not None and values.shape != (size[1], size[0]):
        raise UserError(
            f"{path} is {values.shape[1]}x{values.shape[0]}, its image is {size[0]}x{size[1]}.",
            "Masks and images must be of one size.",
        )
    if not np.isin(values, (0, 255)).all():
        raise UserError(
            f"{path} holds values other than 0 (drop) and 255 (keep).", "Threshold it first."
        )
    return values == 255
