"""A small harbour at dusk: boats with rigging, nets, lamps on the quay, lit houses on the far shore."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.drops import places_textures as tx
from pipeline.drops.places_parts import UP, Array, Builder, Lamp, lamp, offset, turn
from pipeline.drops.places_things import at, bench, bin_, cell, notice, planter, railing

Rng = np.random.Generator
RIGHT = np.array([1, 0, 0], np.float32)
WATER = -1.1  # height of the water below the quay's ground, metres
SHORE = 34.0  # distance of the far shore
HULLS = ((0.75, 0.12, 0.10), (0.10, 0.24, 0.50), (0.85, 0.84, 0.78), (0.10, 0.40, 0.32),
         (0.80, 0.50, 0.10), (0.16, 0.17, 0.20))  # fmt: skip


def textures(rng: Rng) -> dict[str, Array]:
    """The harbour's materials."""
    sett = ((0.50, 0.48, 0.46), (0.42, 0.41, 0.41), (0.56, 0.52, 0.47), (0.38, 0.37, 0.37))
    block = ((0.58, 0.54, 0.48), (0.50, 0.47, 0.42), (0.62, 0.58, 0.52))
    brick = ((0.58, 0.32, 0.26), (0.50, 0.27, 0.22), (0.62, 0.40, 0.31))
    tiles = ((0.42, 0.24, 0.20), (0.36, 0.22, 0.19), (0.46, 0.30, 0.25))
    return {
        "setts": tx.courses(rng, sett, (0.26, 0.25, 0.24), 10, 10, gap=0.08),
        "stone": tx.courses(rng, block, (0.34, 0.32, 0.30), 5, 4, gap=0.04, spread=0.2),
        "brick": tx.courses(rng, brick, (0.55, 0.52, 0.48), 16, 8),
        "plaster": tx.plaster(rng, (0.84, 0.82, 0.78)),
        "tiles": tx.courses(rng, tiles, (0.18, 0.12, 0.10), 10, 8, gap=0.05, spread=0.3),
        "wood": tx.wood(rng, (0.56, 0.46, 0.36)),
        "paint": tx.plaster(rng, (0.9, 0.9, 0.9), rough=0.10, size=256),
        "metal": tx.plaster(rng, (0.34, 0.36, 0.37), rough=0.12, size=256),
        "rope": tx.courses(rng, ((0.62, 0.54, 0.38), (0.5, 0.43, 0.3)), (0.3, 0.25, 0.2), 4, 4),
        "leaf": tx.foliage(rng),
        "cloth": tx.stripes(rng),
        "window": tx.windows(rng),
        "sign": tx.signs(rng),
        "poster": tx.posters(rng),
        "hill": tx.ground(rng, (0.26, 0.30, 0.24)),
        "water": tx.ripples(rng),
    }


@dataclass(frozen=True)
class _Afloat:
    """A boat's frame: x along it and z across it in half lengths and widths, h metres up."""

    middle: Array
    turned: Array
    long: float
    wide: float

    def at(self, x: float, h: float, z: float) -> Array:
        """The point in the frame of the place."""
        step = self.turned @ np.array([x * self.long / 2, -h, z * self.wide / 2])
        return (self.middle + step).astype(np.float32)


STATIONS = np.linspace(-1, 1, 21)  # along a hull, from stern to bow


