"""Pictures of a place through refracting drops, by Mitsuba: colour, water coverage and depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.drops import shape as drop_shape
from pipeline.drops.bake import SCALE, bake, hit_radiance, mitsuba, shape, sky_emitter
from pipeline.drops.places import Place

Array = npt.NDArray[Any]  # float32 where it is stored
WATER_IOR = 1.333
MAX_EVENTS = 14


@dataclass(frozen=True)
class Camera:
    """Thin-lens camera: pixels and focal length in pixels, lens radius and focus in metres."""

    width: int
    height: int
    focal_px: float
    aperture_m: float = 0.0
    focus_m: float = 8.0


@dataclass(frozen=True)
class Picture:
    """A render. radiance (H, W, 3) linear; alpha (H, W) share of the camera's rays that meet water;

    depth (H, W) metres along the optical axis, 0 where nothing was hit (means over the rays).
    """

    radiance: Array
    alpha: Array
    depth: Array


@dataclass(frozen=True)
class Baked:
    """A place with its light per vertex, and the exposure that suits it."""

    place: Place
    lights: list[Array]


def _trace(scene: Any, ray: Any, sampler: Any) -> tuple[Any, Any, Any, Any]:
    """Radiance behind any chain of water surfaces, and of the first surface: is it water, its

    distance if it is solid, and whether it is. Texture times baked light ends the chain.
    """
    import drjit as dr

    mi = mitsuba()

    def more(ray: Any, going: Any, event: Any, *_: Any) -> Any:
        return going & (event < MAX_EVENTS)

    def follow(
        ray: Any, going: Any, event: Any, weight: Any, colour: Any,
        alpha: Any, distance: Any, hit: Any, sampler: Any,
    ) -> tuple[Any, ...]:  # fmt: skip
        si = scene.ray_intersect(ray, going)
        bsdf = si.bsdf(ray)
        water = going & si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        ended = going & ~water
        colour = colour + dr.select(ended, weight * hit_radiance(scene, ray, si, ended), 0)
        first = event == 0
        solid = first & ended & si.is_valid()
        alpha = dr.select(first & water, 1.0, alpha)
        distance, hit = dr.select(solid, si.t, distance), dr.select(solid, 1.0, hit)
        context, one, two = mi.BSDFContext(), sampler.next_1d(water), sampler.next_2d(water)
        bs, value = bsdf.sample(context, si, one, two, water)
        weight = dr.select(water, weight * value, weight)
        ray = dr.select(water, si.spawn_ray(si.to_world(bs.wo)), ray)
        return ray, water, event + 1, weight, colour, alpha, distance, hit, sampler

    start = (mi.Ray3f(ray), mi.Bool(True), mi.UInt32(0), mi.Color3f(1), mi.Color3f(0),
             mi.Float(0), mi.Float(0), mi.Float(0), sampler)  # fmt: skip
    end = dr.while_loop(start, more, follow, label="water")
    return end[4], end[5], end[6], end[7]


def _pixel_means(scene: Any, camera: Camera, sensor: Any, spp: int, seed: int) -> Array:
    """Means (H, W, 6) over each pixel's rays: radiance, alpha, distance, hit.

    Every pixel's rays are summed in their order. Mitsuba's own film adds them as its threads
    finish, so that the last bits of a picture would depend on the number of cores.
    """
    import drjit as dr

    mi = mitsuba()
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    spp = sampler.sample_count()  # rounded up to a grid
    size = camera.width * camera.height * spp
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, size)
    pixel = dr.arange(mi.UInt32, size) // spp
    corner = mi.Point2f(pixel % camera.width, pixel // camera.width)
    place = (corner + sampler.next_2d()) / mi.Point2f(camera.width, camera.height)
    lens = sampler.next_2d() if camera.aperture_m > 0 else mi.Point2f(0.5)
    ray, _ = sensor.sample_ray(0.0, 0.5, place, lens)
    colour, alpha, distance, hit = _trace(scene, ray, sampler)
    dr.eval(colour, alpha, distance, hit)  # at once: each sum would trace the rays again
    sums = [dr.block_sum(c, spp) for c in (*colour, alpha, distance, hit)]
    means = np.stack([np.asarray(c) for c in sums], axis=-1) / np.float32(spp)
    return means.reshape(camera.height, camera.width, 6)


def bake_place(place: Place, *, rays: int = 128, bounces: int = 2) -> Baked:
    """The place with its light; see bake.bake."""
    return Baked(place, bake(place, rays=rays, bounces=bounces))


def drops_mesh(drops: Sequence[drop_shape.Drop]) -> tuple[Array, npt.NDArray[np.uint32]]:
    """One mesh of all drops: vertices (V, 3) in the pane frame, metres, and faces (F, 3)."""
    vertices, faces, count = [], [], 0
    for drop in drops:
        v, f = drop_shape.mesh(drop)
        vertices.append(v)
        faces.append(f + count)
        count += len(v)
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32)


def _water(drops: Sequence[drop_shape.Drop], from_pane: Array) -> Any:
    """Mitsuba mesh of the drops; from_pane (4, 4): camera-centred world metres from pane frame."""
    mi = mitsuba()
    vertices, faces = drops_mesh(drops)
    moved = (vertices @ from_pane[:3, :3].T + from_pane[:3, 3]) * SCALE
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "dielectric", "int_ior": WATER_IOR, "ext_ior": 1.0})
    out = mi.Mesh("water", len(vertices), len(faces), props, False, False)
    params = mi.traverse(out)
    params["vertex_positions"] = mi.Float(np.ascontiguousarray(moved, np.float32).ravel())
    params["faces"] = mi.UInt32(np.ascontiguousarray(faces).ravel())
    params.update()
    return out


def _sensor(camera: Camera, world_from_cam: Array) -> dict[str, Any]:
    mi = mitsuba()
    pose = np.eye(4)
    pose[:3, :3] = world_from_cam[:3, :3] @ np.diag([-1.0, -1.0, 1.0])  # Mitsuba: x left, y up
    fov = float(np.degrees(2 * np.arctan(camera.width / 2 / camera.focal_px)))
    film = {
        "type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgb",
        "component_format": "float32", "rfilter": {"type": "box"},
    }  # fmt: skip
    lens: dict[str, Any] = {"type": "perspective"}
    if camera.aperture_m > 0:
        lens = {"type": "thinlens", "aperture_radius": camera.aperture_m * SCALE,
                "focus_distance": camera.focus_m * SCALE}  # fmt: skip
    return {
        **lens, "to_world": mi.ScalarTransform4f(pose), "fov": fov, "fov_axis": "x",
        "near_clip": 0.001 * SCALE, "far_clip": 1000 * SCALE, "film": film,
    }  # fmt: skip


def _cosines(camera: Camera) -> Array:
    """Cosine (H, W) between each pixel's ray and the optical axis."""
    x = (np.arange(camera.width) + 0.5 - camera.width / 2) / camera.focal_px
    y = (np.arange(camera.height) + 0.5 - camera.height / 2) / camera.focal_px
    return (1 / np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)).astype(np.float32)


