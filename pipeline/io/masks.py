"""Keep masks on disk: 8-bit PNG, 255 = keep, 0 = drop, as COLMAP and nerfstudio read them.

DerainNeRF's own rainMask.npy is the other way round, [H, W, N] with 1 = drop; it is read and written
here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UserError
from pipeline.io.atomic import read_npy, write_bytes

# Of values up to the first number, those from the second up are kept; 0.5 too serves masks in floats.
_MIDDLES = ((1, 0.5), (255, 128))


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
    maker = "refine" if path.parent.name == "refine" else "masks"
    if not path.is_file():
        raise UserError(f"{path} does not exist.", f"Run `python -m stages.{maker}` first.")
    values = _decoded(path)
    if values is None:
        raise UserError(
            f"{path} is not a readable image.", f"Run `python -m stages.{maker}` again."
        )
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


def _decoded(path: Path) -> np.ndarray | None:
    """The stored values of a picture; None when it cannot be read."""
    try:
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # more pixels than OpenCV takes, if the file's header tells the truth
        return None


def read_foreign_mask(path: Path) -> np.ndarray:
    """An (H, W) boolean keep mask (True = use) from another program's mask picture.

    Black is dropped: values from 128 up are kept; in a file of 0 to 1 those from 0.5 up, in one that goes
    beyond 255 those from 32768 up. Colour and alpha are ignored where all channels agree. UserError when
    unreadable or coloured, when alone its alpha tells one place from another, or when values are no numbers.
    """
    values = _decoded(path)
    if values is None:
        raise UserError(f"{path} is not a readable image.", "Save the mask as 8-bit grey PNG.")
    if values.ndim == 3:
        colours = values[..., :3]
        if (colours != colours[..., :1]).any():
            raise UserError(f"{path} is coloured; a mask is black and white.", "Save it as grey.")
        clear, values = values[..., 3:], colours[..., 0]
        if clear.size and np.ptp(clear) > 0 and np.ptp(values) == 0:
            raise UserError(
                f"{path} is of one colour, and more or less transparent; a mask is black and white.",
                "Save its transparency as grey: white is kept, black is dropped.",
            )
    if not np.isfinite(values).all():
        raise UserError(
            f"{path} holds NaN or infinity; a mask is black and white.",
            "Save it as 8-bit grey PNG.",
        )
    top = float(values.max())
    middle = next((half for most, half in _MIDDLES if top <= most), 32768)
    return values >= middle


def rain_mask(keep_masks: Sequence[np.ndarray]) -> np.ndarray:
    """DerainNeRF's array (H, W, N) uint8, 1 = drop, of N keep masks (H, W) in the images' name order."""
    return np.stack([~keep_mask for keep_mask in keep_masks], axis=-1).astype(np.uint8)


def read_rain_mask(path: Path, count: int) -> np.ndarray:
    """Keep masks (N, H, W), True = use, from a rainMask.npy of `count` images: (H, W, N), 1 = drop.

    Soft masks are cut at 0.5. UserError when damaged, of another shape, or not within [0, 1].
    """
    values = read_npy(path)
    if values.dtype.kind not in "bfiu":
        raise UserError(f"{path} holds {values.dtype}, not numbers.", "Save it as uint8 or float.")
    if values.ndim != 3 or values.shape[2] != count or not values.size:
        raise UserError(
            f"{path} has shape {values.shape}; (height, width, {count}) is expected.",
            "Its last axis counts the photos in name order, and every photo needs its mask.",
        )
    if values.dtype != np.bool_ and not ((values >= 0) & (values <= 1)).all():
        raise UserError(f"{path} holds values outside 0 (keep) to 1 (drop).", "Divide it by 255.")
    return np.moveaxis(values < 0.5 if values.dtype != np.bool_ else ~values, -1, 0)


def fit_mask(keep_mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """`keep_mask` (H, W) scaled to `size` (w, h): kept where at least half of the area is."""
    if keep_mask.shape == (size[1], size[0]):
        return keep_mask
    share = cv2.resize(keep_mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return share >= 0.5


def write_drop_masks(folder: Path, names: Sequence[str], drop_masks: Sequence[np.ndarray]) -> None:
    """Writes (H, W) drop masks (True = drop) into `folder` as keep masks under their images' names."""
    for name, drop_mask in zip(names, drop_masks, strict=True):
        write_keep_mask(folder / name, ~drop_mask)


def copy_keep_masks(source: Path, target: Path) -> None:
    """Copies all keep masks of a folder; UserError when one is damaged."""
    for path in sorted(source.glob("*.png")):
        write_keep_mask(target / path.name, read_keep_mask(path))
