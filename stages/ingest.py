"""A capture in, images of one size out: upright 8-bit RGB PNG, their sources, focal lengths and split."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from pipeline.io import intake
from pipeline.io.atomic import publish_dir, write_text
from pipeline.io.capture import Capture, adopt, find_capture, refuse_outside
from pipeline.io.frames import save_frames
from pipeline.io.paths import ScenePaths
from pipeline.io.photos import convert, examine, final_size, plan_sizes
from pipeline.io.scene import (
    GIVEN_MASKS,
    GIVEN_POSES,
    ImageRecord,
    Origin,
    with_split,
    write_images_json,
)
from pipeline.io.transforms import write_transforms
from pipeline.parallel import map_named
from pipeline.params import read_section, with_scene
from pipeline.sfm import read_colmap
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)


class Params(Section):
    """Section `ingest`."""

    max_size: Annotated[int, Field(ge=0, description="longest side in pixels; 0 keeps the size")]
    min_images: Annotated[int, Field(ge=3)]  # of two no solver tells the places
    holdout: Annotated[
        int, Field(ge=0, description="every n-th image is held out; 0 holds out none")
    ]
    frames: Annotated[int, Field(ge=3, le=2000)]
    mixed_sizes: Literal["scale", "refuse"]


def main(job: Job, params: Params) -> str:
    """Brings `data/<scene>/` into `artifacts/<scene>/images/`."""
    capture = find_capture(job.paths.data, params.min_images, read_colmap)
    refuse_outside(job.paths.data, capture)
    with publish_dir(job.paths.images) as fresh:
        if capture.video is not None:
            fewest, longest = params.min_images, params.max_size
            records, said = save_frames(
                capture.video, fresh, params.frames, longest, at_least=fewest
            )
            origin = Origin(kind="video", said=said)
        else:
            records, origin = _from_photos(job, capture, fresh, params)
        records = with_split(records, params.holdout)
        write_images_json(fresh, records, origin)
    for sentence in [*origin.said, *intake.few_said(records)]:
        log.warning("%s", sentence)
    width, height = records[0].size
    more = f", with poses from {origin.posed}" if origin.posed else ""
    return f"{len(records)} images of {width}x{height} in {job.paths.images}{more}"


def _from_photos(
    job: Job, capture: Capture, folder: Path, params: Params
) -> tuple[list[ImageRecord], Origin]:
    photos = map_named(
        examine, {name: (path,) for name, path in capture.photos.items()},
        job_label="reading photos", scheduler=job.scheduler,
    )  # fmt: skip
    turns = intake.given_turns(photos, capture.views)
    plan = plan_sizes(photos, mixed=params.mixed_sizes, fixed_turns=turns)
    intake.enough(plan, photos, params.min_images)
    size = final_size(plan.size, params.max_size)
    straighten = intake.straighteners(capture.views)
    map_named(
        convert,
        {
            name: (capture.photos[name], folder / name, degrees, size, straighten.get(name))
            for name, degrees in plan.turns.items()
        },
        job_label="writing images", scheduler=job.scheduler,
    )  # fmt: skip
    records = intake.photo_records(capture, photos, plan, size, job.paths.data, straighten)
    if capture.views:
        write_transforms(folder / GIVEN_POSES, intake.given_views(capture, plan, size, straighten))
    share = intake.write_given_masks(folder / GIVEN_MASKS, capture, photos, plan, size, straighten)
    said = plan.said + intake.masks_said(capture.masked_by, share, photos)
    return records, Origin("photos", capture.posed_by, capture.masked_by, plan.left_out, said)


def _flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--from", dest="source", type=Path, metavar="PATH",
        help="a folder of photos, a capture with poses, or a video: copied to data/<scene>/, and the "
        "scene is added to params.yaml",
    )  # fmt: skip


def _before(params_file: Path, flags: argparse.Namespace) -> None:
    """With --from: puts the capture in place and the scene into params.yaml."""
    if flags.source is None:
        return
    data = ScenePaths(params_file.parent, flags.scene).data
    known = with_scene(params_file, flags.scene) is None  # faults are told before photos are copied
    fewest = read_section(params_file, "ingest", Params, flags.scene if known else None).min_images
    adopt(flags.source, data, fewest, read_colmap)
    text = with_scene(params_file, flags.scene)  # anew: copying takes long, others add scenes too
    if text is not None:
        write_text(params_file, text)
        print(f"ingest: added the scene {flags.scene} to {params_file}")


if __name__ == "__main__":
    run("ingest", Params, main, add_flags=_flags, before=_before)
