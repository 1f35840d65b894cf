"""Training pairs for a drop detector: a rainy photograph and the coverage painted onto it."""

from __future__ import annotations

import copy
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.drops.optics import Image, linear_to_srgb, srgb_to_linear
from pipeline.drops.painter import paint, scatter

CLEAN_SHARE = 0.08
Kind = Literal["drops", "veils", "films"]
KINDS: tuple[Kind, ...] = ("drops", "veils", "films")


def sample_pair(
    rng: np.random.Generator, background: Image, *, clean_share: float = CLEAN_SHARE
) -> tuple[Image, NDArray[np.float32]]:
    """A rainy image (H, W, 3) and its soft coverage (H, W), everything about the rain drawn.

    background: (H, W, 3) float32 sRGB in [0, 1], at least 32 pixels a side. The coverage is the
    alpha of the composition; with probability clean_share there is no water and it is all zero,
    while the image still goes through glass, noise and compression.
    """
    rainy, _, coverage = sample_shots(rng, background, clean_share=clean_share)
    return rainy, coverage


def sample_shots(
    rng: np.random.Generator,
    background: Image,
    *,
    clean_share: float = CLEAN_SHARE,
    kind: Kind = "drops",
) -> tuple[Image, Image, NDArray[np.float32]]:
    """The pair of `sample_pair` with, in its middle, the same photo without the drops.

    Both photos are taken through the same pane by the same camera with the same noise, so that
    they differ where the water shows and nowhere else (but for what compression does). kind: veils are wide
    flat water or drops blurred to faint discs; films have no outline, as a haze of water or a reflection.
    """
    height, width = background.shape[:2]
    dry = through_glass(rng, background)
    wet, coverage = dry, np.zeros((height, width), np.float32)
    if rng.random() >= clean_share:
        wet, coverage = {"drops": _wet, "veils": _veiled, "films": _filmed}[kind](rng, dry)
    clean = through_camera(copy.deepcopy(rng), dry)
    return through_camera(rng, wet), clean, coverage


def _wet(rng: np.random.Generator, image: Image) -> tuple[Image, NDArray[np.float32]]:
    height, width = image.shape[:2]
    side = max(height, width)
    largest = float(np.exp(rng.uniform(np.log(3.0), np.log(0.17 * side))))
    if rng.random() < 0.06:
        largest = float(rng.uniform(0.17, 0.35) * side)
    smallest = max(largest * rng.uniform(0.05, 0.6), 0.8)
    kind = rng.random()
    if kind < 0.35:
        blur = float(rng.uniform(0.0, 1.5))  # the pane is (nearly) in focus
    elif kind < 0.6:
        blur = float(rng.uniform(0.1, 0.8) * largest)
    else:
        blur = float(rng.uniform(0.7, 2.2) * largest)  # a window close to the lens
    blur = min(blur, 44.0)
    # Drops much smaller than the disc of confusion leave nothing visible.
    smallest = max(smallest, 0.25 * blur)
    largest = max(largest, 1.3 * smallest)
    # Drops are small against their distance, else they would magnify rather than invert.
    focal = max(float(side * np.exp(rng.uniform(np.log(0.7), np.log(4.0)))), 6.0 * largest)
    # Clean wet glass holds flatter drops than the usual 30 to 80 degrees.
    angles = np.radians((12, 40) if rng.random() < 0.35 else (30, 80))
    drops = scatter(
        rng,
        (height, width),
        float(np.exp(rng.uniform(np.log(0.03), np.log(0.40)))),
        (smallest, largest),
        size_exponent=float(rng.uniform(0.5, 3.0)),
        contact_angle_range=(float(angles[0]), float(angles[1])),
        margin=0.5 * blur,
    )
    return paint(
        image,
        drops,
        focal_px=focal,
        pane_distance=focal,  # one metre per pixel: only angles matter here
        aperture_radius=blur / 2,
        highlight=float(rng.uniform(0.0, 5.0)),
        # Most drops gather light from above the photo: before dark things they look white.
        sky_gain=float(np.exp(rng.uniform(np.log(0.7), np.log(6.0)))),
        rim_light=float(rng.uniform(0.15, 0.7)),
        surroundings=_surroundings(rng),
    )


def _veiled(rng: np.random.Generator, image: Image) -> tuple[Image, NDArray[np.float32]]:
    """Wide flat water or faint blurred discs: what drops look like on clean glass, or very close."""
    side = max(image.shape[:2])
    largest = float(side * np.exp(rng.uniform(np.log(0.05), np.log(0.3))))
    # Sharp or soft outlines of films, or discs of confusion wider than the water that makes them.
    films = rng.random() < 0.5
    blur = float(rng.uniform(0.0, 0.8 if films else 3.0) * largest)
    blur = min(blur, 60.0)
    largest = max(largest, 0.4 * blur)
    smallest = max(largest * float(rng.uniform(0.15, 0.7)), 0.2 * blur, 0.8)
    focal = max(float(side * np.exp(rng.uniform(np.log(0.7), np.log(4.0)))), 6.0 * largest)
    drops = scatter(
        rng,
        image.shape[:2],
        float(np.exp(rng.uniform(np.log(0.05), np.log(0.5)))),
        (smallest, max(largest, 1.3 * smallest)),
        size_exponent=float(rng.uniform(0.5, 2.0)),
        contact_angle_range=(np.radians(4), np.radians(22 if films else 50)),
        margin=0.5 * blur,
    )
    return paint(
        image,
        drops,
        focal_px=focal,
        pane_distance=focal,
        aperture_radius=blur / 2,
        highlight=float(rng.uniform(0.0, 3.0)),
        sky_gain=float(np.exp(rng.uniform(np.log(0.5), np.log(3.0)))),
        rim_light=float(rng.uniform(0.15, 0.7)),
        surroundings=_surroundings(rng),
    )


