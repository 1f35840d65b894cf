"""Keep masks that came with the photos, passed on as the scene's masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.masks import read_keep_mask, write_keep_mask
from pipeline.io.scene import GIVEN_MASKS, ImageRecord, read_origin


def pass_on_masks(images: Path, records: Sequence[ImageRecord], target: Path) -> float:
    """Publishes the keep masks that lie with the images as the scene's, in the folder `target`.

    Returns the share of pixels dropped. UserError when an image has none.
    """
    coverage = {}
    with publish_dir(target) as fresh:
        for record in records:
            keep_mask = read_keep_mask(images / GIVEN_MASKS / record.name, record.size)
            write_keep_mask(fresh / record.name, keep_mask)
            coverage[record.name] = round(1.0 - float(keep_mask.mean()), 6)
        share = sum(coverage.values()) / len(coverage)
        write_json(
            fresh / "masks.json",
            {
                "mode": "given",
                "why": f"they came with the photos ({read_origin(images).masked})",
                "coverage": coverage,
                "mean_coverage": round(share, 6),
                "fully_masked": [name for name, value in coverage.items() if value == 1.0],
            },
        )
    return share
