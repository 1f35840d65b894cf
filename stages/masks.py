"""Attention maps in, keep masks out: threshold, temporal mean for drops on the lens, dilation."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pipeline.errors import UserError
from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.given_masks import pass_on_masks
from pipeline.io.maps import read_map
from pipeline.io.masks import write_keep_mask
from pipeline.io.scene import GIVEN_MASKS, read_images_json
from pipeline.masking import masks as masking
from pipeline.parallel import map_named
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)


class Params(Section):
    """Section `masks`."""

    use_given: bool
    threshold: Annotated[float, Field(ge=0, le=1)] | Literal["auto"]
    temporal_mean: Literal["auto", "on", "off"]
    mean_alone: bool
    lens_fixed_from: Annotated[float, Field(ge=0, le=1)]
    dilation: Annotated[int, Field(ge=0, le=100)]
    min_area: Annotated[int, Field(ge=0)]


def main(job: Job, params: Params) -> str:
    """Makes `artifacts/<scene>/masks/` from the attention maps."""
    records = read_images_json(job.paths.images)
    if params.use_given and (job.paths.images / GIVEN_MASKS).is_dir():
        share = pass_on_masks(job.paths.images, records, job.paths.masks)
        return f"{100 * share:.1f} % of the pixels masked, by the masks that came with the photos"
    files = {record.name: job.paths.attention / f"{record.stem}.exr" for record in records}
    maps = [read_map(files[record.name], size=record.size) for record in records]
    t, chosen = masking.chosen_threshold(maps, params.threshold)
    fixed, why = masking.on_the_lens(maps, t, params.temporal_mean, params.lens_fixed_from)
    mean = masking.temporal_mean(maps) if fixed else None
    with publish_dir(job.paths.masks) as fresh:
        coverage = map_named(
            write_mask,
            {name: (path, mean, t, fresh / name, params) for name, path in files.items()},
            job_label="masks",
            scheduler=job.scheduler,
        )
        everything = [name for name, share in coverage.items() if share == 1.0]
        if len(everything) == len(coverage):
            raise UserError(
                "every pixel of every image would be masked: nothing would be left to learn from.",
                "Raise masks.threshold or lower masks.dilation.",
            )
        share = float(np.mean(list(coverage.values())))
        write_json(
            fresh / "masks.json",
            {
                "threshold": t,
                "threshold_why": chosen,
                "dilation": params.dilation,
                "mode": "lens-fixed" if fixed else "per-image",
                "why": why,
                "mean_alone": fixed and params.mean_alone,
                "coverage": {name: round(value, 6) for name, value in coverage.items()},
                "mean_coverage": round(share, 6),
                "fully_masked": everything,
            },
        )
    for name in everything:
        log.warning("%s is masked entirely and will teach the scene nothing", name)
    if share == 0:
        log.warning("no drops were found in any image; lower masks.threshold if there are some")
    elif share > 0.6:
        log.warning(
            "%.0f %% of the pixels are masked, little is left to learn from: look at %s; where dry "
            "glass is masked, raise masks.threshold, else wipe the glass and take the photos again",
            100 * share, job.paths.masks,
        )  # fmt: skip
    mode = "lens-fixed" if fixed else "image by image"
    return f"{100 * share:.1f} % of the pixels masked at {t:g}, {mode} ({why})"


def write_mask(
    attention: Path, mean: np.ndarray | None, t: float, path: Path, params: Params
) -> float:
    """Writes one keep mask and returns the share of pixels it drops."""
    drop_mask = masking.drop_mask_of(read_map(attention), mean, t, params.mean_alone)
    drop_mask = masking.dilate(masking.without_specks(drop_mask, params.min_area), params.dilation)
    write_keep_mask(path, ~drop_mask)
    return float(drop_mask.mean())


if __name__ == "__main__":
    run("masks", Params, main)
