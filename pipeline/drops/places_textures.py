"""Procedural albedo textures, tileable unless said otherwise: float32 (H, W, 3), linear, [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]  # float32 where it is stored
Rng = np.random.Generator

WORDS = ("BAKERY", "BOOKS", "CAFE LUNA", "FLORIST", "TEA ROOM", "No 27", "MARKET", "TO LET")


def linear(rgb: Sequence[float] | npt.NDArray[np.floating]) -> Array:
    """Linear light of an sRGB colour or image in [0, 1] (IEC 61966-2-1)."""
    value = np.asarray(rgb, np.float32)
    out = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return out.astype(np.float32)


def noise(rng: Rng, size: int, cells: int, octaves: int = 5, fall: float = 0.6) -> Array:
    """Tileable fractal noise (size, size), zero mean, about unit deviation."""
    out = np.zeros((size, size), np.float32)
    weight = 1.0
    for octave in range(octaves):
        n = min(cells * 2**octave, size)
        grid = rng.standard_normal((n, n)).astype(np.float32)
        pad = np.pad(grid, 2, mode="wrap")
        scale = size / n
        big = cv2.resize(pad, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        cut = round(2 * scale)
        out += weight * big[cut : cut + size, cut : cut + size]
        weight *= fall
    return ((out - out.mean()) / (out.std() + 1e-6)).astype(np.float32)


def _shade(base: npt.NDArray[np.floating], amount: npt.NDArray[np.floating]) -> Array:
    return np.clip(base * np.exp(amount)[..., None], 0.01, 0.95).astype(np.float32)


def courses(
    rng: Rng,
    colours: Sequence[Sequence[float]],
    joint: Sequence[float],
    rows: int,
    columns: int,
    *,
    size: int = 512,
    gap: float = 0.06,
    shift: float = 0.5,
    spread: float = 0.22,
) -> Array:
    """Bricks, setts, tiles or planks in courses, alternate rows shifted by `shift` of one."""
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size
    row = np.floor(v * rows).astype(int)
    x = u * columns + shift * (row % 2) + 0.03 * noise(rng, size, 8)
    column = np.floor(x).astype(int) % columns
    fx, fy = x - np.floor(x), v * rows - row
    pick = rng.integers(0, len(colours), (rows, columns))
    base = linear(np.asarray(colours))[pick[row, column]]
    lift = spread * rng.standard_normal((rows, columns))[row, column]
    edge = np.minimum(np.minimum(fx, 1 - fx) * rows / columns, np.minimum(fy, 1 - fy))
    edge = edge + 0.02 * noise(rng, size, 32, 3)
    body = np.clip((edge - gap) / 0.05, 0, 1)
    stone = _shade(base, lift + 0.16 * noise(rng, size, 16) + 0.12 * (body - 1))
    mortar = _shade(np.broadcast_to(linear(joint), stone.shape), 0.15 * noise(rng, size, 32, 4))
    return (stone * body[..., None] + mortar * (1 - body[..., None])).astype(np.float32)


def plaster(
    rng: Rng, colour: Sequence[float] | Array, *, size: int = 512, rough: float = 0.12
) -> Array:
    """Rough render or concrete: two scales of noise, cracks and stains."""
    stains = np.minimum(noise(rng, size, 4, 3), 0.3) * 0.14
    cracks = (
        -0.7 * np.exp(-((noise(rng, size, 5, 6) / 0.035) ** 2)) * (noise(rng, size, 3, 2) > 0.4)
    )
    speckle = rough * noise(rng, size, 40, 4, 0.8)
    blotch = np.where(noise(rng, size, 8, 5) > 1.9, -0.45, 0.0)
    return _shade(
        np.broadcast_to(linear(colour), (size, size, 3)), stains + cracks + speckle + blotch
    )


def wood(rng: Rng, colour: Sequence[float], *, size: int = 512, planks: int = 6) -> Array:
    """Planks along the second axis, with grain and knots."""
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size
    row = np.floor(v * planks).astype(int)
    wave = 0.12 * noise(rng, size, 3, 2) + 3.0 * rng.random(planks)[row]
    grain = np.sin(2 * np.pi * (v * planks * 3 + wave) * 2)
    streak = cv2.resize(
        noise(rng, size, 64, 3)[:, ::16], (size, size), interpolation=cv2.INTER_LINEAR
    )
    joint = np.exp(-(((v * planks) % 1 - 0.5) ** 2 - 0.25) / -0.006) * 1.1
    amount = 0.14 * grain + 0.16 * streak + 0.25 * rng.standard_normal(planks)[row] - joint
    knots = -0.8 * (noise(rng, size, 6, 3) > 2.3)
    del u
    return _shade(np.broadcast_to(linear(colour), (size, size, 3)), amount + knots)


def foliage(rng: Rng, *, size: int = 256) -> Array:
    """One leaf's surface: veins over mottled green (not tileable)."""
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size
    vein = np.exp(-((u - 0.5) ** 2) / 0.002) + 0.6 * (np.sin((v + np.abs(u - 0.5)) * 44) > 0.93)
    colour = linear((0.36, 0.52, 0.17))
    return _shade(
        np.broadcast_to(colour, (size, size, 3)), 0.3 * noise(rng, size, 4) + 0.45 * vein - 0.1
    )


