"""What stages tell of their work in JSON files, as the stages after them read it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.io.atomic import read_json
from pipeline.io.shapes import Shape


@dataclass(frozen=True)
class Lost:
    """A photo without a pose in poses.json."""

    name: str
    reason: str


@dataclass(frozen=True)
class Tried:
    """An attempt at the poses in poses.json."""

    label: str
    registered: int
    chosen: bool = False


@dataclass(frozen=True)
class Round:
    """A round of the loop in refine.json."""

    coverage: float


# Of each file what some stage reads; a name that ends with ? may be absent.
MASKS: Shape = {"mode": str, "why?": str, "threshold?": float}
POSES: Shape = {
    "registered?": list[str],
    "lost?": list[Lost],
    "tried?": list[Tried],
    "points?": int,
    "reprojection_px?": float,
    "aligned?": bool,
}
REFINE: Shape = {"why?": str, "rounds?": dict[int, Round]}
SEEN: Shape = dict[str, dict[str, float]]

_SCORES = (
    "psnr", "ssim", "flip", "lpips", "kept_psnr", "covered_psnr", "coverage", "true_coverage", "iou",
    "precision", "recall", "rotation_deg", "rotation_deg_max", "translation", "translation_max", "extent",
)  # fmt: skip
_GROUP: Shape = {
    **{f"{name}?": float | None for name in _SCORES},
    **{f"{name}_reason?": str for name in _SCORES},
}
METRICS: Shape = {
    **{
        f"{group}?": _GROUP
        for group in (
            "test",
            "covered",
            "kept",
            "fitted",
            "composite",
            "input",
            "masks",
            "selfcheck",
        )
    },
    "poses": {**_GROUP, "registered": int, "total": int, "unit?": str},
    "rounds?": dict[int, dict[str, float]],
    "conventions": {"mask_threshold": float},
}


def read_metrics(path: Path) -> dict[str, Any]:
    """The numbers of a fit, nested by the dots of their names; UserError when they are none."""
    return read_json(path, "evaluate", METRICS)


def read_if_there(path: Path, made_by: str, shape: Shape) -> dict[str, Any]:
    """What a stage tells in a JSON file, empty when there is none; UserError when it is damaged."""
    return read_json(path, made_by, shape) if path.is_file() else {}