def hull(b: Builder, boat: _Afloat, free: float, colour: Array) -> Array:
    """Heights of the rail along a hull, which gets wales, a deck and fenders, at STATIONS."""
    s = STATIONS
    bow = np.sqrt(np.maximum(1 - ((s + 0.2) / 1.2) ** 2, 1e-3))  # a stem, not a point
    beam = np.where(s > -0.2, bow, 1 - 0.2 * (s + 0.2) ** 2)
    rail = free * (1 + 0.45 * s**2 + 0.3 * np.maximum(s, 0) ** 3)
    bands = np.array([[1.2] * 3, colour, colour, colour, colour * 0.3, [0.25, 0.1, 0.08]])
    for side in (-1, 1):
        around = list(zip(s, beam, rail, strict=True))[::-side]
        rows = [
            [boat.at(x, t * h, side * w * (0.55 + 0.45 * max(t, 0) ** 0.6)) for x, w, h in around]
            for t in (1.0, 0.85, 0.6, 0.3, 0.0, -0.25)
        ]
        b.sheet("paint", rows, tile=0.8, tint=np.repeat(bands, len(s), 0))
        b.tube("wood", [boat.at(x, h, side * w) for x, w, h in around], 0.035)
    stern = [
        [boat.at(-1, t * rail[0], z * beam[0] * (0.55 + 0.45 * t**0.6)) for z in (1, 0, -1)]
        for t in (1.0, 0.5, 0.0)
    ]
    b.sheet("paint", stern, tile=0.8, tint=colour)
    deck = [
        [boat.at(x, 0.8 * free, z * w) for x, w in zip(s, beam, strict=True)]
        for z in (1, 0.5, 0, -0.5, -1)
    ]
    b.sheet("wood", deck, tile=0.7)
    for x in (-0.6, -0.1, 0.4):  # fenders
        w = float(np.interp(x, s, beam))
        b.ball("paint", boat.at(x, 0.4 * free, -w * 1.06), (0.10, 0.16, 0.10), sides=8,
               tint=(0.9, 0.35, 0.1))  # fmt: skip
    return rail


def wheelhouse(
    b: Builder, rng: Rng, boat: _Afloat, foot: Array, yaw: float, colour: Array, lit: bool
) -> None:
    """Cabin with a roof and three windows towards the quay."""
    size = np.array([0.26 * boat.long, 0.24 * boat.long, 0.5 * boat.wide])
    middle = foot + UP * size[1] / 2
    b.box("paint", middle, size, yaw=yaw, tint=(1.0, 0.96, 0.88), tile=0.8)
    roof = middle + UP * size[1] / 2
    b.box("wood", roof, size * [1.15, 0.08, 1.15], yaw=yaw, tint=colour * 1.4)
    for k in (-1, 0, 1):
        side = [(k * 0.3 - 0.11) * size[0], -0.34 * size[1], -0.51 * size[2]]
        b.panel(
            "window", middle + boat.turned @ np.array(side),
            boat.turned @ np.array([0.22 * size[0], 0, 0]), [0, 0.34 * size[1], 0],
            cell=cell(rng), tint=(2.2, 1.5, 0.8) if lit else (1, 1, 1), glow=0.7 if lit else 0.0,
        )  # fmt: skip


def boat(b: Builder, rng: Rng, middle: Array, yaw: float, long: float, lamps: list[Lamp]) -> None:
    """Fishing boat afloat: hull, wheelhouse, mast, rigging, pennants; a lantern that is lit joins `lamps`."""
    me = _Afloat(middle, turn(yaw), long, long * float(rng.uniform(0.26, 0.32)))
    free = long * float(rng.uniform(0.13, 0.17))
    colour = np.asarray(HULLS[int(rng.integers(len(HULLS)))])
    rail = hull(b, me, free, colour)
    cabin, lit = float(rng.uniform(-0.45, -0.15)), bool(rng.random() < 0.7)
    wheelhouse(b, rng, me, me.at(cabin, 0.8 * free, 0), yaw, colour, lit)
    foot, tall = me.at(cabin + 0.42, 0.8 * free, 0), long * float(rng.uniform(0.75, 1.0))
    top, bow = foot + UP * tall, me.at(0.98, rail[-1], 0)
    b.tube("wood", [foot, top], [0.06, 0.035], tint=(1.2, 1.0, 0.8))
    boom = foot + UP * tall * 0.3
    tip = boom + me.turned @ (np.array([-0.35, -0.12, 0.05]) * long)
    b.tube("wood", [boom, tip], 0.03)
    stays = [(-0.98, rail[0], 0.6), (-0.98, rail[0], -0.6), (0.25, free, 0.95), (0.25, free, -0.95)]
    for end in (bow, *(me.at(*stay) for stay in stays)):
        b.tube("metal", [top, end], 0.011, sides=4, tint=(0.8, 0.8, 0.8))
    for k in range(7):
        corner = top + (bow - top) * (k + 0.5) / 7.5
        flag = corner + np.array([[-0.10, 0, 0], [0.10, 0, 0], [0, 0.24, 0]])
        uv = np.array([[0, 0], [0.05, 0], [0.02, 0.2]])
        b.add("cloth", flag, np.tile([0, -0.2, -1.0], (3, 1)), uv, [[0, 1, 2]],
              rng.uniform(0.2, 1.2, 3))  # fmt: skip
    if lit:
        lantern = top - UP * 0.25 * tall - offset(0, 0, 0.1)
        b.ball("paint", lantern, np.full(3, 0.07), glow=2.0, tint=(1, 0.85, 0.6), sides=8)
        lamps.append(lamp(lantern - offset(0, 0, 0.2), (1.4, 1.1, 0.7)))


