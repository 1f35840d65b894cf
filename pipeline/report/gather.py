"""What the page shows, read from a scene's folders; pieces that do not exist are left out."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.io.images import read_image
from pipeline.io.maps import read_depth, read_map
from pipeline.io.masks import read_keep_mask
from pipeline.io.paths import ScenePaths
from pipeline.io.scene import ImageRecord
from pipeline.report.pictures import (
    as_uri,
    attention_heat,
    coloured,
    data_uri,
    depth_colours,
    mask_overlay,
    upright,
)

LARGEST_VIDEO = 4_000_000  # bytes; a larger one stays beside the page


def photo_pictures(
    paths: ScenePaths, record: ImageRecord, width: int, quality: int
) -> dict[str, str]:
    """`data:` addresses of one photo's pictures by kind, upright.

    Kinds: photo, attention, mask, clean (the field's render), composite, depth, reference; those
    that do not exist are left out. UserError when a file is damaged.
    """
    photo = read_image(paths.images / record.name, size=record.size)
    found = {"photo": photo}
    attention = paths.attention / f"{record.stem}.exr"
    if attention.is_file():
        found["attention"] = attention_heat(photo, read_map(attention, size=record.size))
    if (paths.refine / record.name).is_file():
        keep_mask = read_keep_mask(paths.refine / record.name, record.size)
        found["mask"] = mask_overlay(photo, keep_mask)
    for kind, folders in (("clean", ("input", "test")), ("composite", ("composite",))):
        for folder in folders:
            path = paths.views / folder / record.name
            if path.is_file():
                found[kind] = read_image(path, "render", record.size)
                break
    depth = paths.views / "depth" / f"{record.stem}.exr"
    if depth.is_file():
        found["depth"] = depth_colours(read_depth(depth, size=record.size))
    return {
        kind: data_uri(upright(rgb, record.turned), width, quality) for kind, rgb in found.items()
    }


def coverage_heat(
    paths: ScenePaths, records: Sequence[ImageRecord], width: int, quality: int
) -> tuple[str, float]:
    """How often each pixel of the sensor is dropped: a picture's address, and the largest share.

    Images of the most common size are averaged as they lie on disk. ("", 0) without masks.
    """
    sizes = [record.size for record in records]
    common = max(sorted(set(sizes)), key=sizes.count) if sizes else (0, 0)
    masks = [
        ~read_keep_mask(paths.refine / record.name, record.size)
        for record in records
        if record.size == common and (paths.refine / record.name).is_file()
    ]
    if not masks:
        return "", 0.0
    share = np.mean(masks, axis=0)
    largest = float(share.max())
    return data_uri(coloured(share / (largest or 1)), width, quality), largest


def _rows(path: Path, column: str, made_by: str) -> list[dict[str, str]]:
    """The rows of a CSV file by their headings; UserError when it has no such `column`."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file, restval="", restkey=""))
        damaged = any(column not in row or "" in row for row in rows)
    except (csv.Error, UnicodeDecodeError):
        damaged = True
    if damaged:
        raise UserError(
            f"{path} is not a table with a column {column}.",
            f"Run `python -m stages.{made_by}` again.",
        )
    return rows


def fit_curves(path: Path) -> dict[str, list[tuple[float, float]]]:
    """The columns of fit.csv over its first one, by their headings; empty without the file."""
    if not path.is_file():
        return {}
    rows = _rows(path, "step", "nerf")
    if not rows:
        return {}
    first, *others = rows[0]
    return {
        name: [(_number(row[first]), _number(row[name])) for row in rows if row[name]]
        for name in others
    }


def image_numbers(path: Path) -> dict[str, dict[str, float]]:
    """The numbers of metrics.csv by image and dotted name; empty cells are left out."""
    if not path.is_file():
        return {}
    rows = {row.pop("image"): row for row in _rows(path, "image", "evaluate")}
    return {
        image: {
            name: number for name, text in row.items() if math.isfinite(number := _number(text))
        }
        for image, row in rows.items()
    }


def lost_images(account: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and reasons of the images without a pose, as poses.json tells them."""
    return [(str(image["name"]), str(image["reason"])) for image in account.get("lost", [])]


def attempts(account: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and results of the attempts at poses, the one that is used marked; none for a single one."""
    tried = account.get("tried", [])
    if len(tried) < 2:
        return []
    return [
        (
            str(one["label"]),
            f"{one['registered']} photos placed" + (", used" if one.get("chosen") else ""),
        )
        for one in tried
    ]


def video(path: Path) -> tuple[str, str]:
    """(`data:` address of the video, ""), or ("", why there is none)."""
    if not path.is_file():
        return "", "no video was made"
    if path.stat().st_size > LARGEST_VIDEO:
        size = path.stat().st_size / 1e6
        return "", f"the video has {size:.1f} MB and lies beside the views as path.mp4"
    return as_uri(path.read_bytes(), "video/mp4"), ""


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
