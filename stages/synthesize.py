"""A wet-glass scene with its truth into `data/<scene>/`: ray traced, or painted on clean photos."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from pipeline.drops import posed, storing, synthesis
from pipeline.errors import UserError
from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.capture import find_capture
from pipeline.io.photos import list_photos
from pipeline.parallel import map_named
from pipeline.sfm import read_colmap
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)
MARKER = "truth/synthesize.json"
Side = Annotated[int, Field(ge=16, le=8192)]


class Params(Section):
    """Section `synthesize`."""

    mode: Literal["lens", "scene", "paint"]
    place: str
    source: Annotated[str, Field(description="folder of clean photos, for mode paint")]
    paint_pane: Literal["lens", "scene"]
    unit_m: PositiveFloat
    seed: Annotated[int, Field(ge=0)]
    views: Annotated[int, Field(ge=1, le=1000)]
    width: Side
    height: Side
    field_of_view_deg: Annotated[float, Field(gt=5, lt=150)]
    spp: Annotated[int, Field(ge=1)]
    clean_spp: Annotated[int, Field(ge=1)]
    coverage: Annotated[float, Field(ge=0, lt=0.7)]
    drift_mm: Annotated[float, Field(ge=0, le=20)]
    stains: dict[
        Literal["dust", "dirt", "smears", "scratches", "snow"],
        Annotated[float, Field(ge=0, lt=0.7)],
    ]
    radius_mm: tuple[PositiveFloat, PositiveFloat]
    pane_m: Annotated[float, Field(ge=0.03, le=2)]
    aperture_mm: Annotated[float, Field(ge=0, le=20)]
    maps: bool


def _rendered(job: Job, params: Params, work: Path) -> None:
    """Renders the views that `work` does not hold yet, and writes the true cameras."""
    recipe = params.model_dump(mode="json")
    stems = storing.stems(params.views)
    camera, poses, _ = storing.plan(recipe)
    todo = {
        stem: (recipe, k, stem, work)
        for stem, k in stems.items()
        if not (work / f"{stem}.jpg").exists()
    }
    # Mitsuba spreads one view over all cores; on a cluster every worker takes one.
    map_named(
        storing.render_view, todo, job_label="rendering", scheduler=job.scheduler,
        workers=None if job.scheduler else 1,
    )  # fmt: skip
    cameras = synthesis.cameras(camera, dict(zip(stems, poses, strict=True)))
    write_json(work / "truth/cameras.json", cameras)


def _painted(job: Job, params: Params, work: Path) -> None:
    """Wets the photos of a folder, the same drops in the sensor's frame of each."""
    recipe = params.model_dump(mode="json")
    photos = list_photos(job.resolve(params.source), 1).values()
    items = {path.stem: (recipe, k, path, work) for k, path in enumerate(photos)}
    map_named(storing.paint_view, items, job_label="painting", scheduler=job.scheduler)


def _painted_in_the_scene(job: Job, params: Params, work: Path) -> None:
    """Wets the photos of a capture with poses by one pane that stays in the scene."""
    folder = job.resolve(params.source)
    capture = find_capture(folder, 2, read_colmap)
    recipe = params.model_dump(mode="json")
    photos, on_pane = posed.plan(recipe, capture, folder)
    if dry := len(capture.photos) - len(photos):
        log.warning("%s photos without a pose are left out", dry)
    items = {
        stem: (recipe, k, photos[stem], on_pane, work) for k, stem in enumerate(sorted(photos))
    }
    map_named(posed.paint_view, items, job_label="painting", scheduler=job.scheduler)
    write_json(work / "truth/cameras.json", posed.true_cameras(photos))


def main(job: Job, params: Params) -> str:
    """Makes `data/<scene>/`, unless somebody else's photos are there."""
    final = job.paths.data
    if final.exists() and any(final.iterdir()) and not (final / MARKER).is_file():
        raise UserError(f"{final} holds files that synthesize did not make.", "Rename the scene.")
    if params.radius_mm[0] > params.radius_mm[1]:
        raise UserError("synthesize.radius_mm should be [smallest, largest].")
    recipe = params.model_dump(mode="json")
    work = job.paths.work("synthesize") / storing.work_key(recipe)
    make = _rendered
    if params.mode == "paint":
        shutil.rmtree(work, ignore_errors=True)  # what an interrupted run made of photos now gone
        make = _painted if params.paint_pane == "lens" else _painted_in_the_scene
    make(job, params, work)
    write_json(work / MARKER, recipe)
    with publish_dir(final) as fresh:
        shutil.copytree(work, fresh, dirs_exist_ok=True)
    # Also what was interrupted with other settings or code.
    for begun in sorted(work.parent.glob("*/")):
        shutil.rmtree(begun)
    return f"{len(list(final.glob('*.jpg')))} wet views with their truth in {final}"


if __name__ == "__main__":
    run("synthesize", Params, main)
