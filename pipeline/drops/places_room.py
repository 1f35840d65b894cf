"""A study: shelves of books, a table with objects, plants, lamps and a window to a garden."""

from __future__ import annotations

import numpy as np

from pipeline.drops import places_textures as tx
from pipeline.drops.places_parts import (
    UP,
    Array,
    Builder,
    Cell,
    Lamp,
    front,
    grid_faces,
    lamp,
    offset,
    turn,
)
from pipeline.drops.places_things import at, cell, planter, tree

Rng = np.random.Generator


def textures(rng: Rng) -> dict[str, Array]:
    """The room's materials."""
    brick = ((0.62, 0.36, 0.28), (0.54, 0.30, 0.24), (0.66, 0.44, 0.34))
    tile = ((0.80, 0.76, 0.68), (0.42, 0.30, 0.25), (0.70, 0.60, 0.45))
    return {
        "floor": tx.wood(rng, (0.58, 0.42, 0.28), planks=7),
        "wall": tx.plaster(rng, rng.uniform(0.6, 0.85, 3), rough=0.16),
        "brick": tx.courses(rng, brick, (0.6, 0.57, 0.52), 16, 8),
        "ceiling": tx.plaster(rng, (0.86, 0.84, 0.80), rough=0.1),
        "wood": tx.wood(rng, (0.60, 0.45, 0.30)),
        "tile": tx.courses(rng, tile, (0.3, 0.28, 0.26), 8, 8, shift=0.0),
        "paint": tx.plaster(rng, (0.9, 0.9, 0.9), rough=0.08, size=256),
        "metal": tx.plaster(rng, (0.30, 0.30, 0.31), rough=0.1, size=256),
        "bark": tx.wood(rng, (0.42, 0.35, 0.28), planks=9, size=256),
        "leaf": tx.foliage(rng),
        "cloth": tx.stripes(rng),
        "poster": tx.posters(rng),
        "spine": tx.spines(rng),
        "grass": tx.ground(rng, (0.30, 0.40, 0.18)),
    }


def shelf(b: Builder, rng: Rng, left: Array, right: Array, width: float, height: float) -> None:
    """Bookcase from its ground-left corner along the unit `right`, filled with books and things."""
    out, up, yaw = front(right)
    deep = 0.32
    tint = rng.uniform(0.6, 1.2) * np.ones(3)
    back = left + up * height + out * 0.02
    b.panel("wood", back, right * width, -up * height, tile=0.9, tint=tint * 0.8)
    for x in (0.0, width):
        side = left + right * x + up * height / 2 + out * deep / 2
        b.box("wood", side, (0.04, height, deep), yaw=yaw, tint=tint, tile=0.8)
    middle = left + right * width / 2
    levels = np.arange(0.1, height - 0.25, 0.36)
    for level in [*levels, height]:
        board = middle + up * level + out * deep / 2
        b.box("wood", board, (width, 0.035, deep), yaw=yaw, tint=tint, tile=0.8)
    for level in levels:
        books(b, rng, left, right, width, level)


def books(b: Builder, rng: Rng, left: Array, right: Array, width: float, level: float) -> None:
    """A row of books on the board at the height `level` of a shelf, some things among them."""
    out, up, yaw = front(right)
    x = 0.05
    while x < width - 0.12:
        if rng.random() < 0.06:
            thing(b, rng, left + right * (x + 0.1) + up * (level + 0.02) + out * 0.18, 0.24)
            x += 0.24
            continue
        w, h = rng.uniform(0.025, 0.07), rng.uniform(0.19, 0.31)
        colour = rng.uniform(0.12, 1.1, 3) * rng.uniform(0.5, 1.1)
        deep = rng.uniform(0.16, 0.2)
        p = left + right * (x + w / 2) + up * (level + 0.02 + h / 2) + out * deep
        spine = Cell(int(rng.integers(0, 8)), 0, 8, 1)
        b.box("spine", p, (w, h, 0.2), yaw=yaw, cell=spine, tint=colour, step=0.2)
        x += w + 0.004


