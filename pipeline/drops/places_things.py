"""Things that stand in places: trees, lamp posts, railings, bins, benches, stalls, planters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.drops import places_textures as tx
from pipeline.drops.places_parts import Array, Builder, Cell, offset, turn

Rng = np.random.Generator
EYE = 1.6  # height of the camera above the ground, metres
FRUITS = ((0.95, 0.45, 0.1), (0.8, 0.15, 0.12), (0.55, 0.75, 0.2), (0.95, 0.8, 0.25))


def at(x: float, h: float, z: float) -> Array:
    """Point at height `h` above the ground, in the frame of the place."""
    return np.array([x, EYE - h, z], np.float32)


def cell(rng: Rng, columns: int = 4, rows: int = 4) -> Cell:
    """A random cell of an atlas."""
    return Cell(int(rng.integers(0, columns)), int(rng.integers(0, rows)), columns, rows)


def tree(b: Builder, rng: Rng, foot: Array, height: float, leaves: int = 1100) -> None:
    """Trunk, branches and a crown of leaves."""
    up = np.array([0, -1, 0], np.float32)
    fork = foot + up * height * 0.45 + rng.normal(0, 0.08, 3)
    b.tube(
        "bark",
        [foot + up * -0.05, foot + up * height * 0.2, fork],
        [0.13, 0.10, 0.085],
        sides=9,
        tile=0.7,
    )
    crown = foot + up * height * 0.72
    green = (
        np.array([1.0, 1.0, 1.0])
        * rng.uniform(0.75, 1.2)
        * np.array([rng.uniform(0.8, 1.5), 1, rng.uniform(0.7, 1.0)])
    )
    tips = []
    for _ in range(9):
        d = rng.standard_normal(3)
        tip = crown + d / np.linalg.norm(d) * np.array([0.28, 0.24, 0.28]) * height * rng.uniform(
            0.5, 1.0
        )
        tips.append(tip)
        b.tube(
            "bark",
            [fork, (fork + tip) / 2 + rng.normal(0, 0.1, 3), tip],
            [0.06, 0.035, 0.015],
            sides=5,
        )
    pick = rng.integers(0, len(tips), leaves)
    spot = np.asarray(tips)[pick] + rng.normal(0, 0.105 * height, (leaves, 3)) * [1, 0.8, 1]
    b.leaves("leaf", spot, spot - crown + up * 0.6, 0.17, rng, tint=green, spread=0.22)


def lamp_post(b: Builder, rng: Rng, foot: Array) -> None:
    """Street lamp, about 3.6 m."""
    up = np.array([0, -1, 0], np.float32)
    h = rng.uniform(3.2, 3.9)
    b.lathe(
        "metal", foot, [(0.05, 0.9), (0.07, 0.8), (0.08, 0.4), (0.13, 0.3), (0.15, 0.0)], sides=10
    )
    b.tube("metal", [foot + up * 0.6, foot + up * h], [0.05, 0.035], sides=8)
    top = foot + up * h
    b.lathe("paint", top, [(0.17, 0.42), (0.10, 0.02)], sides=6, tint=(1.0, 0.95, 0.8))
    b.lathe("metal", top, [(0.02, 0.66), (0.05, 0.58), (0.24, 0.42), (0.22, 0.40)], sides=6)
    arm = top - up * 0.5
    b.tube("metal", [arm + offset(-0.35, 0, 0), arm, arm + offset(0.35, 0, 0)], 0.018)


def railing(b: Builder, rng: Rng, start: Array, end: Array) -> None:
    """Iron railing of upright bars, about 1 m high."""
    up = np.array([0, -1, 0], np.float32)
    n = max(2, int(np.linalg.norm(end - start) / 0.17))
    for h in (0.16, 0.92):
        b.tube("metal", [start + up * h, end + up * h], 0.022, tint=(0.6, 0.7, 0.65))
    for k in range(n + 1):
        foot = start + (end - start) * k / n
        thick = 0.028 if k % 8 == 0 else 0.012
        b.tube("metal", [foot, foot + up * 1.02], thick, sides=5, tint=(0.6, 0.7, 0.65))


def bin_(b: Builder, rng: Rng, foot: Array) -> None:
    """Litter bin with a lid and a print on it."""
    tint = rng.uniform(0.15, 0.6, 3)
    shape = [(0.02, 0.95), (0.2, 0.9), (0.27, 0.8), (0.25, 0.78), (0.25, 0.4), (0.22, 0.02)]
    b.lathe("paint", foot, shape, sides=14, tint=tint)
    corner = foot + np.array([-0.13, -0.68, -0.262], np.float32)
    b.panel("poster", corner, [0.26, 0, 0], [0, 0.3, 0], cell=cell(rng), step=0.15)


def bench(b: Builder, rng: Rng, foot: Array, yaw: float) -> None:
    """Slatted bench."""
    r = turn(yaw)
    tint = rng.uniform(0.7, 1.3) * np.array([1.0, 0.9, 0.8])
    for k in range(4):
        b.box(
            "wood",
            foot + r @ np.array([0, -0.45, -0.2 + 0.12 * k]),
            (1.6, 0.04, 0.09),
            yaw=yaw,
            tint=tint,
            tile=0.7,
        )
    for k in range(3):
        b.box(
            "wood",
            foot + r @ np.array([0, -0.6 - 0.14 * k, 0.27]),
            (1.6, 0.09, 0.04),
            yaw=yaw,
            tint=tint,
            tile=0.7,
        )
    for x in (-0.65, 0.65):
        for z in (-0.2, 0.26):
            b.box("metal", foot + r @ np.array([x, -0.22, z]), (0.05, 0.44, 0.05), yaw=yaw)
        b.box("metal", foot + r @ np.array([x, -0.65, 0.3]), (0.05, 0.5, 0.04), yaw=yaw)


def fruit_crate(
    b: Builder,
    rng: Rng,
    place: Callable[[float, float, float], Array],
    x: float,
    width: float,
    yaw: float,
) -> None:
    """A crate of one kind of fruit on a stall's table; `place` turns (along, up, away) to the world."""
    b.box(
        "wood",
        place(x, 0.9, -0.15),
        (width - 0.06, 0.18, 0.6),
        yaw=yaw,
        tile=0.3,
        tint=(1.2, 1.1, 0.9),
    )
    fruit = np.asarray(FRUITS)[rng.integers(0, len(FRUITS))]
    for _ in range(14):
        spot = place(
            x + rng.uniform(-0.5, 0.5) * (width - 0.15),
            1.01 + rng.uniform(0, 0.06),
            -0.15 + rng.uniform(-0.24, 0.24),
        )
        b.ball(
            "paint",
            spot,
            np.full(3, rng.uniform(0.05, 0.075)),
            sides=8,
            tint=fruit * rng.uniform(0.8, 1.15),
        )


