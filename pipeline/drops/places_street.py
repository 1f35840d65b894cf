"""A street corner: houses, trees, lamp posts, railings, a market stall, lettered signs."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.drops import places_textures as tx
from pipeline.drops.places_parts import Array, Builder, Cell, front
from pipeline.drops.places_things import (
    at,
    bench,
    bin_,
    cell,
    lamp_post,
    notice,
    planter,
    railing,
    stall,
    tree,
    wires,
)

Rng = np.random.Generator
WALLS = ((0.80, 0.72, 0.58), (0.75, 0.52, 0.40), (0.60, 0.66, 0.66), (0.82, 0.78, 0.72),
         (0.70, 0.62, 0.40), (0.62, 0.44, 0.42), (0.55, 0.62, 0.50))  # fmt: skip
PAINTS = (
    (0.12, 0.26, 0.22),
    (0.42, 0.12, 0.10),
    (0.12, 0.20, 0.36),
    (0.85, 0.83, 0.78),
    (0.25, 0.18, 0.13),
)
BRICK = ((0.62, 0.34, 0.26), (0.55, 0.28, 0.22), (0.68, 0.42, 0.32), (0.48, 0.26, 0.22))
SETT = ((0.52, 0.50, 0.47), (0.44, 0.43, 0.42), (0.58, 0.54, 0.48), (0.40, 0.38, 0.37))
TILE = ((0.58, 0.30, 0.22), (0.50, 0.26, 0.20), (0.62, 0.36, 0.26))
BLOCK = ((0.74, 0.70, 0.62), (0.68, 0.64, 0.56), (0.78, 0.74, 0.68))


def textures(rng: Rng) -> dict[str, Array]:
    """The street's materials."""
    return {
        "brick": tx.courses(rng, BRICK, (0.66, 0.62, 0.56), 16, 8),
        "stone": tx.courses(rng, BLOCK, (0.5, 0.47, 0.42), 6, 4, gap=0.03, spread=0.12),
        "plaster": tx.plaster(rng, (0.86, 0.85, 0.82)),
        "setts": tx.courses(rng, SETT, (0.28, 0.26, 0.24), 10, 10, gap=0.08),
        "asphalt": tx.ground(rng, (0.36, 0.36, 0.37)),
        "soil": tx.ground(rng, (0.34, 0.26, 0.19)),
        "tiles": tx.courses(rng, TILE, (0.22, 0.13, 0.10), 10, 8, gap=0.05, spread=0.3),
        "wood": tx.wood(rng, (0.62, 0.52, 0.40)),
        "paint": tx.plaster(rng, (0.9, 0.9, 0.9), rough=0.08, size=256),
        "metal": tx.plaster(rng, (0.34, 0.36, 0.37), rough=0.10, size=256),
        "bark": tx.wood(rng, (0.42, 0.35, 0.28), planks=9, size=256),
        "leaf": tx.foliage(rng),
        "cloth": tx.stripes(rng),
        "window": tx.windows(rng),
        "sign": tx.signs(rng),
        "poster": tx.posters(rng),
    }


def window(
    b: Builder, rng: Rng, middle: Array, right: Array, w: float, h: float, paint: Array
) -> None:
    """Window in a wall: pane, frame, cross bars, sill and perhaps shutters; `right` is a unit."""
    out, _, yaw = front(right)
    corner = middle - right * w / 2 - np.array([0, h / 2, 0], np.float32) + out * 0.02
    b.panel("window", corner, right * w, [0, h, 0], cell=cell(rng), step=0.5)
    white = (0.95, 0.94, 0.9) if rng.random() < 0.7 else paint
    bars = (
        (-w / 2, 0, 0.07, h + 0.07),
        (w / 2, 0, 0.07, h + 0.07),
        (0, -h / 2, w, 0.07),
        (0, h / 2, w, 0.07),
        (0, 0, 0.05, h),
        (0, -h * 0.15, w, 0.04),
    )
    for number, (dx, dy, sx, sy) in enumerate(bars):  # those that cross end in planes of their own
        p = middle + right * dx + np.array([0, dy, 0], np.float32) + out * 0.05
        b.box("paint", p, (sx, sy, 0.10 - 0.004 * number), yaw=yaw, tint=white, step=0.6)
    sill = middle + np.array([0, h / 2 + 0.08, 0], np.float32) + out * 0.1
    b.box("stone", sill, (w + 0.08, 0.09, 0.24), yaw=yaw, step=0.5)
    if rng.random() < 0.45:
        for side in (-1, 1):
            p = middle + right * side * (w * 0.5 + 0.27) + out * 0.06
            b.box(
                "wood",
                p,
                (0.42, h, 0.05 + 0.006 * side),  # two windows' shutters may lie one upon the other
                yaw=yaw,
                tint=np.asarray(paint) * 1.9,
                tile=0.8,
                step=0.4,
            )
    elif rng.random() < 0.5:
        flowers(b, rng, middle + np.array([0, h / 2 - 0.06, 0], np.float32), right, w)