def thing(b: Builder, rng: Rng, foot: Array, size: float) -> None:
    """A vase, bottle, bowl or box of about `size` metres."""
    colour = rng.uniform(0.15, 1.0, 3)
    kind = rng.integers(0, 4)
    if kind == 0:
        r = np.array([0.16, 0.12, 0.14, 0.3, 0.34, 0.24, 0.2]) * size
        b.lathe(
            "tile",
            foot,
            np.stack([r, np.linspace(1, 0, 7) * size], 1),
            tint=colour * 1.3,
            tile=(2, 1),
        )
    elif kind == 1:
        profile = [(0.06, 1), (0.07, 0.7), (0.18, 0.5), (0.18, 0.02)]
        b.lathe("paint", foot, np.asarray(profile) * size, tint=colour * 0.6)
    elif kind == 2:
        b.lathe(
            "cloth",
            foot,
            np.asarray([(0.5, 0.4), (0.4, 0.2), (0.18, 0.0)]) * size,
            tint=colour,
            tile=(3, 1),
        )
        for _ in range(5):
            spot = (
                foot
                + np.append(rng.uniform(-0.22, 0.22, 2) * size, 0)[[0, 2, 1]]
                - [0, 0.42 * size, 0]
            )
            b.ball(
                "paint",
                spot,
                np.full(3, 0.16 * size),
                sides=8,
                tint=rng.uniform(0.3, 1, 3) * [1, 0.8, 0.3],
            )
    else:
        b.box(
            "poster",
            foot - offset(0, size * 0.35, 0),
            np.array([0.7, 0.7, 0.6]) * size,
            yaw=rng.uniform(-0.6, 0.6),
            cell=cell(rng),
            step=0.2,
        )


def pot_plant(b: Builder, rng: Rng, foot: Array, size: float) -> None:
    """A pot with arching stems."""
    b.lathe(
        "tile",
        foot,
        np.asarray([(0.24, 0.4), (0.26, 0.36), (0.17, 0.0)]) * size,
        tint=rng.uniform(0.5, 1.2, 3),
        tile=(3, 1),
    )
    for _ in range(14):
        angle, lean = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.55) * size
        s = np.linspace(0, 1, 7)[:, None]
        way = np.array([np.cos(angle), 0, np.sin(angle)], np.float32)
        stem = foot + UP * size * (0.38 + 0.85 * s - 0.25 * s**2) + way * lean * s**2
        b.tube("leaf", stem, 0.012 * size + 0.003, sides=4)
        spot = np.repeat(stem[2:], 3, axis=0) + rng.normal(0, 0.06 * size, (15, 3))
        b.leaves(
            "leaf", spot, spot - foot - UP * 0.5 * size, 0.2 * size, rng, tint=(0.8, 1.05, 0.8)
        )


def table(b: Builder, rng: Rng, foot: Array, yaw: float) -> list[Lamp]:
    """The lamp on a table with things, a chair on each side."""
    lamps = []
    r, w, d, h = turn(yaw), rng.uniform(1.3, 1.8), 0.8, 0.75
    tint = rng.uniform(0.6, 1.3) * np.ones(3)
    b.box("wood", foot + offset(0, -h, 0), (w, 0.05, d), yaw=yaw, tint=tint, tile=0.7, step=0.12)
    for x in (-1.0, 1.0):
        for z in (-1.0, 1.0):
            b.box(
                "wood",
                foot + r @ np.array([x * (w / 2 - 0.06), -h / 2, z * (d / 2 - 0.06)]),
                (0.06, h, 0.06),
                yaw=yaw,
                tint=tint,
            )
    for k in range(6):
        spot = foot + r @ np.array([(-0.42 + 0.17 * k) * w, -h - 0.025, rng.uniform(-0.28, 0.25)])
        if k == 3:
            b.lathe(
                "metal", spot, [(0.015, 0.34), (0.015, 0.03), (0.08, 0.02), (0.08, 0.0)], sides=10
            )
            b.lathe(
                "paint",
                spot,
                [(0.09, 0.52), (0.19, 0.30)],
                sides=18,
                tint=(1.0, 0.85, 0.6),
                glow=0.8,
            )
            lamps.append(lamp(spot - offset(0, 0.40, 0), (1.2, 0.9, 0.55)))
        else:
            thing(b, rng, spot.astype(np.float32), rng.uniform(0.18, 0.3))
    for side in (-1, 1):
        c = foot + r @ np.array([side * w * 0.28, 0, side * (d / 2 + 0.2)])
        b.box(
            "wood", c + offset(0, -0.45, 0), (0.42, 0.04, 0.42), yaw=yaw, tint=tint * 0.9, tile=0.5
        )
        for x in (-0.18, 0.18):
            for z in (-0.18, 0.18):
                tall = 0.9 if z * side > 0 else 0.45
                b.tube("wood", [c + r @ np.array([x, 0, z]), c + r @ np.array([x, -tall, z])], 0.02)
        for k in range(3):
            b.box(
                "wood",
                c + r @ np.array([0, -0.6 - 0.12 * k, side * 0.18]),
                (0.38, 0.05, 0.025),
                yaw=yaw,
                tint=tint * 0.9,
                tile=0.5,
            )
    return lamps