def quay_lamp(b: Builder, rng: Rng, foot: Array, lamps: list[Lamp]) -> Array:
    """Where the lantern of a lamp on a curved iron post hangs; its light joins `lamps`."""
    h = float(rng.uniform(2.5, 3.0))
    way = float(rng.choice([-1.0, 1.0]))
    b.lathe("metal", foot, [(0.06, 0.7), (0.09, 0.5), (0.13, 0.2), (0.16, 0.0)], sides=10)
    s = np.linspace(0, np.pi * 0.9, 9)[:, None]
    bow = foot + UP * h + np.hstack([way * 0.28 * (1 - np.cos(s)), -0.28 * np.sin(s), 0 * s])
    b.tube("metal", np.vstack([[foot + UP * 0.4], bow]), 0.032, sides=7)
    head = bow[-1].astype(np.float32)
    b.lathe("metal", head - UP * 0.12, [(0.02, 0.16), (0.10, 0.10), (0.20, 0.0)], sides=12)
    b.ball("paint", head - UP * 0.16, np.full(3, 0.10), glow=2.5, tint=(1.0, 0.80, 0.50), sides=12)
    lamps.append(lamp(head - UP * 0.32, (5.2, 3.7, 2.0)))
    return head


def bulbs(b: Builder, rng: Rng, start: Array, end: Array, count: int = 13) -> None:
    """A sagging string of coloured bulbs."""
    s = np.linspace(0, 1, 2 * count + 1)[:, None]
    line = start + (end - start) * s - UP * 4 * 0.35 * s * (1 - s)
    b.tube("metal", line, 0.008, sides=4, tint=(0.4, 0.4, 0.4))
    palette = np.array([[1, 0.75, 0.4], [1, 0.35, 0.2], [0.4, 0.8, 0.5], [0.4, 0.6, 1.0]])
    for q in line[1::2]:
        b.ball(
            "paint",
            q - UP * 0.07,
            (0.045, 0.06, 0.045),
            sides=8,
            glow=0.6,
            tint=palette[int(rng.integers(4))],
        )


def net(b: Builder, rng: Rng, foot: Array, yaw: float) -> None:
    """Fishing net hung to dry between two posts, with floats along its upper rope."""
    r, w, h = turn(yaw), float(rng.uniform(1.5, 2.1)), 1.7
    ends = [foot + r @ np.array([x * w / 2, 0, 0]) for x in (-1, 1)]
    for end in ends:
        b.tube("wood", [end, end + UP * h], [0.05, 0.04])

    def p(u: float, v: float) -> Array:
        sag = 0.35 * 4 * u * (1 - u) * (0.35 + 0.65 * v)
        return (
            ends[0]
            + (ends[1] - ends[0]) * u
            + UP * (h * (1 - 0.62 * v) - sag * 0.6)
            + r @ np.array([0, 0, 0.12 * np.sin(5 * u + 3 * v)])
        )

    tint = rng.uniform(0.5, 1.3, 3)
    for k in range(13):
        b.tube("rope", [p(k / 12, v) for v in np.linspace(0, 1, 9)], 0.007, sides=4, tint=tint)
    for k in range(8):
        b.tube(
            "rope",
            [p(u, k / 7) for u in np.linspace(0, 1, 13)],
            0.014 if k == 0 else 0.007,
            sides=4,
            tint=tint,
        )
    for u in np.linspace(0.08, 0.92, 8):
        b.ball("paint", p(float(u), 0.0), np.full(3, 0.05), sides=8, tint=(1.0, 0.45, 0.12))


