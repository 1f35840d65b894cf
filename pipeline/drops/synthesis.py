"""Views of a place through wet glass with their truth: 8-bit pictures ready to be stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.drops import mitsuba_scene as scene
from pipeline.drops.creep import crept
from pipeline.drops.optics import blur_diameter_px, linear_to_srgb, srgb_to_linear
from pipeline.drops.painter import paint
from pipeline.drops.shape import Drop, sample_drops
from pipeline.drops.stains import over, sample_stains, seen_layer, stained

Bytes = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]
SCENE_PANE_M = 0.45  # from the mean camera to a pane that stays in the scene
LENS_PANE_M = 0.12
REACH = (0.66, 0.42)  # how far cameras stray from the grid's centre, metres, with their jitter


@dataclass(frozen=True)
class Stains:
    """A premultiplied layer (H, W, 4) on the pane, its origin at the centre, and its pixels' size."""

    layer: npt.NDArray[np.float32]
    pitch_m: float


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


def pane_stains(
    seed: int,
    camera: scene.Camera,
    kinds: Mapping[str, float],
    pane_m: float,
    *,
    fixed: bool = False,
) -> Stains | None:
    """What else sits on the pane, by kind and share covered; None for nothing. Sizes are those of

    a pane on the lens (0.12 m) and grow with the distance. fixed: a pane that stays in the scene.
    """
    if not any(kinds.values()):
        return None
    pitch = pane_m / camera.focal_px
    half = np.array([camera.width, camera.height]) / 2 * pitch * 1.05 + camera.aperture_m
    if fixed:
        half = (half + REACH) * 1.08
    shape = (round(2 * half[1] / pitch), round(2 * half[0] / pitch))
    layer = np.zeros((*shape, 4), np.float32)
    rng = np.random.default_rng([seed, 4])
    per_mm = camera.focal_px / LENS_PANE_M / 1000
    for kind, share in sorted(kinds.items()):
        layer = over(sample_stains(rng, kind, shape, share, per_mm), layer)
    return Stains(layer, pitch)


def stains_seen(
    stains: Stains, camera: scene.Camera, cam_from_pane: Matrix
) -> npt.NDArray[np.float32]:
    """The stains' layer (H, W, 4) in one camera; cam_from_pane (4, 4), metres."""
    f, w, h = camera.focal_px, camera.width, camera.height
    k = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]])
    pixel_from_pane = k @ cam_from_pane[:3][:, [0, 1, 3]]
    blur = blur_diameter_px(f, camera.aperture_m, float(cam_from_pane[2, 3]), camera.focus_m)
    return seen_layer(stains.layer, stains.pitch_m, pixel_from_pane, (h, w), blur)


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
    stains: Stains | None = None,
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
    radiance, alpha = rainy.radiance, rainy.alpha
    if stains is not None:
        cam_from_pane = cam_from_world @ fixed if fixed is not None else np.eye(4)
        if fixed is None:
            cam_from_pane[2, 3] = pane_m
        layer = stains_seen(stains, camera, cam_from_pane)
        radiance = stained(radiance, layer)
        alpha = 1 - (1 - alpha) * (1 - layer[..., 3])
    # Other random numbers than the rainy picture's, so that their noise is not the same.
    clean = scene.render(baked, camera, cam_from_world, spp=clean_spp, seed=2 * seed + 1)
    return WetView(
        to_bytes(scene.develop(radiance, exposure)),
        to_bytes(scene.develop(clean.radiance, exposure)),
        to_bytes(alpha),
        clean.depth,
        alpha,
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
    creep_m: float = 0.0,
    stains: Mapping[str, float] | None = None,
) -> tuple[Bytes, Bytes]:
    """A photo (H, W, 3) wetted by the painter, and its coverage (H, W); both uint8.

    focal: pixels, if known, else from the field of view of the longer side. The drops follow from
    the seed and the photo's shape alone: the same for all photos of one camera, but for the creep (of
    the largest drop, metres). stains: share covered by kind.
    """
    height, width = photo.shape[:2]
    focal = focal or focal_px(max(width, height), field_of_view_deg)
    camera = scene.Camera(width, height, focal, aperture_mm / 1000)
    drops = lens_drops(np.random.default_rng([seed, 2]), camera, pane_m, coverage, radius_mm)
    rainy, alpha = paint(
        photo.astype(np.float32) / np.float32(255), crept(drops, creep_m), focal_px=focal, pane_distance=pane_m,
        aperture_radius=camera.aperture_m, focus_distance=camera.focus_m,
    )  # fmt: skip
    spots = pane_stains(seed, camera, stains or {}, pane_m)
    if spots is not None:
        pane = np.eye(4)
        pane[2, 3] = pane_m
        layer = stains_seen(spots, camera, pane)
        rainy = linear_to_srgb(stained(srgb_to_linear(rainy), layer))
        alpha = 1 - (1 - alpha) * (1 - layer[..., 3])
    return to_bytes(rainy), to_bytes(alpha)
