"""The numbers of a scene out of those of its images: nested, rounded, and never invented."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.evaluation import flip, lpips
from pipeline.evaluation.image import WINDOW_RADIUS
from pipeline.evaluation.masks import MaskCounts, mask_scores
from pipeline.io.accounts import judged

Rows = Mapping[str, Mapping[str, float]]

DIGITS = 6
# What is averaged over images, and which reasons can stand against it, the strongest first.
_AVERAGES: dict[str, tuple[str, ...]] = {
    "test.psnr": ("clean", "test"),
    "test.ssim": ("clean", "test", "window"),
    "test.flip": ("clean", "test", "flip"),
    "test.lpips": ("clean", "test", "lpips", "pools"),
    "covered.psnr": ("clean", "test", "covered"),
    "kept.psnr": ("clean", "test", "kept"),
    "fitted.psnr": ("clean", "fitted"),
    "fitted.ssim": ("clean", "fitted", "window"),
    "fitted.flip": ("clean", "fitted", "flip"),
    "fitted.covered_psnr": ("clean", "fitted", "covered"),
    "composite.psnr": ("clean", "composite"),
    "composite.ssim": ("clean", "composite", "window"),
    "composite.flip": ("clean", "composite", "flip"),
    "composite.covered_psnr": ("clean", "composite", "covered"),
    "input.psnr": ("clean", "composite"),
    "input.ssim": ("clean", "composite", "window"),
    "input.flip": ("clean", "composite", "flip"),
    "input.covered_psnr": ("clean", "composite", "covered"),
    "masks.coverage": (),
    "masks.true_coverage": ("coverage",),
    "selfcheck.kept_psnr": ("test", "kept"),
}
_TOO_FEW = {
    "covered": "the masks cover no pixel of these views",
    "kept": "the masks cover every pixel of these views",
    "window": f"SSIM needs more than {2 * WINDOW_RADIUS} pixels each way",
    "pools": f"LPIPS needs {lpips.SMALLEST_SIDE} pixels each way",
}
COLUMNS = ("split", *_AVERAGES, "masks.hits", "masks.false_alarms", "masks.misses")


def summarise(rows: Rows, reasons: Mapping[str, str]) -> dict[str, Any]:
    """The numbers of a scene, nested by the dots of their names, floats rounded to 6 digits.

    rows: the numbers of every image, see `score_image`. reasons: why something is missing, for any
    of "clean", "coverage", "lpips", "flip", "test", "fitted", "composite". A number that cannot be had is
    None with `<name>_reason` beside it. PSNR and the like are means over images; mask scores pool
    the pixels of all images.
    """
    numbers: dict[str, Any] = {}
    known = {**_TOO_FEW, **reasons}
    for name, needs in _AVERAGES.items():
        values = [row[name] for row in rows.values() if name in row]
        why = next((known[need] for need in needs if need in known), None)
        put(numbers, name, *(average(values) if values else (None, why)))
    _put_mask_scores(numbers, rows, reasons)
    return numbers


def average(values: Sequence[float]) -> tuple[float | None, str | None]:
    """The mean of the finite values and None, or None and the reason.

    A view identical to its reference has no finite PSNR. Leaving it out would turn the best view
    into a loss, so the mean is then not given.
    """
    infinite = sum(math.isinf(value) for value in values)
    if infinite:
        return None, f"{infinite} of {len(values)} images are identical to their references"
    return sum(values) / len(values), None


def conventions(coverage_threshold: float) -> dict[str, Any]:
    """How the numbers are meant; a pixel is truly covered when its coverage is above the threshold."""
    return {
        "data_range": 1.0,
        "flip": f"LDR, {flip.PIXELS_PER_DEGREE} pixels per degree, mean over pixels and images",
        "lpips_net": lpips.NET,
        "mask_threshold": coverage_threshold,
        "psnr": "mean over images of the PSNR of the selected pixels, RGB",
        "ssim": "Gaussian window, sigma 1.5, 11 pixels, RGB, mean over windows wholly inside the picture",
    }


def headline(metrics: Mapping[str, Any]) -> str:
    """The numbers of a scene in one sentence."""
    poses, masks = metrics["poses"], metrics["masks"]
    found = f"{poses['registered']} of {poses['total']} images registered"
    if metrics["test"]["psnr"] is None:
        reason = metrics["test"]["psnr_reason"]
        kept = metrics["selfcheck"]["kept_psnr"]
        agreement = "" if kept is None else f"; {kept:.2f} dB against the photos outside the drops"
        return f"{found}{agreement}; no PSNR of clean views: {reason}"
    iou = "" if masks["iou"] is None else f", mask IoU {masks['iou']:.3f}"
    test = metrics["test"]
    alike = "" if test["ssim"] is None else f", SSIM {test['ssim']:.3f}"
    view = f"held-out views{judged(metrics)} {test['psnr']:.2f} dB{alike}"
    return f"{view}{iou}, {found}"


def put(numbers: dict[str, Any], name: str, value: float | None, reason: str | None) -> None:
    """Sets `numbers` at the dotted `name`: the rounded value, or None and `<name>_reason`."""
    group, leaf = name.split(".")
    place = numbers.setdefault(group, {})
    if value is None or not math.isfinite(value):
        place[leaf] = None
        place[f"{leaf}_reason"] = reason or "no image has this number"
    else:
        place[leaf] = round(float(value), DIGITS)


def as_csv(rows: Mapping[str, Mapping[str, float | str]]) -> str:
    """One line per image in the order of `rows`, one column per number; empty if missing."""
    text = io.StringIO()
    writer = csv.DictWriter(text, ["image", *COLUMNS], lineterminator="\n")
    writer.writeheader()
    for name, row in rows.items():
        cells = {
            key: round(value, DIGITS) if isinstance(value, float) else value
            for key, value in row.items()
        }
        writer.writerow({"image": name, **cells})
    return text.getvalue()


def _put_mask_scores(numbers: dict[str, Any], rows: Rows, reasons: Mapping[str, str]) -> None:
    fields = [f"masks.{name}" for name in MaskCounts._fields]
    counts = [
        MaskCounts(*(int(row[field]) for field in fields))
        for row in rows.values()
        if fields[0] in row
    ]
    scores = mask_scores(counts)
    empty = "no pixel is covered, in truth or by a mask" if counts else "no true coverage was read"
    for name, score in scores._asdict().items():
        put(numbers, f"masks.{name}", score, reasons.get("coverage", empty))
