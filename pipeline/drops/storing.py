"""One wet view made and stored with its truth: what runs per view, on this machine or on another."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.drops import mitsuba_scene, places, synthesis
from pipeline.drops.creep import crept
from pipeline.drops.shape import Drop
from pipeline.io.atomic import write_bytes
from pipeline.io.images import as_bytes, read_photo
from pipeline.io.maps import write_depth, write_map

Recipe = dict[str, Any]  # the section `synthesize`, as plain values
COVERED = 0.02  # share of a pixel's rays that meet water, from which the true mask leaves it out


def encode(path: Path, image: np.ndarray, quality: int | None = None) -> None:
    """Writes a PNG, or with a quality a JPEG without chroma subsampling."""
    stored = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    sampling = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    options = [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling]
    done, data = cv2.imencode(path.suffix, stored, options)
    if not done:
        raise OSError(f"{path}: the image could not be encoded")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, data.tobytes())


def work_key(recipe: Recipe, code: Path = Path(__file__).parent) -> str:
    """A name for the views that a recipe makes with this code and this Mitsuba.

    An interrupted scene goes on among views of that name alone: none by older code stays beside new ones.
    """
    digest = hashlib.sha256(json.dumps(recipe, sort_keys=True).encode())
    with suppress(PackageNotFoundError):  # photos are painted without it
        digest.update(version("mitsuba").encode())
    for file in sorted(code.glob("*.py")):
        digest.update(file.name.encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def stems(count: int) -> dict[str, int]:
    """The names of `count` views and their numbers; the order of the names is that of the views."""
    digits = max(2, len(str(count - 1)))
    return {f"view_{number:0{digits}d}": number for number in range(count)}


def plan(recipe: Recipe) -> tuple[mitsuba_scene.Camera, list[synthesis.Matrix], list[Drop]]:
    """Camera, poses (cam_from_world) and drops of a rendered scene."""
    optics = ("width", "height", "field_of_view_deg", "aperture_mm")
    camera = synthesis.camera_of(**{key: recipe[key] for key in optics})
    pane = ("pane_m", "coverage", "radius_mm")
    poses, drops = synthesis.scene_plan(
        recipe["mode"], recipe["seed"], recipe["views"], camera, **{k: recipe[k] for k in pane}
    )
    return camera, poses, drops


@lru_cache(maxsize=1)
def _prepared(key: str) -> tuple[Any, ...]:
    """Baked place, exposure and plan of a recipe, once per process."""
    recipe = json.loads(key)
    baked = mitsuba_scene.bake_place(places.build(recipe["place"], recipe["seed"]))
    camera, poses, drops = plan(recipe)
    fixed = recipe["mode"] == "scene"
    pane_m = synthesis.SCENE_PANE_M if fixed else recipe["pane_m"]
    half = synthesis.stained_half(camera, pane_m, fixed=fixed)
    stains = synthesis.pane_stains(recipe["seed"], camera.focal_px, recipe["stains"], pane_m, half)
    return baked, synthesis.place_exposure(baked, camera), camera, poses, drops, stains


def render_view(recipe: Recipe, number: int, stem: str, work: Path) -> None:
    """Renders view `number` into `work`; its photo comes last and says that the view is done."""
    baked, exposure, camera, poses, drops, stains = _prepared(json.dumps(recipe, sort_keys=True))
    drops = crept(drops, number * recipe["drift_mm"] / 1000)
    view = synthesis.wet_view(
        baked, camera, poses[number], drops, stains=stains, exposure=exposure, spp=recipe["spp"],
        clean_spp=recipe["clean_spp"], seed=recipe["seed"] * 10007 + number,
        pane_m=recipe["pane_m"] if recipe["mode"] == "lens" else None,
    )  # fmt: skip
    if recipe["maps"]:
        (work / "truth/depth").mkdir(parents=True, exist_ok=True)
        write_depth(work / f"truth/depth/{stem}.exr", view.depth)
    store(recipe, work, stem, view.rainy, view.clean, view.alpha)


def store(
    recipe: Recipe, work: Path, stem: str, rainy: np.ndarray, clean: np.ndarray, alpha: np.ndarray
) -> None:
    """Writes a photo with its clean reference and coverage; the photo comes last."""
    encode(work / f"truth/clean/{stem}.jpg", clean, 98)
    encode(work / f"truth/coverage/{stem}.png", as_bytes(alpha))
    if recipe["maps"]:
        (work / "truth/alpha").mkdir(parents=True, exist_ok=True)
        write_map(work / f"truth/alpha/{stem}.exr", alpha)
        keep_mask = np.where(alpha > COVERED, 0, 255).astype(np.uint8)
        encode(work / f"truth/masks/{stem}.png", keep_mask)
    encode(work / f"{stem}.jpg", rainy, 95)


def paint_view(recipe: Recipe, number: int, path: Path, work: Path) -> None:
    """Wets the photo at `path`; photo `number` of its folder. The others get the same drops."""
    longest = max(recipe["width"], recipe["height"])
    clean = synthesis.shrunk(read_photo(path)[0], longest)
    keys = ("seed", "pane_m", "coverage", "radius_mm", "aperture_mm", "field_of_view_deg", "stains")
    creep_m = number * recipe["drift_mm"] / 1000
    rainy, alpha = synthesis.painted(clean, creep_m=creep_m, **{k: recipe[k] for k in keys})
    store(recipe, work, path.stem, rainy, clean, alpha)
