"""What stages tell of their work in JSON files, as the stages after them read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

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
    "judged?": {"held_out": list[str], "views": list[str]},
    "rounds?": dict[int, dict[str, float]],
    "conventions": {"mask_threshold": float},
}


class Unlike(NamedTuple):
    """Numbers, by dotted names, that two fits' `why` (they differ) makes means over other `what`."""

    names: tuple[str, ...]
    why: str
    what: str


# By the number or list that tells whether fits are alike in it.
_UNLIKE = {
    "judged.views": Unlike(
        ("test.psnr", "test.ssim", "test.lpips", "test.flip", "covered.psnr", "kept.psnr",
         "selfcheck.kept_psnr"),
        "held-out views", "views",
    ),
    "masks.coverage": Unlike(
        ("covered.psnr", "kept.psnr", "selfcheck.kept_psnr", "composite.covered_psnr", "input.covered_psnr"),
        "masks", "pixels",
    ),
    "input.psnr": Unlike(
        ("composite.psnr", "composite.ssim", "composite.covered_psnr", "input.psnr", "input.ssim",
         "input.covered_psnr"),
        "photos", "photos",
    ),
}  # fmt: skip


def look_up(metrics: Mapping[str, Any], name: str) -> Any:
    """What stands at a dotted name, a number as a rule, or None."""
    group, leaf = name.split(".")
    return metrics.get(group, {}).get(leaf)


def unlike(fits: Sequence[Mapping[str, Any]]) -> list[Unlike]:
    """What of several fits' numbers cannot be compared, each judged on pixels, photos or views of its own."""
    found = []
    for ruler, those in _UNLIKE.items():
        known = [look_up(fit, ruler) for fit in fits]
        first, *others = [one for one in known if one is not None] or [None]
        if any(one != first for one in others):
            found.append(those)
    return found


def judged(metrics: Mapping[str, Any]) -> str:
    """ " (2 of 3)" where not all held-out views were judged, for want of a pose or of a rendering; else ""."""
    views = metrics.get("judged", {"views": [], "held_out": []})
    here, all_of_them = len(views["views"]), len(views["held_out"])
    return f" ({here} of {all_of_them})" if here < all_of_them else ""


def read_metrics(path: Path) -> dict[str, Any]:
    """The numbers of a fit, nested by the dots of their names; UserError when they are none."""
    return read_json(path, "evaluate", METRICS)


def read_if_there(path: Path, made_by: str, shape: Shape) -> dict[str, Any]:
    """What a stage tells in a JSON file, empty when there is none; UserError when it is damaged."""
    return read_json(path, made_by, shape) if path.is_file() else {}
