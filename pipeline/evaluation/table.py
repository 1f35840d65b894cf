"""Several fits in one table: `python -m pipeline.evaluation.table METRICS.json ...`."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.io.accounts import look_up, read_metrics, unlike

# Heading, dotted name, format. Higher is better but for LPIPS and FLIP.
COLUMNS = (
    ("test PSNR", "test.psnr", "{:.2f}"),
    ("SSIM", "test.ssim", "{:.3f}"),
    ("LPIPS", "test.lpips", "{:.3f}"),
    ("FLIP", "test.flip", "{:.3f}"),
    ("covered PSNR", "covered.psnr", "{:.2f}"),
    ("kept PSNR", "kept.psnr", "{:.2f}"),
    ("composite PSNR", "composite.psnr", "{:.2f}"),
    ("SSIM", "composite.ssim", "{:.3f}"),
    ("photo PSNR", "input.psnr", "{:.2f}"),
    ("mask IoU", "masks.iou", "{:.3f}"),
    ("PSNR to photos", "selfcheck.kept_psnr", "{:.2f}"),
    ("masked", "masks.coverage", "{:.1%}"),
)
MISSING = "-"
LIKE_THE_ONE_BEFORE = {"composite.ssim": "composite SSIM"}  # headings that say too little alone


def reasons(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Why numbers are missing: the reason by dotted name, in the order of the names."""
    return {
        f"{group}.{leaf.removesuffix('_reason')}": text
        for group, numbers in sorted(metrics.items())
        if isinstance(numbers, Mapping)
        for leaf, text in sorted(numbers.items())
        if leaf.endswith("_reason")
    }


def table(fits: Mapping[str, Mapping[str, Any]]) -> str:
    """An aligned Markdown table, one row per fit by label, then what cannot be compared, and what is missing.

    Columns that no fit has a number for are left out; "PSNR to photos" is that of held-out views to the
    photos beside the drops. Covered and kept are the pixels of each fit's own masks.
    """
    columns = [
        one for one in COLUMNS if any(look_up(fit, one[1]) is not None for fit in fits.values())
    ]
    rows = [["fit", *(heading for heading, _, _ in columns), "poses"]]
    for label, metrics in fits.items():
        rows.append(
            [label, *(_cell(metrics, name, form) for _, name, form in columns), _poses(metrics)]
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [_line(row, widths) for row in rows]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    lines.insert(1, _line(rule, widths))
    return "\n".join([*lines, *_unlike(fits), *_notes(fits)]) + "\n"


def gains(fits: Mapping[str, Mapping[str, Any]]) -> str:
    """How far the first fit is ahead of each other, in dB on held-out views; empty if unknown.

    So it is of fits that were judged on other views.
    """
    (first, metrics), *others = fits.items()
    own, lines = look_up(metrics, "test.psnr"), []
    for label, other in others:
        theirs = look_up(other, "test.psnr")
        same = all("test.psnr" not in those.names for those in unlike([metrics, other]))
        if own is not None and theirs is not None and same:
            lines.append(f"{first} over {label}: {own - theirs:+.2f} dB on held-out views.\n")
    return "".join(lines)


def label_of(path: Path) -> str:
    """The label of a metrics file from its place: `demo`, `demo unmasked`."""
    parts = path.parts[:-1]
    if "artifacts" in parts:
        parts = parts[len(parts) - parts[::-1].index("artifacts") :]
    return " ".join(parts) or path.name


def _cell(metrics: Mapping[str, Any], name: str, form: str) -> str:
    value = look_up(metrics, name)
    return MISSING if value is None else form.format(value)


def _poses(metrics: Mapping[str, Any]) -> str:
    poses = metrics.get("poses", {})
    return f"{poses.get('registered', MISSING)}/{poses.get('total', MISSING)}"


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
    cells[0] = row[0].ljust(widths[0])
    return "| " + " | ".join(cells) + " |"


def _unlike(fits: Mapping[str, Mapping[str, Any]]) -> list[str]:
    told = {name: LIKE_THE_ONE_BEFORE.get(name, heading) for heading, name, _ in COLUMNS}
    lines = []
    for names, why, what in unlike(list(fits.values())):
        known = [
            told[name]
            for name in names
            if name in told and sum(look_up(fit, name) is not None for fit in fits.values()) > 1
        ]
        if known:
            lines.append(
                f"The fits' {why} differ: each is judged on {what} of its own in {', '.join(known)}."
            )
    return lines


def _notes(fits: Mapping[str, Mapping[str, Any]]) -> list[str]:
    notes: dict[str, list[str]] = {}
    for metrics in fits.values():
        why = reasons(metrics)
        for heading, name, _ in COLUMNS:
            told = LIKE_THE_ONE_BEFORE.get(name, heading)
            if name in why and told not in notes.setdefault(why[name], []):
                notes[why[name]].append(told)
    return [f"Not measured, since {text}: {', '.join(told)}." for text, told in notes.items()]


def main(paths: Sequence[str]) -> int:
    """Prints the table of the given metrics files; 2 when one cannot be read."""
    if not paths:
        print("usage: python -m pipeline.evaluation.table METRICS.json ...", file=sys.stderr)
        return 2
    try:
        labels = [label_of(Path(path)) for path in paths]
        if len(set(labels)) < len(labels):  # of two folders of artifacts
            labels = list(paths)
        fits = {label: read_metrics(Path(path)) for label, path in zip(labels, paths, strict=True)}
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    print(table(fits) + gains(fits), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
