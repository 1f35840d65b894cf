"""Clean references and true coverage, turned and scaled as their photos were."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UserError
from pipeline.io.images import PHOTO_SUFFIXES, image_size, read_photo, turn
from pipeline.io.lenses import straightener
from pipeline.io.scene import ImageRecord, image_name


def find_references(folder: Path, records: Sequence[ImageRecord]) -> dict[str, Path] | None:
    """The reference file of every image, by image name; None when the folder does not exist.

    A reference bears its photo's name, or its image's, with any image suffix. UserError naming the
    images that have none, and for an image that has two.
    """
    if not folder.is_dir():
        return None
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in PHOTO_SUFFIXES:
            continue
        name = image_name(path)
        if name in files:
            other = files[name].name
            raise UserError(f"{path} and {other} are references of one image.", "Keep one.")
        files[name] = path
    wanted = {record.name: image_name(Path(record.name)) for record in records}
    missing = [name for name, key in wanted.items() if key not in files]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        shown = ", ".join(missing[:3]) + more
        raise UserError(
            f"{folder} has no reference for {shown}.",
            "A reference is named like its photo; move the folder away to go without references.",
        )
    return {name: files[key] for name, key in wanted.items()}


def read_reference(path: Path, record: ImageRecord, source: Path) -> np.ndarray:
    """The reference (H, W, 3) float32 in [0, 1], as `ingest` made the image of its photo.

    It is made upright, turned by `record.turned`, straightened where the photo was, and scaled down by
    area averaging when it has the size of the photo `source` rather than of the image. UserError when
    it has neither size.
    """
    stored, info = read_photo(path)
    pixels = turn(stored, info.upright_turn + record.turned)
    if record.lens is not None:
        pixels = straightener(record.lens)(pixels)
    height, width = pixels.shape[:2]
    if (width, height) != record.size:
        photo = sorted(_size_of(source))
        if sorted((width, height)) != photo or (width > height) != (record.width > record.height):
            raise UserError(
                f"{path} is {width}x{height}, its image is {record.width}x{record.height}.",
                "A reference has the size and orientation of its photo.",
            )
        pixels = cv2.resize(pixels, record.size, interpolation=cv2.INTER_AREA)
    return pixels.astype(np.float32) / np.float32(255)


def _size_of(source: Path) -> tuple[int, ...]:
    """(width, height) of a photo as it was taken; nothing when that cannot be told any more."""
    try:
        return image_size(source)
    except OSError:
        return ()
