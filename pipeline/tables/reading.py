"""The scores of a scene's rows out of the metrics files that `evaluate` wrote."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.io.accounts import judged
from pipeline.tables.rows import Row
from pipeline.tables.statistics import mean

NUMBERS = ("psnr", "ssim", "flip", "lpips")
MASKED = ("unaveraged", "derain", "loop")  # by their ids: the rows whose masks are drawn
MASKS = ("precision", "recall", "iou")


def read_view_scores(path: Path, row: Row) -> dict[str, float]:
    """`view_scores` of a metrics.csv; UserError when it is missing or damaged."""
    try:
        return view_scores(path.read_text(encoding="utf-8"), row)
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise UserError(
            f"{path} is not a table of numbers by image ({error!r}).",
            "Run `python -m stages.evaluate` again.",
        ) from None


def view_scores(text: str, row: Row) -> dict[str, float]:
    """The numbers of a row over the images of its split, from the text of a metrics.csv: means over images.

    A number that any of these images lacks, or that is infinite for one, is left out.
    """
    images = [one for one in csv.DictReader(io.StringIO(text)) if one["split"] == row.split]
    scores = {}
    for number in NUMBERS:
        words = [one.get(f"{row.kind}.{number}") or "nan" for one in images]
        values = [float(word) for word in words]
        if values and all(math.isfinite(value) for value in values):
            scores[number] = mean(values)
    return scores


def why_missing(row: Row, seeds: Sequence[int], on_lens: bool) -> str:
    """Why a row of a scene has no metrics: for some of its `seeds`, or, without any named, for none at all."""
    if row.key == "unaveraged" and not on_lens:
        return "equation 5 is for drops on the lens; without it the masks are those of the next row"
    return "not computed" + (f" for seed {', '.join(map(str, seeds))}" if seeds else "")


def why_unscored(metrics: Mapping[str, Any], row: Row) -> str:
    """Why a row that has metrics is without numbers in the tables: a mean over some images alone is none."""
    poses, reason = metrics["poses"], metrics.get(row.kind, {}).get("psnr_reason")
    if reason:
        return str(reason)
    some = judged(metrics) if row.kind == "test" else ""
    lost = poses["registered"] < poses["total"]
    placed = f"; {poses['registered']} of {poses['total']} photos have a pose" if lost else ""
    return f"not all of its images could be judged{some}{placed}"


def mask_scores(metrics: Mapping[str, Any], row: Row) -> dict[str, float]:
    """Precision, recall and IoU of the masks that a row of its own masks was fitted with, as far as known."""
    return _known(metrics.get("masks", {})) if row.id in MASKED else {}


def gathered_scores(metrics: Mapping[str, Any], row: Row) -> dict[str, float]:
    """The same of the masks gathered on the glass, before the loop's first fit; empty without a loop."""
    return _known(metrics.get("rounds", {}).get("0", {})) if row.id == "loop" else {}


def _known(numbers: Mapping[str, Any]) -> dict[str, float]:
    return {name: float(numbers[name]) for name in MASKS if numbers.get(name) is not None}