def _filmed(rng: np.random.Generator, image: Image) -> tuple[Image, NDArray[np.float32]]:
    """Films: the photo shifted and blurred under light from elsewhere, beginning nowhere; often among drops."""
    wet, coverage = _wet(rng, image) if rng.random() < 0.7 else (image, np.float32(0))
    size = (image.shape[1], image.shape[0])
    field, *shift = (_waves(rng, size, int(rng.integers(2, 8))) for _ in range(3))
    ramp = (field - np.quantile(field, rng.uniform(0.5, 0.92))) / rng.uniform(0.2, 1.0)
    alpha = (np.clip(ramp, 0, 1) * rng.uniform(0.5, 1.0)).astype(np.float32)
    light = srgb_to_linear(wet)
    reach = np.float32(rng.uniform(1, 12))
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float32)
    seen = cv2.remap(light, x + reach * shift[0], y + reach * shift[1], cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REFLECT)  # fmt: skip
    seen = cv2.GaussianBlur(seen, (0, 0), float(np.exp(rng.uniform(0, np.log(10)))))
    glow = cv2.resize(_surroundings(rng), size, interpolation=cv2.INTER_CUBIC)
    glow = glow * (np.percentile(light, 95, axis=(0, 1)) * np.exp(rng.uniform(-0.7, 0.7)))
    film = seen + np.float32(rng.uniform(0.03, 0.5)) * (glow.astype(np.float32) - seen)
    out = linear_to_srgb(light + alpha[..., None] * (film - light))
    return np.where(alpha[..., None] > 0, out, wet), 1 - (1 - coverage) * (1 - alpha)


def _waves(rng: np.random.Generator, size: tuple[int, int], cells: int) -> NDArray[np.float32]:
    """A smooth random field (H, W) about 0 with `cells` ups and downs along a side; size: (W, H)."""
    grid = rng.normal(0, 1, (cells, cells)).astype(np.float32)
    return np.asarray(cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC))


def _surroundings(rng: np.random.Generator) -> Image:
    """Factors about 1, smooth and coarse: buildings, trees and gaps beyond the photo's border."""
    factors = np.ones((64, 64, 3), np.float32)
    for cells, strength in ((4, 0.35), (12, 0.3), (32, 0.25)):
        grey = rng.normal(0, 1, (cells, cells, 1)) + 0.25 * rng.normal(0, 1, (cells, cells, 3))
        interpolation = cv2.INTER_NEAREST if rng.random() < 0.4 else cv2.INTER_CUBIC
        factors += (
            float(rng.uniform(0, strength))
            * cv2.resize(grey.astype(np.float32), (64, 64), interpolation=interpolation)
        ).astype(np.float32)
    return np.clip(factors, 0.15, 2.5)


def through_glass(rng: np.random.Generator, image: Image) -> Image:
    """The photo through a dry pane: sometimes veiled, hazy, or blurred as by condensation."""
    light = srgb_to_linear(image) * np.float32(np.exp(rng.normal(0.0, 0.25)))
    if rng.random() < 0.35:
        light = cv2.GaussianBlur(light, (0, 0), float(rng.uniform(0.3, 1.3)))
    if rng.random() < 0.4:
        coarse = cv2.resize(
            rng.uniform(0.3, 1.0, (3, 3)).astype(np.float32),
            (image.shape[1], image.shape[0]),
            interpolation=cv2.INTER_CUBIC,
        )
        veil = np.float32(rng.uniform(0.0, 0.3)) * coarse[..., None]
        tint = (light.mean(axis=(0, 1)) + rng.uniform(0.2, 0.7)) / 2
        light = light * (1 - veil) + veil * tint.astype(np.float32)
    return linear_to_srgb(light)


def through_camera(rng: np.random.Generator, image: Image) -> Image:
    """Sensor noise, white balance, tone, resampling blur or sharpening, and JPEG, each at times."""
    out = image
    if rng.random() < 0.3:
        out = out * rng.uniform(0.9, 1.1, 3).astype(np.float32)
    if rng.random() < 0.3:
        out = np.clip(out, 0, 1) ** np.float32(np.exp(rng.normal(0, 0.2)))
    if rng.random() < 0.3:
        soft = cv2.GaussianBlur(out, (0, 0), float(rng.uniform(0.4, 1.2)))
        # A negative amount sharpens, as cameras do.
        out = out + np.float32(rng.uniform(-0.8, 1.0)) * (soft - out)
    if rng.random() < 0.7:
        spread = rng.uniform(0.001, 0.025)
        shot = np.sqrt(np.clip(out, 0.02, 1.0))
        noise = rng.standard_normal(out.shape, dtype=np.float32)
        out = out + np.float32(spread) * shot * noise
    out = np.clip(out, 0.0, 1.0)
    if rng.random() < 0.6:
        bytes_ = (out[..., ::-1] * 255 + 0.5).astype(np.uint8)
        quality = int(rng.integers(45, 97))
        coded = cv2.imencode(".jpg", bytes_, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        decoded = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))
        out = decoded[..., ::-1].astype(np.float32) / np.float32(255)
    return np.ascontiguousarray(out, dtype=np.float32)