def shell(b: Builder, rng: Rng, half: float, back: float, tall: float) -> None:
    """Floor, ceiling with beams, side walls and a back wall around a window."""
    b.panel("floor", at(-half, 0, back), [2 * half, 0, 0], [0, 0, -back - 2], tile=1.2)
    b.panel("ceiling", at(-half, tall, -2), [2 * half, 0, 0], [0, 0, back + 2], tile=1.5)
    for z in np.arange(1.5, back, 1.3):
        b.box("wood", at(0, tall - 0.1, z), (2 * half, 0.2, 0.16), tile=0.9)
    b.panel("wall", at(-half, tall, -2), [0, 0, back + 2], [0, tall, 0], tile=1.5)
    b.panel("wall", at(half, tall, back), [0, 0, -back - 2], [0, tall, 0], tile=1.5)
    b.panel("brick", at(half, tall, -2), [-2 * half, 0, 0], [0, tall, 0], tile=1.6)
    low, high = 0.85, tall - 0.35
    middle, wide = rng.uniform(-0.8, 0.8), rng.uniform(2.2, 2.9)
    x0, x1 = middle - wide / 2, middle + wide / 2
    for left, right, bottom, top in (
        (-half, x0, 0, tall),
        (x1, half, 0, tall),
        (x0, x1, 0, low),
        (x0, x1, high, tall),
    ):
        b.panel(
            "brick",
            at(left, top, back),
            [right - left, 0, 0],
            [0, top - bottom, 0],
            tile=1.6,
            shift=(left / 1.6, 0),
        )
    for x in np.linspace(x0, x1, 4):
        b.box("paint", at(x, (low + high) / 2, back), (0.07, high - low, 0.1), step=0.5)
    for h in np.linspace(low, high, 3):
        b.box("paint", at(middle, h, back), (wide, 0.06, 0.1), step=0.5)
    b.box("wood", at(middle, low - 0.03, back - 0.15), (wide + 0.3, 0.06, 0.4), tile=0.7)
    for k in range(3):
        pot_plant(b, rng, at(x0 + wide * (k + 0.5) / 3, low, back - 0.15), rng.uniform(0.35, 0.6))
    colour = rng.uniform(0.3, 1.0, 3)
    for x in (x0 - 0.25, x1 + 0.25):
        curtain(b, x, back - 0.12, high + 0.2, colour)


def curtain(b: Builder, x: float, z: float, top: float, colour: Array) -> None:
    """A curtain in folds, 0.6 m wide about `x`, from the height `top` to 0.3 m."""
    across, heights = np.linspace(-0.3, 0.3, 25), np.linspace(top, 0.3, 12)
    points = [[x + k, at(0, h, 0)[1], z + 0.05 * np.sin(k * 60)] for h in heights for k in across]
    normals = [[-np.cos(k * 60) * 0.8, 0, -1.0] for _ in heights for k in across]
    uv = [[k, v] for v in np.linspace(0, 1, 12) for k in across]
    b.add("cloth", points, normals, uv, grid_faces(12, 25), colour)


def garden(b: Builder, rng: Rng, back: float) -> None:
    """What the window shows: grass, a brick wall, trees and shrubs."""
    b.panel("grass", at(-9, -0.2, back + 8), [18, 0, 0], [0, 0, -7.9], tile=1.5, step=0.5)
    b.panel("brick", at(-9, 2.0, back + 8), [18, 0, 0], [0, 2.3, 0], tile=1.6, step=0.4)
    for _ in range(3):
        tree(
            b,
            rng,
            at(rng.uniform(-3.5, 3.5), -0.2, back + rng.uniform(3.5, 7)),
            rng.uniform(3.4, 4.8),
            800,
        )
    for _ in range(4):
        planter(
            b, rng, at(rng.uniform(-3, 3), -0.2, back + rng.uniform(2, 6)), rng.uniform(0.6, 1.0)
        )