def flowers(b: Builder, rng: Rng, sill: Array, right: Array, w: float) -> None:
    """A box of flowers on a sill of width `w` along the unit `right`."""
    out, _, yaw = front(right)
    n = 60
    box = sill + out * 0.22
    b.box("wood", box, (w * 0.9, 0.18, 0.2), yaw=yaw, step=0.5)
    along = right * rng.uniform(-w * 0.45, w * 0.45, (n, 1))
    spot = box + along + rng.uniform(-0.12, 0.12, (n, 3)) - np.array([0, 0.18, 0])
    bloom = np.where(rng.random((n, 1)) < 0.4, [[2.2, 0.5, 0.6]], [[1.0, 1.0, 1.0]])
    tint = np.repeat(bloom, 4, 0).reshape(n, 4, 3)
    b.leaves("leaf", spot, np.tile(out - [0, 0.6, 0], (n, 1)), 0.13, rng, tint=tint)


def shop_front(b: Builder, rng: Rng, left: Array, right: Array, width: float, paint: Array) -> None:
    """Ground floor of a shop: big panes, a door, a lettered board, sometimes an awning."""
    out, up, yaw = front(right)
    b.box(
        "wood",
        left + right * width / 2 + up * 0.35 + out * 0.07,
        (width - 0.02, 0.7, 0.12),
        yaw=yaw,
        tint=paint * 2.2,
    )
    door = rng.uniform(0.2, 0.8) * (width - 1.0)
    for start, end in ((0.15, door), (door + 1.0, width - 0.15)):
        n = max(1, round((end - start) / 1.1))
        for k in range(n):
            w = (end - start) / n
            if w > 0.35:
                p = left + right * (start + w * (k + 0.5)) + up * 1.45
                window(b, rng, p, right, w - 0.1, 1.4, paint)
    p = left + right * (door + 0.5) + up * 1.05 + out * 0.05
    b.box("wood", p, (0.9, 2.1, 0.1), yaw=yaw, tint=paint * 1.6, tile=0.9)
    b.panel(
        "window", p - right * 0.3 + up * 0.85 + out * 0.06, right * 0.6, [0, 0.9, 0], cell=cell(rng)
    )
    word = Cell(0, int(rng.integers(0, len(tx.WORDS))), 1, len(tx.WORDS))
    board = left + right * 0.2 + up * 2.86 + out * 0.12
    b.panel("sign", board, right * (width - 0.4), [0, 0.52, 0], cell=word, step=0.3)
    b.box(
        "wood",
        left + right * width / 2 + up * 2.6 + out * 0.05,
        (width - 0.2, 0.62, 0.1),
        yaw=yaw,
        tint=paint * 2,
    )
    if rng.random() < 0.6:
        span = rng.uniform(0.5, 0.9) * width
        top = left + right * rng.uniform(0, width - span) + up * 2.35 + out * 0.1
        colour = np.clip(rng.uniform(0.3, 1.2, 3), 0, 1.0)
        b.panel("cloth", top, right * span, out * 1.0 - up * 0.45, tile=1.6, tint=colour, step=0.2)
        b.panel(
            "cloth", top + out * 1.0 - up * 0.45, right * span, -up * 0.18, tile=1.6, tint=colour
        )


