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
from pipeline.drops.pane import (
    Pane,
    Shot,
    depth_on_axis,
    paint_pane,
    pane_before,
    pixel_from_pane,
)
from pipeline.drops.shape import Drop, sample_drops
from pipeline.drops.stains import over, sample_stains, seen_layer, stained
from pipeline.geometry.cameras import intrinsic_matrix
from pipeline.io.images import as_bytes

Bytes = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]
FOCUS_M = scene.Camera.focus_m  # where the lens of every photo is sharp
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
    """One view through wet glass and what is true of it.

    rainy, clean (H, W, 3) and coverage (H, W) uint8; depth (H, W) metres, 0: sky; alpha (H, W) the
    coverage before it was rounded.
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
    focal_px: float,
    kinds: Mapping[str, float],
    pane_m: float,
    half: Sequence[float] | Matrix,
) -> Stains | None:
    """What else sits on the pane, by kind and share covered; None for nothing.

    Sizes are those of a pane on the lens (0.12 m) and grow with the distance. half: width and height of
    half the pane.
    """
    if not any(kinds.values()):
        return None
    pitch = pane_m / focal_px
    shape = (round(2 * half[1] / pitch), round(2 * half[0] / pitch))
    layer = np.zeros((*shape, 4), np.float32)
    rng = np.random.default_rng([seed, 4])
    per_mm = focal_px / LENS_PANE_M / 1000
    for kind, share in sorted(kinds.items()):
        layer = over(sample_stains(rng, kind, shape, share, per_mm), layer)
    return Stains(layer, pitch)


def stained_half(camera: scene.Camera, pane_m: float, *, fixed: bool = False) -> Matrix:
    """Half width and height (2,) of a pane to stain; fixed: of one that stays in a rendered scene."""
    view = np.array([camera.width, camera.height]) / 2 * (pane_m / camera.focal_px)
    half = view * 1.05 + camera.aperture_m
    return (half + REACH) * 1.08 if fixed else half


def stains_seen(
    stains: Stains,
    k: Matrix,
    size: tuple[int, int],
    cam_from_pane: Matrix,
    aperture_m: float,
    focus_m: float,
) -> npt.NDArray[np.float32]:
    """The stains' layer (H, W, 4) in one camera of `size` (w, h); cam_from_pane (4, 4), metres."""
    blur = blur_diameter_px(float(k[0, 0]), aperture_m, depth_on_axis(cam_from_pane), focus_m)
    seen = pixel_from_pane(k, cam_from_pane)
    return seen_layer(stains.layer, stains.pitch_m, seen, size[::-1], blur)


def camera_matrix(camera: scene.Camera) -> Matrix:
    """K (3, 3) of a camera whose axis meets the middle of its picture."""
    f = camera.focal_px
    return intrinsic_matrix(f, f, camera.width / 2, camera.height / 2)


def place_exposure(baked: scene.Baked, camera: scene.Camera) -> float:
    """Exposure of the whole sequence, from a quick picture by the mean camera."""
    quick = scene.render(baked, camera, np.eye(4), spp=16, seed=0)
    return scene.exposure(quick.radiance, grey=baked.place.grey)


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
        layer = stains_seen(
            stains, camera_matrix(camera), (camera.width, camera.height), cam_from_pane,
            camera.aperture_m, camera.focus_m,
        )  # fmt: skip
        radiance = stained(radiance, layer)
        alpha = 1 - (1 - alpha) * (1 - layer[..., 3])
    # Other random numbers than the rainy picture's, so that their noise is not the same.
    clean = scene.render(baked, camera, cam_from_world, spp=clean_spp, seed=2 * seed + 1)
    return WetView(
        as_bytes(scene.develop(radiance, exposure)),
        as_bytes(scene.develop(clean.radiance, exposure)),
        as_bytes(alpha),
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
) -> tuple[Bytes, npt.NDArray[np.float32]]:
    """A photo (H, W, 3) uint8 wetted by the painter, and its coverage (H, W) in [0, 1].

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
    spots = pane_stains(seed, focal, stains or {}, pane_m, stained_half(camera, pane_m))
    pane = np.eye(4)
    pane[2, 3] = pane_m
    return _with_stains(rainy, alpha, spots, camera_matrix(camera), pane, camera.aperture_m)


def _with_stains(
    rainy: npt.NDArray[np.float32],
    alpha: npt.NDArray[np.float32],
    spots: Stains | None,
    k: Matrix,
    cam_from_pane: Matrix,
    aperture_m: float,
) -> tuple[Bytes, npt.NDArray[np.float32]]:
    """The painted photo and its coverage with what else is on the pane."""
    if spots is None:
        return as_bytes(rainy), alpha
    size = (alpha.shape[1], alpha.shape[0])
    layer = stains_seen(spots, k, size, cam_from_pane, aperture_m, FOCUS_M)
    rainy = linear_to_srgb(stained(srgb_to_linear(rainy), layer))
    return as_bytes(rainy), 1 - (1 - alpha) * (1 - layer[..., 3])


def pane_plan(
    shots: Mapping[str, Shot],
    *,
    seed: int,
    pane_m: float,
    coverage: float,
    radius_mm: tuple[float, float],
    aperture_mm: float,
    stains: Mapping[str, float],
) -> tuple[Pane, list[Drop], Stains | None]:
    """A pane that stays in the scene, `pane_m` before the mean of the `shots`, and what is on it.

    For cameras that do not move, drops and stains are those of `painted`. UserError as pane_before.
    """
    pane = pane_before(shots, pane_m, aperture_mm / 1000)
    first = next(iter(shots.values()))
    focal = float(np.sqrt(first.k[0, 0] * first.k[1, 1]))
    on_lens = max(first.size) / 2 / focal * pane_m
    finer = max(1, round(max(pane.half) / on_lens))  # the raster's pixels stay as small
    radii = (radius_mm[0] / 1000, radius_mm[1] / 1000)
    drops = sample_drops(
        np.random.default_rng([seed, 2]), *pane.half, coverage, radii, resolution=512 * finer
    )
    edge = aperture_mm / 1000
    half = [1.05 * (side - edge) + edge for side in pane.half]
    return pane, drops, pane_stains(seed, focal, stains, pane_m, half)


def painted_pane(
    photo: Bytes,
    shot: Shot,
    pane: Pane,
    drops: Sequence[Drop],
    spots: Stains | None,
    *,
    aperture_mm: float,
) -> tuple[Bytes, npt.NDArray[np.float32]]:
    """A posed photo (H, W, 3) uint8 through a pane in the scene, and its coverage (H, W) in [0, 1]."""
    cam_from_pane = shot.cam_from_world @ pane.world_from_pane
    rainy, alpha = paint_pane(
        photo.astype(np.float32) / np.float32(255), list(drops), cam_from_pane, shot.k,
        aperture_radius=aperture_mm / 1000, focus_distance=FOCUS_M,
    )  # fmt: skip
    return _with_stains(rainy, alpha, spots, shot.k, cam_from_pane, aperture_mm / 1000)
