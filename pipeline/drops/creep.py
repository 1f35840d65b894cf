"""Drops that creep down the pane between photos, as those on a lens slowly do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.drops.shape import Drop


def crept(drops: Sequence[Drop], metres: float) -> list[Drop]:
    """The drops once the largest has moved down by `metres`; those that meet become one.

    Weight pulls with the cube of the radius and the rim holds with the radius, so that a drop
    creeps in proportion to the square of its radius: small ones stay. Merged drops keep the larger
    one's shape and the volume of both. Larger drops come first.
    """
    if not drops or metres == 0:
        return list(drops)
    largest = max(drop.radius for drop in drops)
    out: list[Drop] = []
    for drop in sorted(drops, key=lambda one: -one.radius):
        x, y = drop.center
        moved = replace(drop, center=(x, y + metres * (drop.radius / largest) ** 2))
        hit = next((k for k, one in enumerate(out) if _touch(one, moved)), None)
        if hit is None:
            out.append(moved)
        else:
            volume = out[hit].radius ** 3 + moved.radius**3
            out[hit] = replace(out[hit], radius=volume ** (1 / 3))
    return out


def _touch(one: Drop, other: Drop) -> bool:
    dx, dy = (a - b for a, b in zip(one.center, other.center, strict=True))
    return dx * dx + dy * dy < (0.9 * (one.radius + other.radius)) ** 2
