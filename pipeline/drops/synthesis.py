"""Views of a place through wet glass with their truth: 8-bit pictures ready to be stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.drops import mitsuba_scene as scene
from pipeline.drops.painter import paint
from pipeline.drops.shape import Drop, sample_drops

Bytes = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]
SCENE_PANE_M = 0.45  # from the mean camera to a pane that stays in the scene
REACH = (0.66, 0.42)  # how far cameras stray from the grid's centre, metres, with their jitter


@dataclass(frozen=True)
class WetView:
    """One view. rainy, clean (H, W, 3) and coverage (H, W) uint8; depth (H, W) metres, 0: sky;

    alpha (H, W) the coverage before it was rounded.
    """

    rainy: Bytes
    clean: Bytes
    coverage: Bytes
    depth: npt.NDArray[np.float32]
    alpha: npt.NDArray[np.float32]


def focal_px(width: int, field_of_view_deg: float) -> float:
    """Focal length in pixels of a camera with that horizontal field of view."""
    return float(width / 2 / np.tan(np.radians(field_of_view_deg) / 2))


def camera_of(
    width: int, height: int, field_of_view_deg: float, aperture_mm: float
) -> scene.Camera:
    """Camera of that many pixels, horizontal field of view and lens radius."""
    focal = focal_px(width, field_of_view_deg)
    return scene.Camera(width, height, focal, aperture_mm / 1000)


def lens_drops(
    rng: np.random.Generator,
    camera: scene.Camera,
    pane_m: float,
    coverage: float,
    radius_mm: tuple[float, float],
) -> list[Drop]:
    """Drops on a pane `pane_m` in front of the lens that cover that share of the picture."""
    half = (
        np.array([camera.width, camera.height]) / 2 / camera.focal_px * pane_m + camera.aperture_m
    )
    radii = (radius_mm[0] / 1000, radius_mm[1] / 1000)
    return sample_drops(rng, float(half[0]), float(half[1]), coverage, radii)


def scene_drops(
    rng: np.random.Generator, camera: scene.Camera, coverage: float, radius_mm: tuple[float, float]
) -> list[Drop]:
    """Drops on a pane in the scene, SCENE_PANE_M from the mean camera, seen by all cameras."""
    view = np.array([camera.width, camera.height]) / 2 / camera.focal_px * SCENE_PANE_M
    half = (view + REACH) * 1.08  # cameras are turned a little
    radii = (radius_mm[0] / 1000, radius_mm[1] / 1000)
    return sample_drops(rng, float(half[0]), float(half[1]), coverage, radii, resolution=1024)


def scene_plan(
    mode: str,
    seed: int,
    views: int,
    camera: scene.Camera,
    *,
    pane_m: float,
    coverage: float,
    radius_mm: tuple[float, float],
) -> tuple[list[Matrix], list[Drop]]:
    """Poses (cam_from_world) and drops of a sequence; mode: "lens" or "scene"."""
    rng = np.random.default_rng([seed, 2])
    poses = scene.trajectory(rng, views)
    if mode == "lens":
        return poses, lens_drops(rng, camera, pane_m, coverage, radius_mm)
    return poses, scene_drops(rng, camera, coverage, radius_mm)


def cameras(camera: scene.Camera, poses: dict[str, Matrix]) -> dict[str, Any]:
    """The true cameras as they are stored in cameras.json."""
    frames = {stem: {"cam_from_world": pose.tolist()} for stem, pose in poses.items()}
    f, w, h = camera.focal_px, camera.width, camera.height
    inside = {"fx": f, "fy": f, "cx": w / 2, "cy": h / 2, "width": w, "height": h}
    return {"frames": frames, "unit": "m", **inside}


def place_exposure(baked: scene.Baked, camera: scene.Camera) -> float:
    """Exposure of the whole sequence, from a quick picture by the mean camera."""
    quick = scene.render(baked, camera, np.eye(4), spp=16, seed=0)
    return scene.exposure(quick.radiance, grey=baked.place.grey)


def to_bytes(picture: npt.NDArray[np.floating]) -> Bytes:
    """[0, 1] to 8 bits, rounded."""
    return np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)


def wet_view(
    baked: scene.Baked,
    camera: scene.Camera,
    cam_from_world: Matrix,
    drops: Sequence[Drop],
    *,
    exposure: float,
    spp: int,
    clean_spp: int,
    seed: int,
    pane_m: float | None,
) -> WetView:
    """One view through `drops` and without them; pane_m None: the pane stays in the scene."""
    fixed = None
    if pane_m is None:
        fixed = np.eye(4)
        fixed[2, 3] = SCENE_PANE_M
    rainy = scene.render(
        baked, camera, cam_from_world, spp=spp, seed=2 * seed, drops=drops,
        world_from_pane=fixed, pane_m=pane_m or SCENE_PANE_M,
    )  # fmt: skip
    # Other random numbers than the rainy picture's, so that their noise is not the same.
    clean = scene.render(baked, camera, cam_from_world, spp=clean_spp, seed=2 * seed + 1)
    return WetView(
        to_bytes(scene.develop(rainy.radiance, exposure)),
        to_bytes(scene.develop(clean.radiance, exposure)),
        to_bytes(rainy.alpha),
        clean.depth,
        rainy.alpha,
    )


def shrunk(photo: Bytes, longest: int) -> Bytes:
    """The photo, scaled down so that no side is longer than `longest` pixels."""
    factor = longest / max(photo.shape[:2])
    if factor >= 1:
        return photo
    size = (round(photo.shape[1] * factor), round(photo.shape[0] * factor))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)


def painted(
    photo: Bytes,
    *,
    seed: int,
    pane_m: float,
    coverage: float,
    radius_mm: tuple[float, float],
    aperture_mm: float,
    field_of_view_deg: float,
    focal: float | None = None,
) -> tuple[Bytes, Bytes]:
    """A photo (H, W, 3) wetted by the painter, and its coverage (H, W); both uint8.

    focal: pixels, if known, else from the field of view of the longer side. The drops follow from
    the seed and the photo's shape alone: the same for all photos of one camera.
    """
    height, width = photo.shape[:2]
    focal = focal or focal_px(max(width, height), field_of_view_deg)
    camera = scene.Camera(width, height, focal, aperture_mm / 1000)
    drops = lens_drops(np.random.default_rng([seed, 2]), camera, pane_m, coverage, radius_mm)
    rainy, alpha = paint(
        photo.astype(np.float32) / np.float32(255), drops, focal_px=focal, pane_distance=pane_m,
        aperture_radius=camera.aperture_m, focus_distance=camera.focus_m,
    )  # fmt: skip
    return to_bytes(rainy), to_bytes(alpha)