def posters(b: Builder, rng: Rng, half: float, back: float) -> None:
    """Pictures along both side walls, `half` the room's width to either side."""
    for x, way in ((-half + 0.03, [0, 0, 1.0]), (half - 0.03, [0, 0, -1.0])):
        for z in np.arange(4.0, back - 0.8, 0.9):
            size = rng.uniform(0.45, 0.7)
            b.panel(
                "poster",
                at(x, rng.uniform(1.9, 2.6), z),
                np.asarray(way) * size,
                [0, size * 1.2, 0],
                cell=cell(rng),
            )


def hanging_lamps(b: Builder, rng: Rng, tall: float) -> list[Lamp]:
    """The lights of two shades on rods from the ceiling at `tall`."""
    lamps = []
    for x in rng.uniform(-2.2, 2.2, 2):
        z, drop = rng.uniform(4.5, 6.0), rng.uniform(0.7, 1.0)
        b.tube("metal", [at(x, tall, z), at(x, tall - drop, z)], 0.012)
        b.lathe(
            "metal",
            at(x, tall - drop - 0.25, z),
            [(0.03, 0.26), (0.1, 0.2), (0.24, 0.0)],
            sides=18,
            tint=rng.uniform(0.5, 2.5, 3),
        )
        b.ball(
            "paint", at(x, tall - drop - 0.24, z), np.full(3, 0.07), glow=1.5, tint=(1, 0.85, 0.6)
        )
        lamps.append(lamp(at(x, tall - drop - 0.36, z), (2.2, 1.7, 1.1)))
    return lamps


def crates(b: Builder, rng: Rng) -> None:
    """Four crates on the floor, each with something on it."""
    for _ in range(4):
        spot = at(rng.uniform(-2.5, 2.5), 0, rng.uniform(3.8, 6.5))
        b.box(
            "wood",
            spot - offset(0, 0.18, 0),
            (0.5, 0.36, 0.4),
            yaw=rng.uniform(-1, 1),
            tile=0.5,
            tint=rng.uniform(0.6, 1.4) * np.ones(3),
        )
        thing(b, rng, (spot - offset(0, 0.36, 0)).astype(np.float32), 0.26)


def build(rng: Rng) -> tuple[Builder, list[Lamp]]:
    """A study, laid out at random, and its lamps."""
    b = Builder(textures(rng), step=0.16)
    half, back, tall = rng.uniform(3.2, 4.0), rng.uniform(7.0, 8.5), rng.uniform(2.9, 3.3)
    shell(b, rng, half, back, tall)
    garden(b, rng, back)
    along, left, right = (np.asarray(v, np.float32) for v in ([1, 0, 0], [0, 0, 1], [0, 0, -1]))
    shelf(b, rng, at(-half + 0.05, 0, back - 0.02), along, half - 1.9, rng.uniform(2.1, 2.6))
    shelf(b, rng, at(1.9, 0, back - 0.02), along, half - 1.95, rng.uniform(2.1, 2.6))
    shelf(b, rng, at(-half + 0.02, 0, 4.2), left, 2.2, rng.uniform(1.8, 2.6))
    if rng.random() < 0.6:
        shelf(b, rng, at(half - 0.02, 0, 6.2), right, 2.0, rng.uniform(1.3, 2.4))
    posters(b, rng, half, back)
    b.panel(
        "cloth",
        at(-1.4, 0.015, 6.4),
        [2.8, 0, 0],
        [0, 0, -2.4],
        tile=1.4,
        tint=rng.uniform(0.3, 1.0, 3),
        step=0.12,
    )
    spot = at(rng.uniform(-0.9, 0.9), 0, rng.uniform(4.6, 5.4))
    lamps = table(b, rng, spot, rng.uniform(-0.35, 0.35))
    for side in (-1, 1):
        pot_plant(
            b,
            rng,
            at(side * rng.uniform(1.7, 2.5), 0, rng.uniform(4.0, 5.5)),
            rng.uniform(0.8, 1.1),
        )
    lamps += hanging_lamps(b, rng, tall)
    # Lamps behind the camera, out of its sight.
    lamps += [lamp(at(x, tall - 0.5, -0.3), (5.5, 4.8, 3.9)) for x in (-1.6, 1.6)]
    crates(b, rng)
    return b, lamps
