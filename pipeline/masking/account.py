"""What the loop did, as plain numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.masking.loop import Repaired, Round
from pipeline.masking.seek import describe


def account(done: Repaired, names: Sequence[str]) -> dict[str, Any]:
    """The rounds of the loop for refine.json; `names` of the images whose masks they hold, in order."""
    last = done.rounds[-1]
    found = last.found
    glass = describe(found)
    if last.window:
        glass += f", over {last.window} neighbouring photos at a time"
    pane = None
    if found.mode == "pane" and found.pane_from_world is not None:
        pane = {
            "distance": found.distance,
            "tilt_x_deg": found.tilt_x_deg,
            "tilt_y_deg": found.tilt_y_deg,
            "pane_from_world": found.pane_from_world.tolist(),
        }
    return {
        "mode": found.mode,
        "why": f"{glass}; {done.ended}",
        "pane": pane,
        "rounds": {str(number): _round(one) for number, one in enumerate(done.rounds)},
        "coverage": {
            name: round(float(drop_mask.mean()), 6)
            for name, drop_mask in zip(names, last.drop_masks, strict=True)
        },
        "mean_coverage": round(float(np.mean(last.drop_masks)), 6),
    }


def _round(one: Round) -> Mapping[str, Any]:
    numbers: dict[str, Any] = {
        "coverage": round(float(np.mean(one.drop_masks)), 6),
        "changed": round(one.changed, 6),
        "glass": describe(one.found),
        "window": one.window,
        "lens_agreement": _rounded(one.found.lens_agreement, 4),
        "pane_agreement": _rounded(one.found.pane_agreement, 4),
    }
    if one.redrawn is not None:
        for name in ("contrast", "level", "known"):
            numbers[name] = _rounded(getattr(one.redrawn, name), 5)
    return numbers


def _rounded(value: float, places: int) -> float | None:
    """None for what is not known."""
    return round(value, places) if math.isfinite(value) else None
