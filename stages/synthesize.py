"""A wet-glass scene with its truth into `data/<scene>/`: ray traced, or painted on clean photos."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field, PositiveFloat
from tqdm import tqdm

from pipeline.drops import mitsuba_scene, places, synthesis
from pipeline.errors import UserError
from pipeline.io.atomic import publish_dir, write_bytes, write_json
from pipeline.io.images import read_photo
from pipeline.io.maps import write_depth
from pipeline.io.photos import list_photos
from pipeline.stage import Job, Section, run

MARKER = "truth/synthesize.json"
Side = Annotated[int, Field(ge=16, le=8192)]


class Params(Section):
    """Section `synthesize`."""

    mode: Literal["lens", "scene", "paint"]
    place: str
    source: Annotated[str, Field(description="folder of clean photos, for mode paint")]
    seed: Annotated[int, Field(ge=0)]
    views: Annotated[int, Field(ge=1, le=1000)]
    width: Side
    height: Side
    field_of_view_deg: Annotated[float, Field(gt=5, lt=150)]
    spp: Annotated[int, Field(ge=1)]
    clean_spp: Annotated[int, Field(ge=1)]
    coverage: Annotated[float, Field(gt=0, lt=0.7)]
    radius_mm: tuple[PositiveFloat, PositiveFloat]
    pane_m: Annotated[float, Field(ge=0.03, le=2)]
    aperture_mm: Annotated[float, Field(ge=0, le=20)]
    depth: bool


def _encode(path: Path, image: np.ndarray, quality: int | None = None) -> None:
    """A PNG, or with a quality a JPEG without chroma subsampling."""
    stored = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    sampling = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    options = [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling]
    done, data = cv2.imencode(path.suffix, stored, options)
    if not done:
        raise OSError(f"{path}: the image could not be encoded")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, data.tobytes())


def _rendered(params: Params, work: Path) -> dict[str, Any]:
    """Renders the views that `work` does not hold yet; returns the true cameras."""
    optics = {"width", "height", "field_of_view_deg", "aperture_mm"}
    camera = synthesis.camera_of(**params.model_dump(include=optics))
    poses, drops = synthesis.scene_plan(
        params.mode, params.seed, params.views, camera,
        pane_m=params.pane_m, coverage=params.coverage, radius_mm=params.radius_mm,
    )  # fmt: skip
    stems = [f"view_{k:02d}" for k in range(params.views)]
    todo = [k for k, stem in enumerate(stems) if not (work / f"{stem}.jpg").exists()]
    if todo:
        baked = mitsuba_scene.bake_place(places.build(params.place, params.seed))
        exposure = synthesis.place_exposure(baked, camera)
    for k in tqdm(todo, desc="rendering views"):
        view = synthesis.wet_view(
            baked, camera, poses[k], drops, exposure=exposure, spp=params.spp,
            clean_spp=params.clean_spp, seed=params.seed * 10007 + k,
            pane_m=params.pane_m if params.mode == "lens" else None,
        )  # fmt: skip
        _encode(work / f"truth/clean/{stems[k]}.jpg", view.clean, 98)
        _encode(work / f"truth/coverage/{stems[k]}.png", view.coverage)
        if params.depth:
            (work / "truth/depth").mkdir(exist_ok=True)
            write_depth(work / f"truth/depth/{stems[k]}.exr", view.depth)
        _encode(work / f"{stems[k]}.jpg", view.rainy, 95)  # last: it says that the view is done
    return synthesis.cameras(camera, dict(zip(stems, poses, strict=True)))


def _painted(params: Params, source: Path, work: Path) -> None:
    """Wets the photos of a folder, the same drops in the sensor's frame of each."""
    keys = {"seed", "pane_m", "coverage", "radius_mm", "aperture_mm", "field_of_view_deg"}
    for path in tqdm(list_photos(source, 1).values(), desc="painting photos"):
        clean = synthesis.shrunk(read_photo(path)[0], max(params.width, params.height))
        rainy, coverage = synthesis.painted(clean, **params.model_dump(include=keys))
        _encode(work / f"truth/clean/{path.stem}.jpg", clean, 98)
        _encode(work / f"truth/coverage/{path.stem}.png", coverage)
        _encode(work / f"{path.stem}.jpg", rainy, 95)


def main(job: Job, params: Params) -> str:
    """Makes `data/<scene>/`, unless somebody else's photos are there."""
    final = job.paths.data
    if final.exists() and any(final.iterdir()) and not (final / MARKER).is_file():
        raise UserError(f"{final} holds files that synthesize did not make.", "Rename the scene.")
    if params.radius_mm[0] > params.radius_mm[1]:
        raise UserError("synthesize.radius_mm should be [smallest, largest].")
    recipe = params.model_dump(mode="json")
    key = hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()[:16]
    work = job.paths.work("synthesize") / key
    if params.mode == "paint":
        _painted(params, job.resolve(params.source), work)
    else:
        write_json(work / "truth/cameras.json", _rendered(params, work))
    write_json(work / MARKER, recipe)
    with publish_dir(final) as fresh:
        shutil.copytree(work, fresh, dirs_exist_ok=True)
    shutil.rmtree(work)
    return f"{len(list(final.glob('*.jpg')))} wet views with their truth in {final}"


if __name__ == "__main__":
    run("synthesize", Params, main)