def stripes(rng: Rng, *, size: int = 256, bands: int = 8) -> Array:
    """Awning cloth: light and dark bands across the first texture axis."""
    u = np.mgrid[0:size, 0:size][1] / size
    on = (np.floor(u * bands * 2) % 2)[..., None]
    colour = linear((0.93, 0.91, 0.86)) * on + linear((0.75, 0.75, 0.75)) * 0.35 * (1 - on)
    return _shade(colour, 0.06 * noise(rng, size, 8) + 0.06 * noise(rng, size, 64, 2))


def ground(rng: Rng, colour: Sequence[float], *, size: int = 512) -> Array:
    """Asphalt or soil: grains, patches and a few light stones."""
    grains = 0.25 * noise(rng, size, 128, 2, 0.9) + 0.14 * noise(rng, size, 6, 4)
    stones = 1.0 * (noise(rng, size, 100, 1) > 2.6) - 0.5 * (noise(rng, size, 7, 5) > 1.8)
    return _shade(np.broadcast_to(linear(colour), (size, size, 3)), grains + stones)


def ripples(rng: Rng, *, size: int = 512) -> Array:
    """Still water with small waves: blue-grey troughs, crests that catch the sky."""
    thin = noise(rng, size, 24, 4)[::4]
    waves = cv2.resize(np.tile(thin, (4, 1))[:size], (size, size))
    flat = cv2.resize(noise(rng, size, 10, 4)[:, ::4], (size, size), interpolation=cv2.INTER_LINEAR)
    crest = np.clip(0.5 + 0.3 * flat + 0.12 * waves, 0, 1)[..., None]
    colour = linear((0.20, 0.27, 0.33)) * (1 - crest) + linear((0.62, 0.62, 0.66)) * crest
    return np.clip(colour, 0.01, 0.95).astype(np.float32)


def _pane(rng: Rng, h: int, w: int) -> Array:
    """A window seen from the street: dark room, curtains, the sky and roofs reflected."""
    v, u = np.mgrid[0:h, 0:w].astype(np.float32)
    v, u = v / h, u / w
    dark = linear((0.16, 0.19, 0.23)) * (1.2 - 0.6 * v[..., None])
    skyline = 0.35 + 0.2 * np.interp(u, np.linspace(0, 1, 7), rng.random(7))
    sky = np.clip((skyline - v) * 9, 0, 1)[..., None] * linear((0.62, 0.70, 0.78)) * 0.5
    out = dark + sky
    if rng.random() < 0.6:
        edge = rng.uniform(0.18, 0.38)
        folds = 0.75 + 0.25 * np.sin(u * rng.uniform(50, 80))
        curtain = ((u < edge) | (u > 1 - edge)) & (v > 0.04)
        cloth = linear(rng.uniform(0.55, 0.9, 3))
        out = np.where(curtain[..., None], cloth * folds[..., None] * 0.8, out)
    if rng.random() < 0.5:
        pot = (np.abs(u - rng.uniform(0.35, 0.65)) < 0.1) & (v > 0.8)
        out = np.where(pot[..., None], linear((0.6, 0.3, 0.2)), out)
    return np.clip(out, 0.01, 0.9).astype(np.float32)


def windows(rng: Rng, *, cell: int = 128, cells: int = 4) -> Array:
    """Atlas of `cells` x `cells` window panes."""
    rows = [np.hstack([_pane(rng, cell, cell) for _ in range(cells)]) for _ in range(cells)]
    return np.vstack(rows).astype(np.float32)


