"""A scene's images with their masks and poses, read together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.io.images import read_image
from pipeline.io.masks import read_keep_mask
from pipeline.io.scene import ImageRecord, read_images_json
from pipeline.io.transforms import View


@dataclass(frozen=True)
class PosedImage:
    """One image: `rgb` (H, W, 3) in [0, 1], `keep_mask` (H, W) True = use, and its pose."""

    record: ImageRecord
    view: View
    rgb: np.ndarray
    keep_mask: np.ndarray


def read_posed_images(
    images: Path, masks: Path | None, views: Mapping[str, View]
) -> list[PosedImage]:
    """The images that have a pose, in name order, held-out ones included.

    Without a folder of `masks` every pixel is kept. UserError when a file is missing or damaged.
    """
    found = []
    for record in read_images_json(images):
        view = views.get(record.name)
        if view is None:
            continue
        rgb = read_image(images / record.name, size=(view.width, view.height))
        keep_mask = np.ones(rgb.shape[:2], bool)
        if masks is not None:
            keep_mask = read_keep_mask(masks / record.name, (view.width, view.height))
        found.append(PosedImage(record, view, rgb, keep_mask))
    return found
