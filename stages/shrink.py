"""A scene at the size of a comparison's fits: photos, clean ones, maps, masks, true ones, poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pipeline.errors import UserError
from pipeline.evaluation.references import find_references, read_reference
from pipeline.io.atomic import publish_dir, read_json, write_json
from pipeline.io.images import read_image, write_image
from pipeline.io.maps import read_map, write_map
from pipeline.io.masks import read_keep_mask, write_keep_mask
from pipeline.io.scene import ImageRecord, read_images_json, write_images_json
from pipeline.io.transforms import read_transforms, write_transforms
from pipeline.stage import Job, Section, run
from pipeline.tables.shrink import (
    smaller_keep_mask,
    smaller_picture,
    smaller_record,
    smaller_size,
    smaller_view,
)

# The poses are estimated and the drops detected on the photos as they are; the paper's fits too take
# smaller ones (images_<factor>).


class Params(Section):
    """The section `shrink` of params.yaml."""

    factor: Annotated[float, Field(ge=1, le=64)]
    covered_from: Annotated[float, Field(ge=0, lt=1)]


def main(job: Job, params: Params) -> str:
    """Makes `small/` from the images, maps, masks, poses and the scene's truth."""
    paths = job.paths
    records = read_images_json(paths.images)
    views = read_transforms(paths.poses / "transforms.json")
    small = [smaller_record(r, smaller_size(r.size, params.factor)) for r in records]
    with publish_dir(paths.small) as fresh:
        for kind in ("attention", "poses"):
            (fresh / kind).mkdir()
        for record, to in zip(records, small, strict=True):
            photo = read_image(paths.images / record.name, size=record.size)
            write_image(fresh / "images" / record.name, smaller_picture(photo, to.size))
            attention = read_map(paths.attention / f"{record.stem}.exr", size=record.size)
            write_map(fresh / f"attention/{record.stem}.exr", smaller_picture(attention, to.size))
            for kind in (paths.masks.name, paths.unaveraged.name):
                keep = read_keep_mask(paths.artifacts / kind / record.name, record.size)
                write_keep_mask(fresh / kind / record.name, smaller_keep_mask(keep, to.size))
        _references(job, records, small, fresh, params.covered_from)
        write_images_json(fresh / "images", small)
        write_images_json(fresh / "clean", small)
        about = read_json(paths.masks / "masks.json", made_by="masks")
        write_json(fresh / "masks/masks.json", about)
        placed = [smaller_view(views[to.name], to.size) for to in small if to.name in views]
        write_transforms(fresh / "poses/transforms.json", placed)
    return f"{len(small)} photos at {small[0].width}x{small[0].height}"


def _references(
    job: Job,
    records: list[ImageRecord],
    small: list[ImageRecord],
    fresh: Path,
    covered_from: float,
) -> None:
    """The clean photos and the true masks."""
    data, truth = job.paths.data, job.paths.truth

    def each(kind: str, write: Callable[[ImageRecord, np.ndarray], None]) -> None:
        files = find_references(truth / kind, records)
        if files is None:
            raise UserError(f"{truth / kind} does not exist.", "A comparison needs the truth.")
        for record, to in zip(records, small, strict=True):
            whole = read_reference(files[record.name], record, data / record.source)
            write(to, smaller_picture(whole, to.size))

    def write_mask(to: ImageRecord, coverage: np.ndarray) -> None:
        write_keep_mask(fresh / "true" / to.name, coverage[..., 0] <= covered_from)

    each("clean", lambda to, clean: write_image(fresh / "clean" / to.name, clean))
    each("coverage", write_mask)


if __name__ == "__main__":
    run("shrink", Params, main)