def stall(b: Builder, rng: Rng, foot: Array, yaw: float) -> None:
    """Market stall: striped roof on poles, crates of fruit on a table, a lettered board."""
    r, w, d = turn(yaw), rng.uniform(1.8, 2.4), 1.2

    def p(x: float, h: float, z: float) -> Array:
        return (foot + r @ np.array([x, -h, z])).astype(np.float32)

    for x in (-w / 2, w / 2):
        for z in (-d / 2, d / 2):
            b.tube("wood", [p(x, 0, z), p(x, 2.1 if z < 0 else 2.5, z)], 0.03, sides=6)
    colour = np.clip(rng.uniform(0.35, 1.3, 3), 0, 1.05)
    over = p(-w / 2 - 0.15, 2.55, d / 2 + 0.1)
    b.panel(
        "cloth",
        over,
        r @ np.array([w + 0.3, 0, 0]),
        p(0, 2.05, -d / 2 - 0.25) - p(0, 2.55, d / 2 + 0.1),
        tile=1.3,
        tint=colour,
    )
    b.panel(
        "cloth",
        p(-w / 2 - 0.15, 2.05, -d / 2 - 0.25),
        r @ np.array([w + 0.3, 0, 0]),
        [0, 0.2, 0],
        tile=1.3,
        tint=colour,
    )
    b.box("wood", p(0, 0.78, 0), (w, 0.06, d), yaw=yaw, tile=0.8)
    word = Cell(0, int(rng.integers(0, len(tx.WORDS))), 1, len(tx.WORDS))
    b.panel(
        "sign",
        p(-w * 0.4, 0.62, -d / 2 - 0.03),
        r @ np.array([w * 0.8, 0, 0]),
        [0, 0.32, 0],
        cell=word,
        step=0.2,
    )
    b.box(
        "wood",
        p(0, 0.4, -d / 2 + 0.05),
        (w - 0.1, 0.72, 0.05),
        yaw=yaw,
        tile=0.6,
        tint=(0.7, 0.65, 0.6),
    )
    for k in range(4):
        fruit_crate(b, rng, p, -w / 2 + w * (k + 0.5) / 4, w / 4, yaw)


