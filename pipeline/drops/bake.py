"""Irradiance of a place's vertices from sky, sun, lamps and bounces, computed once per place.

Diffuse light does not depend on the camera, so a picture of the baked place is exactly what a
radiance field can represent, and a sample of it costs one ray. The drops neither shade the place
nor throw caustics on it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.drops.places import Place
from pipeline.errors import UserError

if TYPE_CHECKING:
    from pipeline.drops.places_parts import TexturedMesh

Array = npt.NDArray[Any]  # float32 where it is stored
SCALE = 10.0  # Mitsuba units per metre: its ray offset biases millimetre drops in metre units
VARIANT = "llvm_ad_rgb"
LIGHT = "vertex_light"
_MISSING = "pip install '.[synth]', and the LLVM library (Debian and Ubuntu: apt install libllvm19)"


def mitsuba() -> Any:
    """The mitsuba module with its LLVM variant set. Raises UserError where it cannot work."""
    try:
        import mitsuba as mi
    except ImportError as error:
        raise UserError(f"Mitsuba is not installed ({error})", hint=_MISSING) from error
    try:
        if mi.variant() != VARIANT:
            mi.set_variant(VARIANT)
            mi.set_log_level(mi.LogLevel.Error)
        import drjit as dr

        dr.eval(mi.Float([0.0, 1.0]) + 1)
    except Exception as error:
        raise UserError(f"Mitsuba found no usable LLVM library ({error})", hint=_MISSING) from error
    return mi


def shape(mesh: TexturedMesh, light: Array, shift: npt.ArrayLike = (0, 0, 0)) -> Any:
    """Mitsuba mesh of the mesh moved by -shift (metres) and scaled, carrying `light` (N, 3).

    light: radiance factor per vertex; a point's radiance is its texture times the interpolated
    light.
    """
    mi = mitsuba()
    bitmap = {
        "type": "bitmap", "data": mi.TensorXf(mesh.texture), "raw": True, "filter_type": "bilinear",
        "wrap_mode": "repeat",
    }  # fmt: skip
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": bitmap})
    out = mi.Mesh(mesh.name, len(mesh.vertices), len(mesh.faces), props, False, True)
    out.add_attribute(LIGHT, 3, np.ascontiguousarray(light, np.float32).ravel())
    params = mi.traverse(out)
    moved = (mesh.vertices - np.asarray(shift, np.float32)) * np.float32(SCALE)
    params["vertex_positions"] = mi.Float(np.ascontiguousarray(moved).ravel())
    params["vertex_texcoords"] = mi.Float(np.ascontiguousarray(mesh.uv, np.float32).ravel())
    params["faces"] = mi.UInt32(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
    params.update()
    return out


def sky_emitter(place: Place) -> Any:
    """Mitsuba emitter of the place's sky."""
    mi = mitsuba()
    # Mitsuba's map has +y up and its middle column along +z seen from inside with x to the left;
    # half a turn about z brings our axes (y down) to that.
    to_world = mi.ScalarTransform4f().rotate([0, 0, 1], 180)
    bitmap = mi.Bitmap(np.ascontiguousarray(place.sky, np.float32))
    return mi.load_dict({"type": "envmap", "bitmap": bitmap, "to_world": to_world})


def hit_radiance(scene: Any, ray: Any, si: Any, active: Any) -> Any:
    """Radiance towards the ray's origin: texture times baked light; the sky's where it misses."""
    import drjit as dr

    mi = mitsuba()
    valid = active & si.is_valid()
    bsdf = si.bsdf(ray)
    surface = bsdf.eval_diffuse_reflectance(si, valid) * si.shape.eval_attribute_3(LIGHT, si, valid)
    sky = scene.environment().eval(si, active & ~si.is_valid())
    return dr.select(valid, mi.Color3f(surface), mi.Color3f(sky))


def _hammersley(n: int) -> npt.NDArray[np.float64]:
    index = np.arange(n)
    bits = np.zeros(n)
    weight, rest = 0.5, index.copy()
    for _ in range(32):
        bits += weight * (rest & 1)
        rest >>= 1
        weight *= 0.5
    return np.stack([(index + 0.5) / n, bits], 1)


def _visible(
    scene: Any, origin: Array, direction: Array, far: npt.NDArray[np.floating]
) -> npt.NDArray[np.bool_]:
    mi = mitsuba()
    o, d = (
        mi.Point3f(np.ascontiguousarray(origin.T)),
        mi.Vector3f(np.ascontiguousarray(direction.T)),
    )
    ray = mi.Ray3f(o, d, mi.Float(np.ascontiguousarray(far, np.float32)), 0.0, [])
    return ~np.asarray(scene.ray_test(ray)).astype(bool)


