"""The drawings of the page, from a scene's files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from pipeline.io.paths import ScenePaths
from pipeline.io.scene import ImageRecord
from pipeline.io.transforms import read_transforms
from pipeline.report.charts import bars, camera_map, curves
from pipeline.report.gather import fit_curves, image_numbers

WIDE = (560, 240)
MAP = (560, 360)


def charts(
    paths: ScenePaths, other: ScenePaths | None, records: Sequence[ImageRecord]
) -> dict[str, Markup]:
    """The drawings of the page by name, empty where there is nothing to draw.

    other: the paths of the fit to compare with, or None.
    """
    fits = {"with masks": paths} | ({str(other.variant): other} if other else {})
    courses = {label: fit_curves(fit.nerf / "fit.csv") for label, fit in fits.items()}
    tables = {label: image_numbers(fit.metrics_csv) for label, fit in fits.items()}

    def course(column: str) -> dict[str, Any]:
        return {label: found[column] for label, found in courses.items() if column in found}

    def pick(table: dict[str, Any], name: str) -> dict[str, float]:
        return {image: row[name] for image, row in table.items() if name in row}

    held_out = {label: pick(table, "test.psnr") for label, table in tables.items()}
    rows = tables["with masks"]
    cleaned = {"as taken": pick(rows, "input.psnr"), "cleaned": pick(rows, "composite.psnr")}
    shares = {"dropped": {image: 100 * v for image, v in pick(rows, "masks.coverage").items()}}
    transforms = paths.poses / "transforms.json"
    posed = read_transforms(transforms) if transforms.is_file() else {}
    poses = {name: view.cam_from_world for name, view in posed.items()}
    test = {record.name for record in records if record.split == "test"}
    return {
        "psnr": curves(course("psnr"), title="Training PSNR", unit="dB", size=WIDE),
        "views": bars(held_out, title="Held-out PSNR", unit="dB", size=WIDE),
        "cleaned": bars(cleaned, title="PSNR of photos", unit="dB", size=WIDE),
        "coverage": bars(shares, title="Coverage", unit="%", size=WIDE),
        "cameras": camera_map(poses, test, size=MAP),
        "cameras_side": camera_map(poses, test, size=MAP, side=True),
    }  # fmt: skip