def planter(b: Builder, rng: Rng, foot: Array, size: float = 0.5, leaves: int = 160) -> None:
    """Box of earth with a shrub."""
    up = np.array([0, -1, 0], np.float32)
    b.box(
        "wood",
        foot + up * size * 0.4,
        (size * 1.3, size * 0.8, size * 1.3),
        tile=0.6,
        tint=rng.uniform(0.7, 1.2, 3),
    )
    middle = foot + up * size * 1.35
    spot = middle + rng.normal(0, 0.33 * size, (leaves, 3))
    bloom = np.where(rng.random((leaves, 1, 1)) < 0.15, rng.uniform(0.6, 2.5, 3), [1.0, 1.05, 0.9])
    b.leaves(
        "leaf",
        spot,
        spot - middle + up * 0.4,
        0.14,
        rng,
        tint=np.broadcast_to(bloom, (leaves, 4, 3)),
    )


def notice(b: Builder, rng: Rng, foot: Array) -> None:
    """Board of prints on two posts."""
    up = np.array([0, -1, 0], np.float32)
    for x in (-0.55, 0.55):
        b.tube("metal", [foot + offset(x, 0, 0), foot + offset(x, 0, 0) + up * 1.9], 0.035)
    b.box("wood", foot + up * 1.35, (1.1, 0.95, 0.06), tile=0.5)
    for k in range(2):
        b.panel(
            "poster",
            foot + up * 1.78 + np.array([-0.5 + 0.52 * k, 0, -0.05], np.float32),
            [0.48, 0, 0],
            [0, 0.82, 0],
            cell=cell(rng),
            step=0.15,
        )


def wires(b: Builder, rng: Rng) -> None:
    """Cables and a string of pennants across the street."""
    for _ in range(2):
        h0, h1, z = rng.uniform(4.2, 5.2), rng.uniform(4.2, 5.2), rng.uniform(6.5, 9)
        s = np.linspace(0, 1, 24)
        line = np.stack(
            [-8 + 16 * s, EYE - (h0 + (h1 - h0) * s - 2.0 * s * (1 - s)), np.full(24, z)], 1
        )
        b.tube("metal", line, 0.012, sides=4)
        for p in line[1:-1]:
            colour = rng.uniform(0.15, 1.0, 3)
            v = p + np.array([[-0.13, 0, 0], [0.13, 0, 0], [0, 0.3, 0]])
            b.add(
                "cloth",
                v,
                np.tile([0, -0.2, -1.0], (3, 1)),
                np.array([[0, 0], [0.05, 0], [0.02, 0.2]]),
                [[0, 1, 2]],
                colour,
            )