def direct_light(scene: Any, place: Place, points: Array, normals: Array) -> Array:
    """Irradiance (N, 3) of the sun and the lamps at points in Mitsuba units, shadows included."""
    sun = np.broadcast_to(place.sun_direction, points.shape).astype(np.float32)
    cosine = np.maximum((normals * sun).sum(1), 0)
    lit = _visible(scene, points, sun, np.full(len(points), 1e5)) & (cosine > 0)
    out = (cosine * lit)[:, None] * place.sun_irradiance
    for lamp in place.lamps:
        way = np.asarray(lamp.position, np.float32) * SCALE - points
        distance = np.linalg.norm(way, axis=1)
        unit = (way / distance[:, None]).astype(np.float32)
        seen = _visible(scene, points, unit, distance * 0.98)
        falloff = (
            np.maximum((normals * unit).sum(1), 0) * seen / np.maximum(distance / SCALE, 0.1) ** 2
        )
        out = out + falloff[:, None] * np.asarray(lamp.intensity, np.float32)
    return out.astype(np.float32)


def _gathered(
    scene: Any, points: Array, normals: Array, count: int, rng: np.random.Generator
) -> Array:
    """Mean radiance (N, 3) that `count` cosine-distributed rays from each point meet.

    Every point has the same low-discrepancy set, shifted at random on the torus.
    """
    import drjit as dr

    mi = mitsuba()
    base = mi.Point2f(np.ascontiguousarray(_hammersley(count).T.astype(np.float32)))
    out, chunk = [], max(1, 4_000_000 // count)
    for start in range(0, len(points), chunk):
        part = slice(start, start + chunk)
        n = len(points[part])
        which = dr.arange(mi.UInt32, n * count)
        vertex, number = which // count, which % count
        columns = (points[part], normals[part], rng.random((n, 2), np.float32))
        place, normal, shift = (np.ascontiguousarray(c.T) for c in columns)
        u = dr.gather(mi.Point2f, base, number) + dr.gather(mi.Point2f, mi.Point2f(shift), vertex)
        local = mi.warp.square_to_cosine_hemisphere(u - dr.floor(u))
        frame = mi.Frame3f(dr.gather(mi.Normal3f, mi.Normal3f(normal), vertex))
        ray = mi.Ray3f(dr.gather(mi.Point3f, mi.Point3f(place), vertex), frame.to_world(local))
        light = hit_radiance(scene, ray, scene.ray_intersect(ray), mi.Bool(True))
        sums = [dr.block_sum(c, count) / count for c in (light.x, light.y, light.z)]
        out.append(np.stack([np.asarray(c) for c in sums], 1))
    return np.concatenate(out).astype(np.float32)


def bake(place: Place, *, rays: int = 128, bounces: int = 2) -> list[Array]:
    """Light per vertex of each mesh, (N, 3) float32 radiance factors, tint and glow included.

    rays: directions per vertex and pass; bounces: of light between surfaces after the first.
    The random directions depend on the place's seed alone.
    """
    mi = mitsuba()
    rng = np.random.default_rng([place.seed, 1])
    lights = [np.zeros_like(m.vertices) + (m.tint * m.glow[:, None]) for m in place.meshes]
    normals = np.concatenate([m.normals for m in place.meshes])
    points = np.concatenate([m.vertices for m in place.meshes]) * np.float32(SCALE)
    points = (points + normals * np.float32(0.01 * SCALE)).astype(np.float32)
    counts = np.cumsum([len(m.vertices) for m in place.meshes])[:-1]
    sky = sky_emitter(place)
    sun = None
    for _ in range(bounces + 1):
        items = {
            str(k): shape(m, v) for k, (m, v) in enumerate(zip(place.meshes, lights, strict=True))
        }
        scene = mi.load_dict({"type": "scene", "sky": sky, **items})
        if sun is None:
            sun = direct_light(scene, place, points, normals)
        around = _gathered(scene, points, normals, rays, rng)
        radiosity = np.split(sun / np.float32(np.pi) + around, counts)
        lights = [
            (m.tint * (e + m.glow[:, None])).astype(np.float32)
            for m, e in zip(place.meshes, radiosity, strict=True)
        ]
    return lights
