"""What else sits on glass: dust, dirt, smears, scratches and snow, as a layer on the pane.

A layer is premultiplied: linear reflectance and opacity (H, W, 4) over the pane, origin at its
centre. Stains do not refract; they hide the light behind them and scatter that of the surroundings.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.drops.optics import Image, defocus
from pipeline.errors import UserError

Rng = np.random.Generator
Draw = Callable[[Rng, Image, float], None]  # one stain onto the opacity; pixels per millimetre
VISIBLE = 0.1  # opacity from which a stain counts as covering
MOST = 200_000  # stains of a kind


def _spot(rng: Rng, canvas: Image) -> tuple[int, int]:
    return int(rng.integers(canvas.shape[1])), int(rng.integers(canvas.shape[0]))


def _dust(rng: Rng, canvas: Image, mm: float) -> None:
    radius = max(float(rng.uniform(0.1, 0.45)) * mm, 0.6)
    cv2.circle(canvas, _spot(rng, canvas), round(radius), float(rng.uniform(0.3, 0.75)), -1)


def _dirt(rng: Rng, canvas: Image, mm: float) -> None:
    x, y = _spot(rng, canvas)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    wave = 1 + sum(
        rng.uniform(0, 0.3) * np.cos(k * angle + rng.uniform(0, 6)) for k in (1, 2, 3, 5)
    )
    reach = float(rng.uniform(0.8, 3.0)) * mm * np.maximum(wave, 0.2)
    edge = np.stack([x + reach * np.cos(angle), y + reach * np.sin(angle)], 1)
    cv2.fillPoly(canvas, [np.rint(edge).astype(np.int32)], float(rng.uniform(0.92, 1.0)))


def _curve(rng: Rng, canvas: Image, length: float, bend: float) -> NDArray[np.int32]:
    turn = rng.uniform(0, 2 * np.pi) + np.cumsum(np.full(16, rng.normal(0, bend) / 16))
    steps = length / 16 * np.stack([np.cos(turn), np.sin(turn)], 1)
    return np.rint(np.asarray(_spot(rng, canvas)) + np.cumsum(steps, 0)).astype(np.int32)


def _smear(rng: Rng, canvas: Image, mm: float) -> None:
    path = _curve(rng, canvas, float(rng.uniform(12, 40)) * mm, 1.2)
    width = float(rng.uniform(3, 8)) * mm
    across = np.diff(path[[0, -1]], axis=0)[0][::-1] * [1, -1]
    across = across / max(float(np.linalg.norm(across)), 1.0)
    for part in np.linspace(-0.5, 0.5, 9):  # the ridges that a finger or a wiper leaves
        ridge = np.rint(path + across * part * width).astype(np.int32)
        strength = float(rng.uniform(0.15, 0.6))
        cv2.polylines(canvas, [ridge], False, strength, max(round(width / 8), 1))


def _scratch(rng: Rng, canvas: Image, mm: float) -> None:
    path = _curve(rng, canvas, float(rng.uniform(8, 40)) * mm, 0.4)
    width = max(round(float(rng.uniform(0.1, 0.35)) * mm), 1)
    cv2.polylines(canvas, [path], False, float(rng.uniform(0.6, 0.9)), width)


def _snow(rng: Rng, canvas: Image, mm: float) -> None:
    x, y = _spot(rng, canvas)
    for _ in range(int(rng.integers(2, 7))):
        dx, dy = rng.normal(0, 1.0, 2) * mm
        radius = max(round(float(rng.uniform(0.4, 1.6)) * mm), 1)
        place = (round(x + dx), round(y + dy))
        cv2.circle(canvas, place, radius, float(rng.uniform(0.93, 1.0)), -1)


# How each kind is drawn, its linear reflectance, and the softness of its rim in millimetres.
_KINDS: dict[str, tuple[Draw, tuple[float, float, float], float]] = {
    "dust": (_dust, (0.50, 0.45, 0.38), 0.1),
    "dirt": (_dirt, (0.10, 0.07, 0.045), 0.15),
    "smears": (_smear, (0.62, 0.62, 0.60), 0.6),
    "scratches": (_scratch, (0.85, 0.87, 0.90), 0.0),
    "snow": (_snow, (0.92, 0.94, 0.97), 0.4),
}
NAMES = tuple(_KINDS)


def _soft(opacity: Image, sigma: float) -> Image:
    return cv2.GaussianBlur(opacity, (0, 0), sigma) if sigma > 0.3 else opacity


def sample_stains(
    rng: Rng, kind: str, shape: tuple[int, int], coverage: float, pixels_per_mm: float
) -> Image:
    """Layer (H, W, 4) of one kind, premultiplied, that visibly covers about `coverage` of it.

    Translucent: dust, smears, scratches; opaque: dirt, snow. Raises UserError for another kind, and
    where MOST of them do not reach the share.
    """
    if kind not in _KINDS:
        raise UserError(f"no stain is called {kind!r}", hint=f"use one of {', '.join(NAMES)}")
    draw, colour, soft = _KINDS[kind]
    sharp = opacity = np.zeros(shape, np.float32)
    for number in range(MOST):
        if number < 64 or number % 8 == 0:  # measured as it will be seen, with soft rims
            opacity = _soft(sharp, soft * pixels_per_mm)
            if (opacity > VISIBLE).mean() >= coverage:
                break
        draw(rng, sharp, pixels_per_mm)
    else:
        reached = (_soft(sharp, soft * pixels_per_mm) > VISIBLE).mean()
        raise UserError(
            f"{MOST} stains of kind {kind} cover only {reached:.2%} of the pane, not {coverage:.2%}",
            hint=f"lower the share of {kind} in synthesize.stains",
        )
    return np.dstack([opacity[..., None] * np.asarray(colour, np.float32), opacity])


def over(top: Image, below: Image) -> Image:
    """One premultiplied layer (H, W, 4) over another."""
    return top + below * (1 - top[..., 3:])


def seen_layer(
    layer: Image,
    metres_per_pixel: float,
    pixel_from_pane: NDArray,
    size: tuple[int, int],
    blur: float,
) -> Image:
    """The pane's layer as a camera of `size` (H, W) sees it, its defocus a disc of `blur` pixels.

    pixel_from_pane (3, 3): homography from pane metres (x, y, 1) to pixels.
    """
    height, width = layer.shape[:2]
    pad = int(np.ceil(blur / 2)) + 1
    p, twice = metres_per_pixel, 2
    pane_from_layer = np.array(
        [[p, 0, p * (1 - width) / 2], [0, p, p * (1 - height) / 2], [0, 0, 1]]
    )
    fine_from_pixel = np.array(
        [[twice, 0, twice * pad - 0.5], [0, twice, twice * pad - 0.5], [0, 0, 1.0]]
    )
    rows, columns = (n + 2 * pad for n in size)
    warp = fine_from_pixel @ pixel_from_pane @ pane_from_layer
    fine = cv2.warpPerspective(layer, warp, (columns * twice, rows * twice))
    seen = defocus(cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA), blur)
    return seen[pad : pad + size[0], pad : pad + size[1]]


def stained(light: Image, layer: Image) -> Image:
    """Linear light (H, W, 3) behind the layer (H, W, 4), lit by the scene.

    Stains scatter light from all sides: they see the scene's mean and its brightest part alike.
    """
    flat = light.reshape(-1, 3)
    ambient = 0.5 * (flat.mean(axis=0) + np.percentile(flat, 95, axis=0))
    return (light * (1 - layer[..., 3:]) + layer[..., :3] * ambient).astype(np.float32)
