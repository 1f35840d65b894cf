"""Drops painted onto a photograph: for any photo, fast, with the exact coverage used.

The water's height field bends the rays of a pinhole camera (Snell, Fresnel, total reflection);
what they meet beyond the photo is a smooth guess. The drop layer is defocused by the lens as a
whole, since the pane is perpendicular to the optical axis, and composed in linear light.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.drops.optics import (
    Environment,
    Image,
    blur_diameter_px,
    defocus,
    linear_to_srgb,
    make_environment,
    srgb_to_linear,
    through_drop,
)
from pipeline.drops.shape import CONTACT_ANGLES, Drop, extended_height, reach, sample_drop


def paint(
    image: Image,
    drops: list[Drop],
    *,
    focal_px: float,
    pane_distance: float,
    aperture_radius: float = 0.0,
    focus_distance: float = np.inf,
    highlight: float = 2.0,
    sky_gain: float = 1.5,
    rim_light: float = 0.4,
    surroundings: Image | None = None,
    supersample: int = 2,
) -> tuple[Image, NDArray[np.float32]]:
    """The photo as seen through the wet pane, and how much of each pixel the water covers.

    image: (H, W, 3) float32 sRGB in [0, 1], optical axis at its centre. drops: in pane metres, the
    pane `pane_distance` in front of the camera. aperture_radius, focus_distance: metres, of the
    lens. highlight: by how much clipped whites are taken to be brighter than they look; sky_gain:
    light from above the photo over its brightest upper colour. rim_light: light left after total
    reflection. surroundings: factors about 1 that structure what lies beyond the photo.
    Returns (H, W, 3) sRGB and (H, W) coverage in [0, 1], the alpha of the composition: it depends
    on drops and camera alone, so that the same drops give the same coverage in every photo.
    Without drops the image comes back unchanged.
    """
    height, width = image.shape[:2]
    if not drops:
        return image.copy(), np.zeros((height, width), np.float32)
    light, environment = photo_light(
        image, focal_px, highlight=highlight, sky_gain=sky_gain, surroundings=surroundings
    )
    blur = blur_diameter_px(focal_px, aperture_radius, pane_distance, focus_distance)
    layer = paint_layer(
        (height, width),
        drops,
        environment,
        focal_px=focal_px,
        pane_distance=pane_distance,
        blur_px=blur,
        rim_light=rim_light,
        supersample=supersample,
    )
    return composed(image, light, layer)


def photo_light(
    image: Image,
    focal_px: float,
    *,
    highlight: float,
    sky_gain: float,
    surroundings: Image | None = None,
    centre: tuple[float, float] | None = None,
) -> tuple[Image, Environment]:
    """Linear light (H, W, 3) of an sRGB photo, and what drops before it look into; see `paint`."""
    light = srgb_to_linear(image)
    bright = expand_highlights(light, highlight)
    small = cv2.resize(bright, (32, 32), interpolation=cv2.INTER_AREA)
    sky = np.percentile(small[:16].reshape(-1, 3), 95, axis=0) * sky_gain
    sky = 0.5 * sky + 0.5 * sky.mean()  # the sky is greyer than what stands before it
    return light, make_environment(
        bright, focal_px, sky=sky, surroundings=surroundings, centre=centre
    )


def composed(image: Image, light: Image, layer: Image) -> tuple[Image, NDArray[np.float32]]:
    """The layer (H, W, 4) over the photo, sRGB, and its coverage; where there is none, `image` itself.

    light: linear light (H, W, 3) of the photo.
    """
    alpha = np.clip(layer[..., 3], 0.0, 1.0)
    wet = linear_to_srgb(layer[..., :3] + light * (1 - alpha[..., None]))
    return np.where(alpha[..., None] > 0, wet, image).astype(np.float32), alpha


def expand_highlights(light: Image, strength: float) -> Image:
    """Linear light with near-white values raised, up to 1 + strength times: undoes clipping."""
    peak = np.clip((light.max(axis=2, keepdims=True) - 0.8) / 0.2, 0.0, 1.0)
    return (light * (1 + strength * peak * peak)).astype(np.float32)


def paint_layer(
    size: tuple[int, int],
    drops: list[Drop],
    environment: Environment,
    *,
    focal_px: float,
    pane_distance: float,
    blur_px: float = 0.0,
    rim_light: float = 0.4,
    supersample: int = 2,
) -> Image:
    """Premultiplied linear RGB and alpha (H, W, 4) of the drops alone, defocused.

    size: (H, W) of the photo in pixels; blur_px: diameter of the disc of confusion.
    """
    pad = int(np.ceil(blur_px / 2)) + 2
    rows, columns = size[0] + 2 * pad, size[1] + 2 * pad
    shape = (rows * supersample, columns * supersample)
    scale = focal_px * supersample / pane_distance  # raster pixels per metre of pane
    slope, covered = _slopes(shape, drops, scale)
    at = np.nonzero(covered)
    ray = np.empty((len(at[0]), 3), np.float32)
    ray[:, 0] = (at[1] + 0.5 - shape[1] / 2) / (focal_px * supersample)
    ray[:, 1] = (at[0] + 0.5 - shape[0] / 2) / (focal_px * supersample)
    ray[:, 2] = 1.0
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return lit_layer(
        covered, slope, ray, environment, pad=pad, blur_px=blur_px, rim_light=rim_light, supersample=supersample
    )  # fmt: skip


def lit_layer(
    covered: NDArray[np.bool_],
    slope: Image,
    ray: Image,
    environment: Environment,
    *,
    pad: int,
    blur_px: float,
    rim_light: float,
    supersample: int,
) -> Image:
    """Premultiplied linear RGB and alpha (H, W, 4) of water, defocused, its border of `pad` cut off.

    covered (R, C), slope (R, C, 2): on a raster `supersample` times finer than the photo with its
    border. ray (N, 3): unit directions through the covered raster pixels, row by row.
    """
    at = np.nonzero(covered)
    layer = np.zeros((*covered.shape, 4), np.float32)
    if len(ray):
        layer[at[0], at[1], :3] = through_drop(ray, slope[at], environment, rim_light=rim_light)
        layer[at[0], at[1], 3] = 1.0
    rows, columns = (n // supersample for n in covered.shape)
    if supersample > 1:
        layer = cv2.resize(layer, (columns, rows), interpolation=cv2.INTER_AREA)
    layer = defocus(layer, blur_px)
    inside = layer[pad : rows - pad, pad : columns - pad].copy()
    inside[inside[..., 3] < 1e-4] = 0.0  # rounding of the convolution
    return inside


def _slopes(
    shape: tuple[int, int], drops: list[Drop], scale: float
) -> tuple[Image, NDArray[np.bool_]]:
    """Slope (H, W, 2) of the water over the pane and where there is any (H, W).

    scale: raster pixels per metre of pane; the pane's origin is at the raster's centre.
    """
    slope = np.zeros((*shape, 2), np.float32)
    covered = np.zeros(shape, np.bool_)
    for drop in drops:
        half = reach(drop) * scale + 2
        column = drop.center[0] * scale + shape[1] / 2
        row = drop.center[1] * scale + shape[0] / 2
        top, bottom = max(int(row - half), 0), min(int(row + half) + 2, shape[0])
        left, right = max(int(column - half), 0), min(int(column + half) + 2, shape[1])
        if bottom - top < 2 or right - left < 2:
            continue
        y = ((np.arange(top, bottom) + 0.5 - shape[0] / 2) / scale)[:, None]
        x = ((np.arange(left, right) + 0.5 - shape[1] / 2) / scale)[None, :]
        level = extended_height(drop, x, y)
        inside = level > 0
        if not inside.any():
            continue
        steep = np.gradient(level * scale)
        window = (slice(top, bottom), slice(left, right))
        covered[window] |= inside
        slope[window][inside] = np.stack([steep[1][inside], steep[0][inside]], axis=1)
    return slope, covered


@lru_cache(maxsize=1)
def _templates() -> tuple[Drop, ...]:
    """A fixed stock of drop shapes: their tables cost more than everything else together."""
    rng = np.random.default_rng(20240229)
    return tuple(
        sample_drop(
            rng,
            (0.0, 0.0),
            1.0,
            merged_share=0.35,
            run_share=0.12 if i % 2 else 0.0,
            irregularity=rng.uniform(0.3, 1.6),
        )
        for i in range(600)
    )


def scatter(
    rng: np.random.Generator,
    size: tuple[int, int],
    coverage: float,
    radius_range_px: tuple[float, float],
    *,
    size_exponent: float = 1.5,
    contact_angle_range: tuple[float, float] = CONTACT_ANGLES,
    margin: float = 0.0,
    max_drops: int = 160,
) -> list[Drop]:
    """Random drops with pixels for metres (pane at a distance of one focal length).

    About `coverage` of the rectangle of `size` (H, W), widened by `margin` on all sides, is
    covered; drops may touch. Faster and less exact than shape.sample_drops.
    """
    stock = _templates()
    low, high = radius_range_px
    half = np.array([size[1] / 2 + margin, size[0] / 2 + margin])
    wanted = coverage * 4 * half[0] * half[1]
    angle = rng.uniform(*contact_angle_range)  # of one pane: drops on it resemble each other
    drops: list[Drop] = []
    places = np.empty((max_drops, 3))
    area = 0.0
    for _ in range(5 * max_drops):
        if area >= wanted or len(drops) >= max_drops:
            break
        radius = _radius(rng, low, high, size_exponent)
        if area > 0 and np.pi * radius**2 > 2.0 * (wanted - area):
            continue
        center = rng.uniform(-half - 0.6 * radius, half + 0.6 * radius)
        others = places[: len(drops)]
        apart = (others[:, 0] - center[0]) ** 2 + (others[:, 1] - center[1]) ** 2
        if (apart < (0.95 * (others[:, 2] + radius)) ** 2).any():
            continue
        places[len(drops)] = center[0], center[1], radius
        chosen = stock[int(rng.integers(len(stock)))]
        # Half as many shapes with tails among the small ones, which seldom run.
        if radius < 0.25 * high and chosen.tail_length > 0:
            chosen = stock[int(rng.integers(len(stock) // 2)) * 2]
        own = float(np.clip(angle + rng.normal(0, 0.12), *contact_angle_range))
        drops.append(
            replace(
                chosen,
                center=(float(center[0]), float(center[1])),
                radius=float(radius),
                contact_angle=own,
            )
        )
        area += np.pi * radius**2
    return drops


def _radius(rng: np.random.Generator, low: float, high: float, exponent: float) -> float:
    """Drawn from `low` to `high` with a density that falls as the radius to the power -`exponent`."""
    draw, power = rng.random(), 1 - exponent
    if abs(power) < 1e-6:
        return low * (high / low) ** draw
    return (low**power + draw * (high**power - low**power)) ** (1 / power)