def clutter(b: Builder, rng: Rng, foot: Array) -> None:
    """A heap of crates, a barrel, a coil of rope or a bollard."""
    kind = rng.integers(4)
    if kind == 0:
        for k in range(int(rng.integers(2, 4))):
            size = np.array([0.6, 0.3, 0.42])
            spot = foot + UP * (0.15 + 0.31 * k) + rng.normal(0, 0.03, 3) * [1, 0, 1]
            b.box(
                "wood",
                spot,
                size,
                yaw=float(rng.normal(0, 0.2)),
                tile=0.4,
                tint=rng.uniform(0.6, 1.5, 3),
            )
    elif kind == 1:
        shape = [(0.24, 0.8), (0.29, 0.6), (0.31, 0.4), (0.29, 0.2), (0.24, 0.0)]
        b.lathe("wood", foot, shape, sides=16, tile=(3, 1), tint=rng.uniform(0.6, 1.3, 3))
        b.lathe("metal", foot, [(0.305, 0.58), (0.31, 0.54)], sides=16)
        b.panel(
            "poster",
            foot + offset(-0.13, -0.62, -0.315),
            [0.26, 0, 0],
            [0, 0.3, 0],
            cell=cell(rng),
            step=0.15,
        )
    elif kind == 2:
        turns = np.linspace(0, 10 * np.pi, 90)[:, None]
        radius = 0.18 + 0.10 * np.cos(turns / 4)
        coil = foot + np.hstack(
            [radius * np.cos(turns), -0.03 - 0.009 * turns, radius * np.sin(turns)]
        )
        b.tube("rope", coil, 0.03, sides=6, tile=0.15)
    else:
        shape = [(0.05, 0.52), (0.17, 0.50), (0.18, 0.44), (0.11, 0.38), (0.13, 0.05), (0.18, 0.0)]
        b.lathe("metal", foot, shape, sides=14, tint=rng.uniform(0.5, 1.6) * np.ones(3))


def far_house(b: Builder, rng: Rng, left: Array, width: float) -> None:
    """Front of a house across the water, some of its windows lit."""
    height = float(rng.uniform(5.0, 9.0))
    kind = ("plaster", "brick", "plaster")[int(rng.integers(3))]
    tint = rng.uniform(0.6, 1.1, 3) if kind == "plaster" else rng.uniform(0.8, 1.2) * np.ones(3)
    b.panel(kind, left + UP * height, RIGHT * width, -UP * height, tile=2.2, tint=tint, step=0.8)
    ridge = UP * rng.uniform(1.6, 2.8) + offset(0, 0, 2.5)
    b.panel(
        "tiles",
        left + UP * height + ridge - RIGHT * 0.2,
        RIGHT * (width + 0.4),
        -ridge,
        tile=1.8,
        step=0.8,
    )
    b.box(
        "brick",
        left + UP * (height + 1.6) + RIGHT * rng.uniform(0.3, width - 0.3) + offset(0, 0, 1.6),
        (0.7, 2.2, 0.6),
        tile=1.6,
    )
    columns = max(2, round(width / 1.5))
    for level in np.arange(1.3, height - 0.8, 2.3):
        for k in range(columns):
            corner = (
                left
                + RIGHT * (width * (k + 0.5) / columns - 0.4)
                + UP * (level + 0.75)
                - offset(0, 0, 0.06)
            )
            glow = float(rng.uniform(0.25, 0.7)) if rng.random() < 0.38 else 0.0
            warm = np.array([2.4, 1.6, 0.8]) * rng.uniform(0.7, 1.1, 3) if glow else np.ones(3)
            b.panel("paint", corner - offset(0.1, 0.1, -0.02), RIGHT * 1.0, -UP * 1.55, step=1.0)
            b.panel(
                "window",
                corner,
                RIGHT * 0.8,
                -UP * 1.35,
                cell=cell(rng),
                tint=warm,
                glow=glow,
                step=0.7,
            )
            if glow and level < 2:  # its light on the water
                start = [corner[0], at(0, WATER + 0.02, 0)[1], SHORE - 1.0]
                b.panel("water", start, RIGHT * 0.8, [0, 0, -rng.uniform(5, 11)], tile=0.9,
                        tint=warm, glow=0.7 * glow, step=0.8)  # fmt: skip


