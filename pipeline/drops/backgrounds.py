"""Procedural pictures to paint drops onto: varied, and full of things that resemble drops.

Foliage with gaps of sky, railings, lettering, bubbles, pebbles, and lights out of focus are what
a detector takes for drops when it has not seen them dry. Where scikit-image is installed, crops
of four freely licensed colour photographs of its wheel are mixed in (astronaut, rocket: public
domain; coffee, chelsea: CC0).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.drops.optics import Image

Rng = np.random.Generator
Bytes = NDArray[np.uint8]
WORDS = ("EXIT", "Cafe 24", "No Parking", "Hotel", "P 3h", "BOOKS", "open", "Way out", "A1", "1987")


def sample_background(rng: Rng, size: int, *, photo_share: float = 0.2) -> Image:
    """A random (size, size, 3) float32 sRGB picture in [0, 1] without water.

    photo_share: probability of a crop of a photograph, if scikit-image is there. One in four of the
    others is a patchwork of two kinds; all are mirrored, blurred and tinted at random.
    """
    photos = _photos()
    if photos and rng.random() < photo_share:
        picture = _crop(rng, photos[int(rng.integers(len(photos)))], size)
    else:
        picture = _kind(rng)(rng, size)
        if rng.random() < 0.25:
            share = _smooth(rng, size, 3)[..., None] > rng.normal(0, 0.4)
            picture = np.where(share, picture, _kind(rng)(rng, size))
        # Light falls unevenly, and nothing painted is as clean as its paint.
        lit = 0.12 * _smooth(rng, size, 3) + rng.uniform(0, 0.06) * _smooth(rng, size, 16, 4, 0.9)
        picture = picture * np.exp(lit)[..., None]
    picture = picture.astype(np.float32)
    if rng.random() < 0.5:
        picture = picture[:, ::-1]
    if rng.random() < 0.35:
        picture = cv2.GaussianBlur(picture, (0, 0), float(np.exp(rng.uniform(-0.7, 1.4))))
    picture = picture * rng.uniform(0.85, 1.15, 3) * np.exp(rng.normal(0, 0.25))
    return np.clip(np.ascontiguousarray(picture), 0, 1).astype(np.float32)


@lru_cache(maxsize=1)
def _photos() -> tuple[Bytes, ...]:
    try:
        data = importlib.import_module("skimage.data")
    except ImportError:
        return ()
    return tuple(getattr(data, name)() for name in ("astronaut", "rocket", "coffee", "chelsea"))


def _crop(rng: Rng, photo: Bytes, size: int) -> Image:
    longest = min(photo.shape[:2])
    side = int(longest * rng.uniform(0.3, 1.0))
    top = int(rng.integers(photo.shape[0] - side + 1))
    left = int(rng.integers(photo.shape[1] - side + 1))
    crop = photo[top : top + side, left : left + side].astype(np.float32) / 255
    method = cv2.INTER_AREA if side > size else cv2.INTER_CUBIC
    crop = np.clip(cv2.resize(crop, (size, size), interpolation=method), 0, 1)
    return crop[..., rng.permutation(3)] if rng.random() < 0.2 else crop


def _kind(rng: Rng) -> Callable[[Rng, int], Image]:
    return KINDS[int(rng.integers(len(KINDS)))]


def _smooth(rng: Rng, size: int, cells: int, octaves: int = 1, gain: float = 0.6) -> Image:
    """Smooth noise (size, size), zero mean and unit deviation, `cells` bumps across."""
    total = np.zeros((size, size), np.float32)
    for octave in range(octaves):
        n = min(cells * 2**octave, size)
        coarse = rng.standard_normal((n + 3, n + 3), dtype=np.float32)
        fine = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
        total += np.float32(gain**octave) * fine
    return (total - total.mean()) / (total.std() + 1e-6)


def _colour(rng: Rng, low: float = 0.05, high: float = 0.95, chroma: float = 0.13) -> NDArray:
    return np.clip(rng.uniform(low, high) + chroma * rng.normal(0, 0.5, 3), 0.0, 1.0)


def _ramp(rng: Rng, size: int, top: NDArray, bottom: NDArray) -> Image:
    share = np.linspace(0, 1, size, dtype=np.float32)[:, None, None] ** rng.uniform(0.5, 2)
    return np.broadcast_to(top * (1 - share) + bottom * share, (size, size, 3)).astype(np.float32)


def _sky(rng: Rng, size: int) -> Image:
    grey = rng.uniform(0.55, 1.0)
    zenith = grey * np.array([rng.uniform(0.45, 1), rng.uniform(0.65, 1), 1.0])
    sky = _ramp(rng, size, zenith, np.array([1.0, 0.98, 0.95]) * rng.uniform(0.75, 1.0))
    clouds = np.clip(_smooth(rng, size, int(rng.integers(2, 5)), 4), 0, 2)[..., None] / 2
    return (sky + (rng.uniform(0.6, 1.0) - sky) * clouds * rng.uniform(0, 0.9)).astype(np.float32)


def _texture(rng: Rng, size: int) -> Image:
    """Walls, gravel, fabric, bark: noise of several scales, sometimes stretched."""
    noise = _smooth(rng, size, int(rng.integers(2, 40)), int(rng.integers(2, 6)), 0.8)
    if rng.random() < 0.4:
        factor = int(rng.integers(2, 12))
        thin = noise[:, : size // factor]
        noise = cv2.resize(thin, (size, size), interpolation=cv2.INTER_CUBIC)
        noise = noise.T if rng.random() < 0.5 else noise
    share = np.clip(0.5 + rng.uniform(0.1, 0.5) * noise, 0, 1)[..., None]
    return (_colour(rng) * share + _colour(rng) * (1 - share)).astype(np.float32)


def _foliage(rng: Rng, size: int) -> Image:
    """Leaves over the sky, with round gaps of light between them."""
    picture = _sky(rng, size)
    canvas = np.ascontiguousarray(picture)
    count = int(rng.integers(400, 1300))
    big = float(np.exp(rng.uniform(np.log(2.0), np.log(18)))) * size / 256
    dense = _smooth(rng, size, int(rng.integers(2, 6)), 3)
    cut = rng.normal(-0.8, 0.7)
    hue = np.array([rng.uniform(0.1, 0.5), rng.uniform(0.25, 0.6), rng.uniform(0.02, 0.25)])
    for _ in range(count):
        x, y = rng.integers(0, size, 2)
        if dense[y, x] < cut:
            continue
        axes = (max(int(big * rng.uniform(0.5, 1.5)), 1), max(int(big * rng.uniform(0.2, 0.7)), 1))
        shade = hue * rng.uniform(0.15, 1.5)
        turn = float(rng.uniform(0, 180))
        cv2.ellipse(canvas, (int(x), int(y)), axes, turn, 0, 360, shade.tolist(), -1, cv2.LINE_AA)
    for _ in range(int(rng.integers(0, 6))):
        ends = rng.integers(-20, size + 20, 4)
        tint = (hue * rng.uniform(0.1, 0.4) + 0.05).tolist()
        thick = int(rng.integers(1, 9))
        cv2.line(canvas, tuple(ends[:2].tolist()), tuple(ends[2:].tolist()), tint, thick, 16)
    return canvas


def _grass(rng: Rng, size: int) -> Image:
    canvas = np.ascontiguousarray(_texture(rng, size) * 0.5)
    hue = np.array([rng.uniform(0.2, 0.7), rng.uniform(0.35, 0.7), rng.uniform(0.05, 0.3)])
    length = rng.uniform(8, 60) * size / 256
    for _ in range(int(rng.integers(200, 700))):
        x, y = rng.uniform(0, size, 2)
        end = (int(x + rng.normal(0, 0.3) * length), int(y - rng.uniform(0.3, 1) * length))
        tint = (hue * rng.uniform(0.2, 1.5)).tolist()
        cv2.line(canvas, (int(x), int(y)), end, tint, int(rng.integers(1, 3)), cv2.LINE_AA)
    return canvas


def _facade(rng: Rng, size: int) -> Image:
    """Bricks, tiles or windows in rows, each of its own shade."""
    wide = int(rng.integers(8, 70)) * size // 256 + 2
    high = max(int(wide * rng.uniform(0.3, 1.8)), 3)
    canvas = np.empty((size, size, 3), np.float32)
    canvas[:] = _colour(rng)
    base, spread = _colour(rng), rng.uniform(0.02, 0.3)
    gap = int(max(rng.uniform(0.03, 0.35) * min(wide, high), 1))
    shift = wide // 2 if rng.random() < 0.5 else 0
    glossy = rng.random() < 0.3
    for j, top in enumerate(range(-high, size, high)):
        for left in range(-wide - (j % 2) * shift, size, wide):
            tint = np.clip(base * np.exp(rng.normal(0, spread)), 0, 1)
            a = (left + gap, top + gap)
            b = (left + wide - 1, top + high - 1)
            cv2.rectangle(canvas, a, b, tint.tolist(), -1)
            if glossy:
                light = np.clip(tint * 1.6 + 0.1, 0, 1).tolist()
                cv2.line(canvas, a, (b[0], a[1]), light, 1)
    noise = _smooth(rng, size, 20, 4, 0.8)[..., None]
    return _tilt(rng, (canvas * (1 + rng.uniform(0, 0.2) * noise)).astype(np.float32))


def _tilt(rng: Rng, picture: NDArray) -> Image:
    """The picture seen obliquely, or now and then as it is."""
    if rng.random() < 0.3:
        return picture
    size = picture.shape[0]
    corners = np.array([[0, 0], [size, 0], [size, size], [0, size]], np.float32)
    moved = corners + rng.normal(0, 0.15 * size, (4, 2)).astype(np.float32)
    warp = cv2.getPerspectiveTransform(corners, moved)
    return cv2.warpPerspective(
        picture.astype(np.float32), warp, (size, size), borderMode=cv2.BORDER_REFLECT
    )


def _railings(rng: Rng, size: int) -> Image:
    """Bars, fences, wires and nets before another picture."""
    behind = (_texture, _foliage, _facade, _sky)[int(rng.integers(4))]
    canvas = np.ascontiguousarray(behind(rng, size).astype(np.float32))
    pitch = float(rng.uniform(5, 50)) * size / 256
    thick = max(int(pitch * rng.uniform(0.05, 0.4)), 1)
    angles = [rng.uniform(0, np.pi)]
    if rng.random() < 0.6:
        angles.append(angles[0] + rng.uniform(0.6, 1.6))
    tint = _colour(rng)
    for angle in angles:
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        for k in range(int(-size / pitch), int(size / pitch) + 1):
            middle = size / 2 + across * k * pitch
            a, b = (middle - 1.5 * size * along), (middle + 1.5 * size * along)
            ends = [tuple(p.astype(int).tolist()) for p in (a, b)]
            cv2.line(canvas, ends[0], ends[1], tint.tolist(), thick, cv2.LINE_AA)
            if thick > 3:
                gleam = np.clip(tint + 0.3, 0, 1).tolist()
                cv2.line(canvas, ends[0], ends[1], gleam, 1, cv2.LINE_AA)
    return canvas


def _lettering(rng: Rng, size: int) -> Image:
    """Signs, posters and pages of text, of any script size."""
    paper, ink = _colour(rng), _colour(rng)
    canvas = np.empty((size, size, 3), np.uint8)
    canvas[:] = (paper * 255).astype(np.uint8)
    scale = float(np.exp(rng.uniform(np.log(0.3), np.log(4)))) * size / 256
    step = max(int(26 * scale * rng.uniform(0.9, 1.6)), 8)
    faces = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX)
    face = faces[int(rng.integers(3))]
    for y in range(int(rng.integers(0, step)), size + step, step):
        words = [WORDS[int(k)] for k in rng.integers(0, len(WORDS), 8)]
        at = (int(rng.integers(-60, 20)), y)
        thick = max(int(scale * rng.uniform(0.8, 2.5)), 1)
        cv2.putText(
            canvas, " ".join(words), at, face, scale, (ink * 255).tolist(), thick, cv2.LINE_AA
        )
    return _tilt(rng, canvas.astype(np.float32) / 255)


def _boxes(rng: Rng, size: int) -> Image:
    """Furniture, buildings and cars as textured and shaded polygons over a floor."""
    canvas = _ramp(rng, size, _colour(rng, 0.3), _colour(rng)).copy()
    for _ in range(int(rng.integers(8, 45))):
        middle = rng.uniform(0, size, 2)
        extent = np.exp(rng.uniform(np.log(6), np.log(170), 2)) * size / 256
        if rng.random() < 0.7:
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * extent / 2
            corners[:, 0] += corners[:, 1] * rng.normal(0, 0.2)
        else:
            around = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 9))))
            corners = np.stack([np.cos(around), np.sin(around)], 1) * extent / 2
        inside = np.zeros((size, size), np.uint8)
        cv2.fillPoly(inside, [(corners + middle).astype(np.int32)], 255, cv2.LINE_AA)
        share = inside.astype(np.float32)[..., None] / 255
        filled = _colour(rng) * (
            1 + rng.uniform(-0.5, 0.5) * np.linspace(-1, 1, size)[:, None, None]
        )
        if rng.random() < 0.4:
            filled = filled * (
                1 + 0.25 * _smooth(rng, size, int(rng.integers(2, 60)), 2)[..., None]
            )
        canvas = (canvas * (1 - share) + filled * share).astype(np.float32)
    return canvas


def _lights(rng: Rng, size: int) -> Image:
    """Night with lamps, in focus or as discs out of focus: bright, round, and not drops."""
    dark = _boxes(rng, size) if rng.random() < 0.6 else _texture(rng, size)
    canvas = np.ascontiguousarray(dark * rng.uniform(0.05, 0.6)).astype(np.float32)
    radius = float(np.exp(rng.uniform(np.log(1.2), np.log(22)))) * size / 256
    for _ in range(int(rng.integers(5, 70))):
        spot = np.zeros((size, size), np.uint8)
        at = tuple(int(v * 16) for v in rng.uniform(0, size, 2))
        own = radius * rng.uniform(0.8, 1.2)
        cv2.circle(spot, at, int(own * 16), 255, -1, cv2.LINE_AA, 4)
        if rng.random() < 0.4 and own > 3:
            cv2.circle(spot, at, int(own * 16), 150, max(int(own / 6), 1), cv2.LINE_AA, 4)
        tint = np.clip(np.array([1.0, 0.8, 0.5]) + rng.normal(0, 0.35, 3), 0.1, 1)
        strength = rng.uniform(0.15, 1.2)
        canvas += (spot.astype(np.float32)[..., None] / 255) * (tint * strength).astype(np.float32)
    if rng.random() < 0.5:
        canvas += 0.5 * cv2.GaussianBlur(canvas, (0, 0), 8)
    return canvas


def _rounds(rng: Rng, size: int) -> Image:
    """Pebbles, fruit, buttons, wheels, holes and rings: outlines of drops without the optics."""
    behind = (_texture, _boxes, _sky, _facade)[int(rng.integers(4))]
    canvas = behind(rng, size).astype(np.float32)
    largest = float(np.exp(rng.uniform(np.log(3), np.log(50)))) * size / 256
    kind = int(rng.integers(4))
    axis = np.arange(size)
    base = _colour(rng)
    for _ in range(int(rng.integers(8, 90))):
        r = largest * rng.uniform(0.3, 1.0)
        cx, cy = rng.uniform(0, size, 2)
        rows = slice(max(int(cy - 1.5 * r), 0), int(cy + 1.5 * r) + 2)
        columns = slice(max(int(cx - 1.5 * r), 0), int(cx + 1.5 * r) + 2)
        dy = (axis[rows, None] - cy) / (r * rng.uniform(0.7, 1.2))
        dx = (axis[None, columns] - cx) / r
        level = np.sqrt(dx**2 + dy**2)
        share = np.clip((1 - level) * r + 0.5, 0, 1)[..., None]
        tint = np.clip(base * np.exp(rng.normal(0, 0.35)), 0, 1)
        shade = np.ones_like(level)
        if kind == 0:  # shaded balls lit from above
            shade = 0.35 + 0.9 * np.clip(np.sqrt(np.clip(1 - level**2, 0, 1)) - 0.6 * dy, 0, 1.2)
        elif kind == 1:  # rings and wheels
            share = share * (level > rng.uniform(0.5, 0.9))[..., None]
        elif kind == 2:  # dents and holes
            shade = 0.4 + 0.6 * np.clip(0.5 + 0.6 * dy, 0, 1)
        canvas[rows, columns] += (tint * shade[..., None] - canvas[rows, columns]) * share
    return canvas


def _street(rng: Rng, size: int) -> Image:
    """Sky, a line of trees or houses, and the ground: the usual layout of an outdoor photo."""
    canvas = _sky(rng, size)
    far = _foliage(rng, size) if rng.random() < 0.5 else _boxes(rng, size)
    skyline = size * (rng.uniform(0.15, 0.5) + 0.06 * _smooth(rng, size, 5, 4)[0])
    horizon = size * rng.uniform(0.5, 0.85)
    rows = np.arange(size)[:, None]
    canvas = np.where((rows > skyline[None, :])[..., None], far, canvas)
    ground = _texture(rng, size) if rng.random() < 0.6 else _grass(rng, size)
    return np.where((rows > horizon)[..., None], ground, canvas)


KINDS: tuple[Callable[[Rng, int], Image], ...] = (
    _street,
    _street,
    _foliage,
    _foliage,
    _grass,
    _facade,
    _facade,
    _railings,
    _railings,
    _lettering,
    _boxes,
    _boxes,
    _lights,
    _rounds,
    _rounds,
    _texture,
    _sky,
)
