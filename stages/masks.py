"""Attention maps in, keep masks out: threshold, temporal mean for drops on the lens, dilation."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from pipeline.errors import UserError
from pipeline.io.atomic import publish_dir, read_npy, write_json, write_npy
from pipeline.io.given_masks import pass_on_masks
from pipeline.io.maps import read_map
from pipeline.io.masks import write_keep_mask
from pipeline.io.scene import GIVEN_MASKS, ImageRecord, read_images_json, read_origin
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
    """Makes `artifacts/<scene>/masks/` from the attention maps, or of the masks that came along."""
    records = read_images_json(job.paths.images)
    given = params.use_given and (job.paths.images / GIVEN_MASKS).is_dir()
    with publish_dir(job.paths.masks) as fresh:
        if given:
            coverage = pass_on_masks(job.paths.images, records, fresh)
            origin = read_origin(job.paths.images).masked
            told: dict[str, Any] = {"mode": "given", "why": f"they came with the photos ({origin})"}
            how = ", by the masks that came with the photos"
        else:
            coverage, told = _drawn(job, params, records, fresh)
            mode = told["mode"].replace("per-image", "image by image")
            how = f" at {told['threshold']:g}, {mode} ({told['why']})"
        everything = [name for name, share in coverage.items() if share == 1.0]
        if len(everything) == len(coverage):
            raise UserError(
                "every pixel of every image would be masked: nothing would be left to learn from.",
                "Black is dropped in masks that come along; masks.use_given: false does without them."
                if given
                else "Raise masks.threshold or lower masks.dilation.",
            )
        share = float(np.mean(list(coverage.values())))
        told |= {
            "coverage": {name: round(value, 6) for name, value in coverage.items()},
            "mean_coverage": round(share, 6),
            "fully_masked": everything,
        }
        write_json(fresh / "masks.json", told)
    for sentence in masking.said(share, everything, given, job.paths.masks):
        log.warning("%s", sentence)
    return f"{100 * share:.1f} % of the pixels masked{how}"


def _drawn(
    job: Job, params: Params, records: Sequence[ImageRecord], fresh: Path
) -> tuple[dict[str, float], dict[str, Any]]:
    """The share that each mask drops, by name, and what is told of how they came about."""
    files = {r.name: (job.paths.attention / f"{r.stem}.exr", r.size) for r in records}

    def maps() -> Iterator[np.ndarray]:
        """One after the other: all at once they may be larger than the memory."""
        return (read_map(path, size=size) for path, size in files.values())

    t, chosen = masking.chosen_threshold(maps(), params.threshold)
    seen = masking.together(maps(), t) if params.temporal_mean != "off" else None
    fixed, why = masking.on_the_lens(seen, params.temporal_mean, params.lens_fixed_from)
    mean = job.paths.work("masks") / "mean.npy" if seen is not None and fixed else None
    if seen is not None and mean is not None:
        write_npy(mean, seen.mean)  # a file, not an array that goes to a cluster with every task
    tasks = {name: (*file, mean, t, fresh / name, params) for name, file in files.items()}
    coverage = map_named(write_mask, tasks, job_label="masks", scheduler=job.scheduler)
    if mean is not None:
        mean.unlink()
    return coverage, {
        "threshold": t,
        "threshold_why": chosen,
        "dilation": params.dilation,
        "mode": "lens-fixed" if fixed else "per-image",
        "why": why,
        "mean_alone": fixed and params.mean_alone,
    }


def write_mask(
    attention: Path, size: tuple[int, int], mean: Path | None, t: float, path: Path, params: Params
) -> float:
    """Writes one keep mask and returns the share of pixels it drops; `mean` is the mean map's file."""
    together = None if mean is None else read_npy(mean)
    drop_mask = masking.drop_mask_of(read_map(attention, size=size), together, t, params.mean_alone)
    drop_mask = masking.dilate(masking.without_specks(drop_mask, params.min_area), params.dilation)
    write_keep_mask(path, ~drop_mask)
    return float(drop_mask.mean())


if __name__ == "__main__":
    run("masks", Params, main)
