"""The page to look at: `report/index.html`, one file with pictures, numbers and curves inside."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import Field

from pipeline.errors import UserError
from pipeline.io import accounts
from pipeline.io.accounts import read_if_there
from pipeline.io.atomic import publish_dir, write_text
from pipeline.io.paths import ScenePaths
from pipeline.io.scene import ImageRecord, read_images_json, read_origin
from pipeline.parallel import map_named
from pipeline.report import gather, notes, numbers
from pipeline.report.page import Page, Photo, render
from pipeline.report.plots import charts
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)


class Params(Section):
    """The section `report` of params.yaml."""

    compare: Annotated[str, Field(description="a variant; '.' for none")]
    picture_size: Annotated[int, Field(ge=64, le=4096)]
    quality: Annotated[int, Field(ge=1, le=100)]


def main(job: Job, params: Params) -> str:
    """Makes `report/index.html`; returns where it is."""
    paths = job.paths
    if job.variant is not None:
        raise UserError(
            "a variant has no page of its own; the scene's page shows it beside the scene.",
            f"Set report.compare: {job.variant} and leave --variant away.",
        )
    metrics = accounts.read_metrics(paths.metrics)
    other_paths, other, unmet = _other(job, params.compare)
    records = read_images_json(paths.images)
    pictures = map_named(
        gather.photo_pictures,
        {r.name: (paths, r, params.picture_size, params.quality) for r in records},
        job_label="report",
        scheduler=job.scheduler,
    )
    account = read_if_there(paths.poses / "poses.json", "poses", accounts.POSES)
    masks = read_if_there(paths.masks / "masks.json", "masks", accounts.MASKS)
    refined = read_if_there(paths.refine / "refine.json", "refine", accounts.REFINE)
    lost = gather.lost_images(account)
    heat, heat_max = gather.coverage_heat(paths, records, params.picture_size, params.quality)
    seen = read_if_there(paths.views / "seen.json", "render", accounts.SEEN)
    film, film_missing = gather.video(paths.views / "path.mp4")
    page = Page(
        scene=job.scene,
        headline=numbers.headline(metrics, other, params.compare),
        tiles=numbers.tiles(metrics, other, params.compare, seen),
        table=numbers.table(metrics, other),
        compared=params.compare if other else "",
        photos=_photos(paths, records, pictures, dict(lost), seen),
        charts=charts(paths, other_paths, records),
        coverage=heat,
        coverage_max=heat_max,
        masks_note=notes.masks_note(masks) + notes.loop_note(refined),
        rounds=notes.round_notes(refined, metrics.get("rounds", {})),
        poses_note=notes.poses_note(account, len(records)),
        lost=lost,
        tried=gather.attempts(account),
        intake=read_origin(paths.images).said,
        video=film,
        video_missing=film_missing,
        placing_known=bool(account),
        missing=numbers.missing(metrics) + numbers.incomparable(metrics, other) + unmet,
        conventions=metrics.get("conventions", {}),
    )
    with publish_dir(paths.report) as fresh:
        write_text(fresh / "index.html", render(page))
    return f"open {paths.report / 'index.html'}"


def _other(
    job: Job, variant: str
) -> tuple[ScenePaths | None, dict[str, Any], list[tuple[str, str]]]:
    """The fit to compare with, its numbers, and why there are none."""
    if variant == ".":
        return None, {}, []
    paths = ScenePaths(job.root, job.scene, variant)
    if paths.metrics.is_file():
        return paths, accounts.read_metrics(paths.metrics), []
    unmet = numbers.unmet(job.scene, variant)
    log.warning("%s", unmet[0][0])
    return None, {}, unmet


def _photos(
    paths: ScenePaths,
    records: Sequence[ImageRecord],
    pictures: Mapping[str, Mapping[str, str]],
    lost: Mapping[str, str],
    seen: Mapping[str, Mapping[str, float]],
) -> list[Photo]:
    rows = gather.image_numbers(paths.metrics_csv)
    photos = []
    for record in records:
        name, ratio = record.name, record.width / record.height
        said = notes.photo_notes(rows.get(name, {}), seen.get(name, {}))
        upright = 1 / ratio if record.turned % 180 else ratio
        held_out = record.split == "test"
        photos.append(Photo(name, held_out, pictures[name], said, lost.get(name, ""), upright))
    return photos


if __name__ == "__main__":
    run("report", Params, main)