def surroundings(b: Builder, rng: Rng) -> None:
    """Quay, water, the far shore with its houses, and hills behind."""
    b.panel("setts", at(-9, 0, 6.6), [18, 0, 0], [0, 0, -9], tile=1.5, step=0.3)
    b.box("stone", at(0, -0.02, 6.7), (18, 0.24, 0.45), tile=1.0, step=0.3)
    b.panel("water", at(-45, WATER, SHORE), [90, 0, 0], [0, 0, -SHORE + 6.7], tile=5.0, step=1.0)
    b.panel("stone", at(-45, 0.3, SHORE - 1), [90, 0, 0], [0, 0.3 - WATER, 0], tile=2.0, step=1.0)
    b.panel("setts", at(-45, 0.3, SHORE + 3), [90, 0, 0], [0, 0, -4], tile=2.0, step=1.0)
    x = -34.0
    while x < 34:
        width = float(rng.uniform(3.4, 6.0))
        if rng.random() < 0.9:
            far_house(b, rng, at(x, 0.3, SHORE + rng.uniform(0, 2.5)), width)
        x += width
    for depth, low, high in ((55.0, 7, 13), (85.0, 14, 22)):
        s = np.linspace(-1.1 * depth, 1.1 * depth, 70)
        bumps = np.interp(
            s, np.linspace(s[0], s[-1], 9), rng.uniform(low, high, 9)
        ) + 0.5 * rng.normal(0, 1, 70)
        rows = [
            [at(x, h * t, depth - 8 * (1 - t)) for x, h in zip(s, bumps, strict=True)]
            for t in (1.0, 0.66, 0.33, -0.1)
        ]
        b.sheet("hill", rows, tile=9.0, tint=(1.0, 1.05, 1.25) if depth > 60 else (1, 1, 1))


def build(rng: Rng) -> tuple[Builder, list[Lamp]]:
    """A quay, laid out at random, and its lamps."""
    b = Builder(textures(rng), step=0.2)
    lamps: list[Lamp] = []
    surroundings(b, rng)
    places = rng.permutation(np.linspace(-5.2, 5.2, 4))
    for k in range(3):
        middle = at(
            places[k] + rng.normal(0, 0.4), WATER + 0.1, 9.3 + 2.6 * k + rng.uniform(0, 1.2)
        )
        boat(
            b,
            rng,
            middle,
            float(rng.normal(0, 0.35) + rng.choice([0, np.pi])),
            float(rng.uniform(3.8, 5.4)),
            lamps,
        )
    for k in range(3):
        middle = at(rng.uniform(-14, 14), WATER + 0.1, 18 + 4 * k)
        boat(b, rng, middle, float(rng.uniform(0, 6)), float(rng.uniform(4.5, 6.5)), lamps)
    slots = rng.permutation(np.linspace(-3.4, 3.4, 8))
    heads = [
        quay_lamp(b, rng, at(slots[k] * 0.9, 0, rng.uniform(4.3, 6.0)), lamps) for k in range(3)
    ]
    heads.sort(key=lambda head: float(head[0]))
    for one, other in pairwise(heads):
        bulbs(b, rng, one, other)
    net(b, rng, at(slots[3], 0, rng.uniform(5.0, 6.0)), float(rng.normal(0, 0.25)))
    notice(b, rng, at(slots[4], 0, rng.uniform(4.6, 5.8)))
    bench(b, rng, at(slots[5], 0, rng.uniform(4.4, 5.4)), float(rng.normal(0, 0.4) + np.pi))
    first = rng.uniform(-3.6, 0.8)
    railing(b, rng, at(first, 0, 6.35), at(first + rng.uniform(2.0, 3.4), 0, 6.35))
    for x in np.linspace(-4.0, 4.0, 9):
        clutter(b, rng, at(x + rng.normal(0, 0.25), 0, rng.uniform(3.9, 6.2)))
    bin_(b, rng, at(slots[6], 0, rng.uniform(4.8, 6.0)))
    planter(b, rng, at(slots[7], 0, rng.uniform(4.0, 5.0)), 0.45)
    return b, lamps
