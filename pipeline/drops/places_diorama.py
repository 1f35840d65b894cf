"""A street of plain blocks: what a field's speed and quality are measured on without leaves and wires.

As busy as the streets of toy blocks on which fields are often compared: houses that are boxes, with windows
painted on them, kiosks, crates, columns and balls, every one of them wider than a few pixels.
"""

from __future__ import annotations

import numpy as np

from pipeline.drops import places_textures as tx
from pipeline.drops.places_parts import UP, Array, Builder, front, turn
from pipeline.drops.places_street import BLOCK, BRICK, SETT, TILE
from pipeline.drops.places_things import at, cell

Rng = np.random.Generator
SIZE = 1024
RIGHT = np.array([1, 0, 0], np.float32)


def textures(rng: Rng) -> dict[str, Array]:
    """The diorama's twelve materials."""
    return {
        "brick": tx.courses(rng, BRICK, (0.66, 0.62, 0.56), 14, 7, size=SIZE),
        "stone": tx.courses(rng, BLOCK, (0.5, 0.47, 0.42), 6, 4, gap=0.03, size=SIZE),
        "setts": tx.courses(rng, SETT, (0.28, 0.26, 0.24), 10, 10, gap=0.08, size=SIZE),
        "tiles": tx.courses(rng, TILE, (0.22, 0.13, 0.10), 10, 8, spread=0.3, size=SIZE),
        "plaster": tx.plaster(rng, (0.86, 0.85, 0.82), size=SIZE),
        "paint": tx.plaster(rng, (0.9, 0.9, 0.9), rough=0.08, size=SIZE),
        "asphalt": tx.plaster(rng, (0.42, 0.42, 0.43), rough=0.2, size=SIZE),
        "wood": tx.wood(rng, (0.62, 0.52, 0.40), size=SIZE),
        "marble": tx.ripples(rng, size=SIZE),
        "cloth": tx.stripes(rng, size=SIZE),
        "window": tx.windows(rng, cell=SIZE // 4),
        "poster": tx.posters(rng, cell=SIZE // 4),
    }


def facade(b: Builder, rng: Rng, left: Array, right: Array, width: float, height: float) -> None:
    """Windows and a door painted on a wall, from its ground-left corner along the unit `right`."""
    out, up, _ = front(right)
    columns, floors = max(2, round(width / 1.5)), max(1, round((height - 0.6) / 2.2))
    door = int(rng.integers(0, columns))
    for floor in range(floors):
        for k in range(columns):
            middle = left + right * width * (k + 0.5) / columns + out * 0.02
            if floor == 0 and k == door:
                b.panel("wood", middle - right * 0.5 + up * 2.0, right * 1.0, -up * 2.0, tile=1.6,
                        tint=rng.uniform(0.5, 1.3, 3))  # fmt: skip
                continue
            top = middle - right * 0.45 + up * (floor * 2.2 + 2.1)
            b.panel("window", top, right * 0.9, -up * 1.3, cell=cell(rng))


def block(
    b: Builder, rng: Rng, left: Array, right: Array, width: float, height: float, depth: float
) -> None:
    """A house: a box with a painted front, a plinth, a cornice and a chimney."""
    out, up, yaw = front(right)
    kind = ("brick", "plaster", "stone", "tiles")[int(rng.integers(0, 4))]
    tint = rng.uniform(0.75, 1.1) * rng.uniform(0.85, 1.15, 3)
    middle = left + right * width / 2 - out * depth / 2
    b.box(kind, middle + up * height / 2, (width, height, depth), yaw=yaw, tile=3.0, tint=tint,
          shift=tuple(rng.random(2)))  # fmt: skip
    colour = rng.uniform(0.4, 1.0, 3)
    b.box("paint", middle + up * (height + 0.12), (width + 0.3, 0.3, depth + 0.3), yaw=yaw,
          tile=2.0, tint=colour)  # fmt: skip
    b.box("stone", middle + up * 0.15, (width + 0.1, 0.36, depth + 0.1), yaw=yaw, tile=2.0)
    stack = middle + right * width * rng.uniform(-0.3, 0.3) + up * (height + 0.8)
    b.box("brick", stack, (0.8, 1.2, 0.8), yaw=yaw, tile=2.4, tint=(0.9, 0.8, 0.8))
    facade(b, rng, left + up * 0.34, right, width, height)


def kiosk(b: Builder, rng: Rng, foot: Array, yaw: float) -> None:
    """A booth with prints on its front and a striped roof."""
    width, height = rng.uniform(1.1, 1.5), rng.uniform(1.9, 2.4)
    b.box("wood", foot + UP * height / 2, (width, height, width), yaw=yaw, tile=2.0,
          tint=rng.uniform(0.5, 1.3, 3))  # fmt: skip
    b.box("cloth", foot + UP * (height + 0.1), (width + 0.4, 0.22, width + 0.4), yaw=yaw, tile=2.0,
          tint=rng.uniform(0.4, 1.0, 3))  # fmt: skip
    right = (turn(yaw) @ RIGHT).astype(np.float32)
    out, up, _ = front(right)
    corner = foot + out * (width / 2 + 0.02) - right * width * 0.4 + up * height * 0.85
    b.panel("poster", corner, right * width * 0.8, -up * width * 0.8, cell=cell(rng))


def column(b: Builder, rng: Rng, foot: Array) -> None:
    """A column of stone with a ball on it."""
    height, radius = rng.uniform(1.4, 2.2), rng.uniform(0.16, 0.24)
    shape = [(radius, height), (radius, 0.3), (radius * 1.5, 0.25), (radius * 1.5, 0.0)]
    b.lathe("stone", foot, shape, sides=24, tile=(1.0, 1.0))
    size = radius * 1.7
    tint = rng.uniform(0.6, 1.6, 3)
    b.ball("marble", foot + UP * (height + size), (size,) * 3, sides=28, tint=tint, tile=(1.0, 0.5))


def crates(b: Builder, rng: Rng, foot: Array) -> None:
    """Two crates, one on the other, with a print."""
    lower = rng.uniform(0.6, 0.9)
    yaw = float(rng.uniform(-0.6, 0.6))
    b.box("wood", foot + UP * lower / 2, (lower,) * 3, yaw=yaw, tile=1.5,
          tint=rng.uniform(0.7, 1.3, 3))  # fmt: skip
    upper = lower * 0.7
    b.box("poster", foot + UP * (lower + upper / 2), (upper,) * 3, yaw=yaw + 0.5, cell=cell(rng))


def row_of_blocks(b: Builder, rng: Rng) -> None:
    """Houses across the view, one at each side that comes nearer, and a wall behind the gaps."""
    b.panel("marble", at(-16, 9, 16), [32, 0, 0], [0, 9.2, 0], tile=8.0, tint=(1.6, 1.3, 1.1))
    x = -9.5
    while x < 9.5:
        width = rng.uniform(2.6, 4.4)
        left = at(x, 0, rng.uniform(9.5, 11.5))
        block(b, rng, left, RIGHT, width, rng.uniform(3.4, 6.2), rng.uniform(2.0, 3.0))
        x += width + rng.uniform(0.5, 1.0)
    for side in (-1, 1):
        edge = side * rng.uniform(4.6, 5.4)
        near, far = rng.uniform(6.4, 7.0), 9.0
        start, along = (
            (at(edge, 0, near), [0, 0, 1.0]) if side < 0 else (at(edge, 0, far), [0, 0, -1.0])
        )
        height = rng.uniform(3.6, 5.0)
        block(b, rng, start, np.asarray(along, np.float32), far - near, height, 2.0)


def build(rng: Rng) -> Builder:
    """A street of plain blocks, laid out at random: metres, camera at EYE above the ground."""
    b = Builder(textures(rng), step=0.18)
    b.panel("setts", at(-16, 0, 17), [32, 0, 0], [0, 0, -10.5], tile=4.0)
    b.panel("asphalt", at(-16, -0.14, 6.5), [32, 0, 0], [0, 0, -5.0], tile=4.0)
    b.box("stone", at(0, -0.06, 6.5), (32, 0.18, 0.3), tile=2.0)
    row_of_blocks(b, rng)
    slots = list(rng.permutation(np.linspace(-3.3, 3.3, 7)))
    for x in slots[:2]:
        kiosk(b, rng, at(x, 0, rng.uniform(7.2, 8.6)), float(rng.uniform(-0.5, 0.5)))
    for x in slots[2:4]:
        column(b, rng, at(x, 0, rng.uniform(5.6, 6.2) + 1.2))
    for x in slots[4:6]:
        crates(b, rng, at(x * 0.8, -0.14, rng.uniform(4.4, 5.6)))
    for k in range(2):
        size = rng.uniform(0.28, 0.45)
        foot = at(rng.uniform(0.5, 2.0) * (-1) ** k, -0.14 + size, rng.uniform(4.0, 5.0))
        b.ball(
            "marble", foot, (size,) * 3, sides=36, tint=rng.uniform(0.6, 1.6, 3), tile=(1.0, 0.5)
        )
    return b