def roof(b: Builder, rng: Rng, corner: Array, right: Array, width: float) -> None:
    """A tiled slope and a chimney, from the eaves' left `corner` along the unit `right`."""
    out, up, yaw = front(right)
    ridge = rng.uniform(1.2, 2.0)
    eave = corner + out * 0.35 - right * 0.1
    slope = out * -2.4 + up * ridge
    b.panel(
        "tiles",
        eave + slope,
        right * (width + 0.2),
        -slope,
        tile=1.4,
        tint=rng.uniform(0.75, 1.15) * np.ones(3),
    )
    stack = eave + slope * 0.7 + right * rng.uniform(0.15, 0.85) * width
    b.box("brick", stack + up * 0.4, (0.55, 1.5, 0.5), yaw=yaw, tile=1.6, tint=(0.8, 0.75, 0.75))
    for k in (-0.12, 0.12):
        b.tube("tiles", [stack + up * 1.1 + right * k, stack + up * 1.5 + right * k], 0.08)


def ground_floor(
    b: Builder, rng: Rng, left: Array, right: Array, width: float, paint: Array
) -> None:
    """A door in the middle with a step before it, and windows to its sides."""
    out, up, yaw = front(right)
    n = max(1, round(width / 1.5))
    for k in range(n):
        p = left + right * width * (k + 0.5) / n
        if k == n // 2:
            b.box(
                "wood",
                p + up * 1.05 + out * 0.035,
                (0.95, 2.1, 0.1),
                yaw=yaw,
                tint=paint * 1.7,
                tile=0.9,
            )
            b.box("stone", p + up * 0.08 + out * 0.3, (1.3, 0.16, 0.6), yaw=yaw)
        else:
            window(b, rng, p + up * 1.6, right, 0.85, 1.3, paint)


def house(b: Builder, rng: Rng, left: Array, right: Array, width: float, height: float) -> None:
    """Front of a house, from its ground-left corner along the unit `right`, roof and chimney."""
    out, up, yaw = front(right)
    paint = np.asarray(PAINTS[int(rng.integers(0, len(PAINTS)))], np.float32)
    kind = ("brick", "plaster", "stone")[int(rng.choice(3, p=(0.45, 0.4, 0.15)))]
    tint = (
        np.asarray(WALLS[int(rng.integers(0, len(WALLS)))]) * 1.15
        if kind == "plaster"
        else rng.uniform(0.8, 1.15, 3)
    )
    wall: dict[str, Any] = {"tile": 1.6, "tint": tint, "shift": tuple(rng.random(2))}
    b.panel(kind, left + up * height, right * width, -up * height, **wall)
    # The gable ends and quoins keep within the house: in one plane with the neighbour's it would be
    # chance which of the two a ray meets.
    near, far = left + right * 0.01, left + right * (width - 0.01)
    b.panel(kind, near + up * height - out * 3, out * 3, -up * height, **wall)
    b.panel(kind, far + up * height, -out * 3, -up * height, **wall)
    for x in (0.11, width - 0.11):
        quoin = left + right * x + up * height / 2 + out * 0.03
        b.box("stone", quoin, (0.18, height, 0.1), yaw=yaw, tile=0.8)
    for level in (0.12, 2.98, height - 0.06):
        b.box(
            "stone",
            left + right * width / 2 + up * level + out * 0.06,
            (width, 0.16, 0.16),
            yaw=yaw,
            tile=0.8,
        )
    roof(b, rng, left + up * height, right, width)
    if rng.random() < 0.65 and width > 2.6:
        shop_front(b, rng, left + out * 0.02, right, width, paint)
    else:
        ground_floor(b, rng, left, right, width, paint)
    columns = max(1, round(width / rng.uniform(1.25, 1.7)))
    for level in np.arange(4.0, height - 0.6, 2.2):
        for k in range(columns):
            window(
                b,
                rng,
                left + right * width * (k + 0.5) / columns + up * level,
                right,
                0.8,
                1.3,
                paint,
            )
    gutter = left + right * 0.12 + out * 0.1
    b.tube("metal", [gutter + up * height, gutter + up * 1.5, gutter], 0.05)


