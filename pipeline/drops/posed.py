"""Photos that come with poses, wetted by a pane that stays in their scene, and stored with the truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.drops import synthesis
from pipeline.drops.creep import crept
from pipeline.drops.pane import Pane, Shot
from pipeline.drops.shape import Drop
from pipeline.drops.storing import Recipe, store
from pipeline.errors import UserError
from pipeline.geometry.cameras import intrinsic_matrix
from pipeline.io.capture import Capture
from pipeline.io.given import GivenView, Straightener, straightened
from pipeline.io.images import read_photo, resized, turn
from pipeline.io.photos import final_size

OnPane = tuple[Pane, list[Drop], synthesis.Stains | None]


@dataclass(frozen=True)
class Posed:
    """A posed photo to be wetted: its file, its camera, and what takes its distortion away."""

    given: GivenView
    shot: Shot
    straighten: Straightener | None


def posed_photos(views: Iterable[GivenView], longest: int, unit_m: float) -> dict[str, Posed]:
    """The photos of a capture with poses, by stem, no side longer than `longest` once wetted.

    unit_m: metres in one unit of the poses' world. Photos of a bent lens will be straightened.
    """
    found = {}
    for given in views:
        straight = straightened(given) if given.fisheye or any(given.distortion) else given
        size = final_size((given.width, given.height), longest)
        view = straight.view(given.photo.name, size)
        pose = view.cam_from_world.copy()
        pose[:3, 3] *= unit_m
        shot = Shot(pose, intrinsic_matrix(view.fx, view.fy, view.cx, view.cy), size)
        bent = None if straight is given else Straightener(given, straight)
        found[given.photo.stem] = Posed(given, shot, bent)
    return found


def plan(recipe: Recipe, capture: Capture, folder: Path) -> tuple[dict[str, Posed], OnPane]:
    """The posed photos of the capture in `folder`, by stem, and the wet pane before all of them.

    UserError when there are no poses, or when a camera does not look through the pane.
    """
    if not capture.views:
        raise UserError(
            f"{folder} tells no poses of its photos.",
            "A pane in the scene needs transforms.json, poses_bounds.npy or a COLMAP model there; "
            "or set synthesize.paint_pane: lens.",
        )
    longest = max(recipe["width"], recipe["height"])
    photos = posed_photos(capture.views.values(), longest, recipe["unit_m"])
    keys = ("seed", "pane_m", "coverage", "radius_mm", "aperture_mm", "stains")
    shots = {stem: photo.shot for stem, photo in photos.items()}
    return photos, synthesis.pane_plan(shots, **{key: recipe[key] for key in keys})


def true_cameras(photos: Mapping[str, Posed]) -> dict[str, Any]:
    """The cameras as they are stored in cameras.json: in every frame, above too where all agree."""
    frames = {}
    for stem, photo in photos.items():
        (fx, _, cx), (_, fy, cy), _ = photo.shot.k.tolist()
        width, height = photo.shot.size
        inside = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}
        frames[stem] = {"cam_from_world": photo.shot.cam_from_world.tolist(), **inside}
    first, *others = (
        {k: v for k, v in f.items() if k != "cam_from_world"} for f in frames.values()
    )
    common = first if all(one == first for one in others) else {}
    return {"frames": frames, "unit": "m", **common}


def paint_view(
    recipe: Recipe,
    number: int,
    photo: Posed,
    on_pane: OnPane,
    work: Path,
) -> None:
    """Wets a posed photo, number `number` of its capture, by a pane that stays in the scene."""
    pane, drops, spots = on_pane
    pixels, info = read_photo(photo.given.photo)
    degrees = photo.given.turn_for((pixels.shape[1], pixels.shape[0]), info.upright_turn)
    if degrees is None:
        raise UserError(
            f"{photo.given.photo} has {pixels.shape[1]}x{pixels.shape[0]} pixels, its camera "
            f"{photo.given.width}x{photo.given.height}: the shapes differ.",
            "Poses and photos do not belong together, or the photos were cropped.",
        )
    pixels = turn(pixels, degrees)
    clean = resized(photo.straighten(pixels) if photo.straighten else pixels, photo.shot.size)
    rainy, alpha = synthesis.painted_pane(
        clean, photo.shot, pane, crept(drops, number * recipe["drift_mm"] / 1000), spots,
        aperture_mm=recipe["aperture_mm"],
    )  # fmt: skip
    store(recipe, work, photo.given.photo.stem, rainy, clean, alpha)
