"""Places to photograph: textured meshes, a sky, a sun and lamps, from a name and a seed."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.drops import places_diorama, places_harbour, places_room, places_street
from pipeline.drops.places_parts import Array, Builder, Lamp, TexturedMesh
from pipeline.drops.places_textures import noise
from pipeline.errors import UserError

Rng = np.random.Generator
SKY_HEIGHT = 256


@dataclass(frozen=True)
class Place:
    """A scene without its camera, in metres, the mean camera at the origin, x right, y down.

    sky: radiance (H, 2 H, 3) over directions, row 0 straight up (-y), the middle column along +z
    and columns to the right of it towards +x. sun_direction points to the sun, unit length;
    sun_irradiance is what it brings to a surface that faces it (zero: no sun).
    """

    name: str
    seed: int
    meshes: list[TexturedMesh]
    sky: Array
    sun_direction: Array
    sun_irradiance: Array
    lamps: list[Lamp]
    grey: float = 0.17  # to which an exposure meter brings the median: less where it is dark


def sky_directions(height: int) -> Array:
    """Unit directions (height, 2 * height, 3) of the centres of a sky map's pixels."""
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = ((np.arange(2 * height) + 0.5) / height - 1.0) * np.pi
    phi, theta = np.meshgrid(azimuth, polar)
    d = np.stack([np.sin(theta) * np.sin(phi), -np.cos(theta), np.sin(theta) * np.cos(phi)], -1)
    return d.astype(np.float32)


def clear_sky(rng: Rng, zenith: Array, horizon: Array, cloud: Array, *, cover: float) -> Array:
    """Sky map (SKY_HEIGHT, 2 * SKY_HEIGHT, 3): a gradient with clouds, brown below the horizon."""
    d = sky_directions(SKY_HEIGHT)
    up = np.clip(-d[..., 1], 0, 1)[..., None]
    base = zenith * np.sqrt(up) + horizon * (1 - np.sqrt(up))
    size = 2 * SKY_HEIGHT
    field = noise(rng, size, 4, 6)
    # A plane of clouds seen from below, so that they shrink towards the horizon.
    height = np.maximum(-d[..., 1], 0.12)
    u = np.floor(d[..., 0] / height * 60).astype(int) % size
    v = np.floor(d[..., 2] / height * 60).astype(int) % size
    thick = np.clip((field[v, u] - (0.9 - 1.8 * cover)) * 1.1, 0, 1)
    thick = np.where(-d[..., 1] > 0.03, thick, thick * 0.5)[..., None]
    sky = base * (1 - thick) + cloud * thick * (0.8 + 0.2 * up)
    below = np.asarray([0.10, 0.09, 0.08], np.float32)
    return np.where(d[..., 1:2] > 0.02, below, sky).astype(np.float32)


def _bright_sky(rng: Rng) -> Array:
    zenith, horizon = np.array([0.20, 0.42, 0.85]) * 0.7, np.array([0.62, 0.78, 0.95]) * 0.75
    cloud = np.array([0.85, 0.85, 0.86])
    return clear_sky(rng, zenith, horizon, cloud, cover=rng.uniform(0.35, 0.6))


def _street(rng: Rng) -> tuple[Builder, dict[str, object]]:
    b = places_street.build(rng)
    azimuth, elevation = rng.uniform(-2.4, 2.4), rng.uniform(0.6, 1.0)
    # Behind the camera's plane more often than not, so that the fronts are lit.
    azimuth = np.pi - 0.45 * azimuth
    sun = [
        np.cos(elevation) * np.sin(azimuth),
        -np.sin(elevation),
        np.cos(elevation) * np.cos(azimuth),
    ]
    warm = np.array([1.0, 0.93, 0.82]) * rng.uniform(2.2, 3.2)
    sky = _bright_sky(rng)
    return b, {"sky": sky, "sun": sun, "irradiance": warm, "lamps": []}


def _room(rng: Rng) -> tuple[Builder, dict[str, object]]:
    b, lamps = places_room.build(rng)
    sun = [rng.uniform(-0.6, 0.6), -0.75, 0.75]
    sky = clear_sky(rng, np.array([0.5, 0.7, 1.0]) * 1.6, np.array([0.9, 0.95, 1.0]) * 1.9,
                    np.array([1, 1, 1.0]) * 2.2, cover=0.5)  # fmt: skip
    return b, {"sky": sky, "sun": sun, "irradiance": np.array([1, 0.93, 0.8]) * 5,
               "lamps": lamps}  # fmt: skip


def _harbour(rng: Rng) -> tuple[Builder, dict[str, object]]:
    b, lamps = places_harbour.build(rng)
    tone = rng.uniform(0.8, 1.2)
    sky = clear_sky(rng, np.array([0.05, 0.09, 0.22]) * tone, np.array([0.62, 0.34, 0.22]) * tone,
                    np.array([0.40, 0.26, 0.28]) * tone, cover=rng.uniform(0.3, 0.5))  # fmt: skip
    return b, {"sky": sky, "sun": [0.3, -0.1, 1.0], "irradiance": np.zeros(3),
               "lamps": lamps, "grey": 0.10}  # fmt: skip


def _diorama(rng: Rng) -> tuple[Builder, dict[str, object]]:
    b = places_diorama.build(rng)
    warm = np.array([1.0, 0.93, 0.82]) * rng.uniform(2.2, 3.2)
    sky = _bright_sky(rng)
    sun = [rng.uniform(-0.6, 0.6), -0.7, -0.7]  # behind the camera
    return b, {"sky": sky, "sun": sun, "irradiance": warm, "lamps": []}


_PLACES: dict[str, Callable[[Rng], tuple[Builder, dict[str, object]]]] = {
    "street": _street,
    "diorama": _diorama,
    "room": _room,
    "harbour": _harbour,
}
NAMES = tuple(_PLACES)


def build(name: str, seed: int) -> Place:
    """The place of that name, its layout, textures and light drawn from the seed.

    Same name and seed, same arrays. Raises UserError if there is no place of that name.
    """
    if name not in _PLACES:
        raise UserError(f"no place is called {name!r}", hint=f"Use one of {', '.join(NAMES)}.")
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # how cv2.resize rounds depends on the number of threads
    try:
        builder, light = _PLACES[name](rng)
    finally:
        cv2.setNumThreads(threads)
    sun = np.asarray(light["sun"], np.float32)
    return Place(
        name=name,
        seed=seed,
        meshes=builder.meshes(),
        sky=np.asarray(light["sky"], np.float32),
        sun_direction=sun / np.linalg.norm(sun),
        sun_irradiance=np.asarray(light["irradiance"], np.float32),
        lamps=list(light["lamps"]),  # type: ignore[call-overload]
        grey=float(light.get("grey", 0.17)),  # type: ignore[arg-type]
    )