def row_of_houses(b: Builder, rng: Rng) -> None:
    """Fronts across the view with an alley between two of them, and perhaps wings at the sides."""
    gap = rng.uniform(-3.0, 3.0)  # an alley with a house at its end
    x, depth = -11.0, rng.uniform(10.0, 11.0)
    while x < 11:
        width = rng.uniform(3.0, 4.6)
        if x < gap < x + width:
            house(
                b,
                rng,
                at(x - 0.6, 0, depth + rng.uniform(4.0, 4.8)),
                np.array([1, 0, 0], np.float32),
                width + 1.2,
                5.4,
            )
            bin_(b, rng, at(x + 0.5, 0, depth + 1.5))
            planter(b, rng, at(x + width - 0.6, 0, depth + 0.8))
        else:
            house(
                b,
                rng,
                at(x, 0, depth + rng.uniform(-0.7, 0.9)),
                np.array([1, 0, 0], np.float32),
                width,
                rng.uniform(4.4, 6.4),
            )
        x += width
    for side in (-1, 1):
        if rng.random() < 0.6:  # a wing that comes towards the camera
            edge = side * rng.uniform(4.4, 5.4)
            near, far = rng.uniform(6.6, 7.2), 9.6
            start, along = (
                (at(edge, 0, near), [0, 0, 1.0]) if side < 0 else (at(edge, 0, far), [0, 0, -1.0])
            )
            house(b, rng, start, np.asarray(along, np.float32), far - near, rng.uniform(4.4, 5.6))


def build(rng: Rng) -> Builder:
    """A street corner, laid out at random: metres, camera at EYE above the ground."""
    b = Builder(textures(rng))
    b.panel("setts", at(-14, 0, 18), [28, 0, 0], [0, 0, -11.5], tile=1.5, step=0.4)
    b.panel("asphalt", at(-14, -0.12, 6.5), [28, 0, 0], [0, 0, -8.5], tile=2.0, step=0.4)
    b.box("stone", at(0, -0.05, 6.5), (28, 0.16, 0.18), tile=0.8, step=0.3)
    row_of_houses(b, rng)
    slots = list(rng.permutation(np.linspace(-3.6, 3.6, 7)))
    for x in slots[:2]:
        tree(b, rng, at(x, 0, rng.uniform(6.8, 8.5)), rng.uniform(3.6, 4.8))
    stall(b, rng, at(slots[2], 0, rng.uniform(6.9, 8.2)), rng.uniform(-0.3, 0.3))
    bench(b, rng, at(slots[3], 0, rng.uniform(6.8, 7.6)), rng.uniform(-0.4, 0.4) + np.pi)
    notice(b, rng, at(slots[4] * 0.8, 0, rng.uniform(5.2, 6.8)))
    lamp_post(b, rng, at(slots[5] * 0.8, 0, rng.uniform(5.0, 6.3)))
    lamp_post(b, rng, at(-slots[5], 0, rng.uniform(8.0, 9.5)))
    first = rng.uniform(-3.2, 0.6)
    z = rng.uniform(4.3, 4.9)
    railing(
        b,
        rng,
        at(first, -0.12, z),
        at(first + rng.uniform(2.0, 3.0), -0.12, z + rng.uniform(-0.2, 0.2)),
    )
    for _ in range(3):
        bin_(b, rng, at(rng.uniform(-4, 4), 0, rng.uniform(6.7, 9.0)))
        planter(b, rng, at(rng.uniform(-4.5, 4.5), 0, rng.uniform(6.7, 9.4)), rng.uniform(0.4, 0.6))
    planter(
        b, rng, at(rng.uniform(1.2, 2.2) * rng.choice([-1, 1]), -0.12, rng.uniform(4.0, 4.6)), 0.45
    )
    wires(b, rng)
    return b
