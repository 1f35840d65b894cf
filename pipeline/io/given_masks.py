"""Keep masks that came with the photos, passed on as the scene's masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.io.masks import read_keep_mask, write_keep_mask
from pipeline.io.scene import GIVEN_MASKS, ImageRecord


def pass_on_masks(images: Path, records: Sequence[ImageRecord], target: Path) -> dict[str, float]:
    """The share of pixels that each keep mask lying with the images drops, by the image's name.

    They are written into the folder `target`. UserError when an image has none.
    """
    coverage = {}
    for record in records:
        keep_mask = read_keep_mask(images / GIVEN_MASKS / record.name, record.size)
        write_keep_mask(target / record.name, keep_mask)
        coverage[record.name] = 1.0 - float(keep_mask.mean())
    return coverage
