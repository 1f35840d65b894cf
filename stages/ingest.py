"""Photos in, images of one size out: upright 8-bit RGB PNG, their sources, focal lengths and split."""

from __future__ import annotations

import logging
from typing import Annotated

from pydantic import Field

from pipeline.io.atomic import publish_dir
from pipeline.io.photos import Photo, common_turns, convert, examine, list_photos
from pipeline.io.scene import ImageRecord, write_images_json
from pipeline.parallel import map_named
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)


class Params(Section):
    """Section `ingest`."""

    max_size: Annotated[int, Field(ge=0, description="longest side in pixels; 0 keeps the size")]
    min_images: Annotated[int, Field(ge=2)]
    holdout: Annotated[
        int, Field(ge=0, description="every n-th image is held out; 0 holds out none")
    ]


def main(job: Job, params: Params) -> str:
    """Brings `data/<scene>/` into `artifacts/<scene>/images/`."""
    sources = list_photos(job.paths.data, params.min_images)
    photos = map_named(
        examine, {name: (path,) for name, path in sources.items()},
        job_label="reading photos", scheduler=job.scheduler,
    )  # fmt: skip
    turns = common_turns(photos)
    with publish_dir(job.paths.images) as fresh:
        sizes = map_named(
            convert,
            {name: (sources[name], fresh / name, turns[name], params.max_size) for name in sources},
            job_label="writing images", scheduler=job.scheduler,
        )  # fmt: skip
        records = []
        for index, name in enumerate(sorted(sources)):
            held_out = params.holdout > 0 and index % params.holdout == 0
            records.append(
                _record(name, sources[name].name, photos[name], turns[name], sizes[name], held_out)
            )
        write_images_json(fresh, records)
    turned = sum(record.turned != 0 for record in records)
    if turned:
        log.info(
            "%d of %d photos stay turned, so that portrait and landscape have one size",
            turned,
            len(records),
        )
    width, height = records[0].size
    return f"{len(records)} images of {width}x{height} in {job.paths.images}"


def _record(
    name: str, source: str, photo: Photo, degrees: int, size: tuple[int, int], held_out: bool
) -> ImageRecord:
    scale = max(size) / max(photo.width, photo.height)
    return ImageRecord(
        name=name,
        source=source,
        sha256=photo.sha256,
        width=size[0],
        height=size[1],
        focal_px=round(photo.focal_px * scale, 3) if photo.focal_px else None,
        split="test" if held_out else "train",
        turned=(degrees - photo.upright_turn) % 360,
    )


if __name__ == "__main__":
    run("ingest", Params, main)