def signs(rng: Rng, *, width: int = 512, height: int = 96) -> Array:
    """Atlas of lettered boards, one word of WORDS per row."""
    boards = []
    palette = [
        ((0.10, 0.22, 0.18), (0.92, 0.86, 0.65)),
        ((0.86, 0.82, 0.72), (0.35, 0.10, 0.10)),
        ((0.15, 0.18, 0.32), (0.95, 0.93, 0.88)),
        ((0.62, 0.16, 0.13), (0.97, 0.92, 0.80)),
    ]
    for i, word in enumerate(WORDS):
        back, ink = palette[(i + int(rng.integers(0, 4))) % 4]
        board = np.full((height, width, 3), np.multiply(back, 255), np.uint8)
        cv2.rectangle(board, (5, 5), (width - 6, height - 6), tuple(int(255 * c) for c in ink), 3)
        font = cv2.FONT_HERSHEY_TRIPLEX
        (w, h), _ = cv2.getTextSize(word, font, 2.2, 5)
        scale = 2.2 * min((width - 40) / w, (height - 40) / h)
        (w, h), _ = cv2.getTextSize(word, font, scale, 5)
        at = ((width - w) // 2, (height + h) // 2)
        cv2.putText(board, word, at, font, scale, tuple(int(255 * c) for c in ink), 5, cv2.LINE_AA)
        boards.append(board)
    image = linear(np.vstack(boards).astype(np.float32) / 255)
    wear = cv2.resize(noise(rng, 512, 16), (image.shape[1], image.shape[0]))
    return _shade(image, 0.10 * wear)


def posters(rng: Rng, *, cell: int = 128, cells: int = 4) -> Array:
    """Atlas of `cells` x `cells` prints: shapes, stripes and letters in bright colours."""
    rows = []
    for _ in range(cells):
        row = []
        for _ in range(cells):
            tile = np.full((cell, cell, 3), rng.uniform(90, 240, 3), np.uint8)
            for _ in range(int(rng.integers(4, 10))):
                ink = tuple(int(c) for c in rng.uniform(20, 240, 3))
                p, q = (tuple(int(c) for c in rng.integers(0, cell, 2)) for _ in range(2))
                kind = rng.integers(0, 4)
                if kind == 0:
                    cv2.circle(tile, p, int(rng.integers(6, cell // 3)), ink, -1, cv2.LINE_AA)
                elif kind == 1:
                    cv2.rectangle(tile, p, q, ink, -1)
                elif kind == 2:
                    cv2.line(tile, p, q, ink, int(rng.integers(2, 12)), cv2.LINE_AA)
                else:
                    word = WORDS[int(rng.integers(0, len(WORDS)))]
                    cv2.putText(
                        tile, word, (6, p[1]), cv2.FONT_HERSHEY_DUPLEX, 0.8, ink, 2, cv2.LINE_AA
                    )
            cv2.rectangle(tile, (0, 0), (cell - 1, cell - 1), (235, 232, 224), 6)
            row.append(tile)
        rows.append(np.hstack(row))
    return linear(np.vstack(rows).astype(np.float32) / 255)


def spines(rng: Rng, *, cell: int = 64, cells: int = 8) -> Array:
    """Atlas of book spines: light cloth (tinted per book) with bands and a title."""
    tiles = []
    for _ in range(cells):
        tile = np.full((256, cell, 3), 205, np.uint8)
        for _ in range(int(rng.integers(2, 5))):
            y = int(rng.integers(6, 250))
            cv2.rectangle(tile, (0, y), (cell, y + int(rng.integers(3, 16))), (80, 76, 70), -1)
        label = np.full((cell, 256, 3), 0, np.uint8)
        word = WORDS[int(rng.integers(0, len(WORDS)))]
        cv2.putText(
            label, word, (30, 44), cv2.FONT_HERSHEY_TRIPLEX, 1.2, (150, 150, 140), 3, cv2.LINE_AA
        )
        tile = np.maximum(tile - np.rot90(label, 3), 10)
        tiles.append(tile)
    image = linear(np.hstack(tiles).astype(np.float32) / 255)
    return _shade(image, 0.08 * cv2.resize(noise(rng, 256, 16), (image.shape[1], image.shape[0])))