def render(
    baked: Baked,
    camera: Camera,
    cam_from_world: npt.NDArray[np.floating],
    *,
    spp: int,
    seed: int,
    drops: Sequence[drop_shape.Drop] = (),
    world_from_pane: npt.NDArray[np.floating] | None = None,
    pane_m: float = 0.12,
) -> Picture:
    """A picture from one camera, through `drops` if there are any.

    cam_from_world (4, 4), OpenCV axes. The pane stands `pane_m` in front of the lens and moves
    with it, unless world_from_pane (4, 4) fixes it in the world. The world is moved so that the
    camera is at the origin: far from it, Mitsuba's ray offset is no longer small beside a drop.
    """
    mi = mitsuba()
    world_from_cam = np.linalg.inv(np.asarray(cam_from_world, np.float64))
    centre = world_from_cam[:3, 3]
    items = {
        f"part{k:02d}": shape(m, v, centre)
        for k, (m, v) in enumerate(zip(baked.place.meshes, baked.lights, strict=True))
    }
    if len(drops):
        if world_from_pane is None:
            pane = np.eye(4)
            pane[2, 3] = pane_m
            world_from_pane = world_from_cam @ pane
        around_camera = np.array(world_from_pane, np.float64)
        around_camera[:3, 3] -= centre
        items["water"] = _water(drops, around_camera)
    scene = mi.load_dict({"type": "scene", "sky": sky_emitter(baked.place), **items})
    sensor = mi.load_dict(_sensor(camera, world_from_cam.astype(np.float32)))
    image = _pixel_means(scene, camera, sensor, spp, seed)
    distance, hit = image[..., 4], image[..., 5]
    depth = np.where(hit > 0.5, distance / np.maximum(hit, 1e-6), 0) / SCALE * _cosines(camera)
    return Picture(
        np.ascontiguousarray(image[..., :3], np.float32),
        np.clip(image[..., 3], 0, 1).astype(np.float32),
        depth.astype(np.float32),
    )


def exposure(radiance: Array, *, grey: float = 0.17, white: float = 0.97) -> float:
    """Factor that brings a picture's median luminance to `grey`, sparing its whites."""
    luminance = radiance @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    middle, high = np.percentile(luminance, [50, 97])
    return float(min(grey / max(middle, 1e-6), 1.6 * white / max(high, 1e-6)))


def develop(radiance: Array, factor: float) -> Array:
    """sRGB picture in [0, 1] of linear radiance times `factor`, clipped at white."""
    value = np.clip(radiance * factor, 0, 1)
    out = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return out.astype(np.float32)


def trajectory(
    rng: np.random.Generator,
    views: int,
    *,
    half_width: float = 0.55,
    half_height: float = 0.32,
    turn_deg: float = 2.0,
) -> list[npt.NDArray[np.float64]]:
    """cam_from_world (4, 4) of `views` cameras on a forward-facing grid, row by row, jittered.

    The grid is 3:2 and centred on the origin; each camera is turned by about `turn_deg` degrees.
    """
    columns = max(1, round(np.sqrt(views * 1.5)))
    rows = int(np.ceil(views / columns))
    poses: list[npt.NDArray[np.float64]] = []
    for k in range(views):
        row, column = divmod(k, columns)
        column = column if row % 2 == 0 else columns - 1 - column
        x = half_width * (2 * column / max(columns - 1, 1) - 1)
        y = half_height * (2 * row / max(rows - 1, 1) - 1)
        jitter = rng.normal(0, 0.03, 3)
        yaw, pitch, roll = np.radians(rng.normal(0, turn_deg, 3) * [1, 0.8, 0.5])
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3] = _rotation(yaw, pitch, roll)
        world_from_cam[:3, 3] = np.array([x, y, 0.0]) + jitter
        poses.append(np.asarray(np.linalg.inv(world_from_cam), np.float64))
    return poses


def _rotation(yaw: float, pitch: float, roll: float) -> npt.NDArray[np.float64]:
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (np.cos, np.sin))
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return about_y @ about_x @ about_z
