"""Estimated cameras against the true ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.evaluation.summary import put
from pipeline.geometry.poses import pose_errors
from pipeline.io.atomic import read_json
from pipeline.io.scene import ImageRecord, image_name

# Turning an image a quarter counter-clockwise turns the camera's axes with it: x' = y, y' = -x.
_QUARTER = np.eye(4)
_QUARTER[:2, :2] = [[0.0, 1.0], [-1.0, 0.0]]


def read_true_cameras(
    path: Path, records: Sequence[ImageRecord]
) -> tuple[dict[str, np.ndarray], str] | None:
    """The true `cam_from_world` (4, 4) by image name, turned as the images were, and the unit.

    None when the file does not exist; UserError when it is damaged. Images it does not know are
    left out.
    """
    if not path.is_file():
        return None
    content = read_json(path)
    try:
        frames = {
            _key(stem): np.asarray(frame["cam_from_world"], np.float64).reshape(4, 4)
            for stem, frame in content["frames"].items()
        }
        if odd := [stem for stem, pose in frames.items() if not np.isfinite(pose).all()]:
            raise ValueError(f"{odd[0]} has a pose that is not finite")
        unit = str(content.get("unit", "units of the true cameras"))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UserError(
            f"{path} is not a list of true cameras ({error!r}).", "Restore the file."
        ) from None
    cameras = {
        record.name: np.linalg.matrix_power(_QUARTER, record.turned // 90 % 4) @ frames[key]
        for record in records
        if (key := _key(record.stem)) in frames
    }
    return cameras, unit


def _key(stem: str) -> str:
    """By which a photo's camera and its image find each other."""
    return image_name(Path(f"{stem}.png"))


def pose_numbers(
    estimated: Mapping[str, np.ndarray],
    true: tuple[Mapping[str, np.ndarray], str] | None,
    total: int,
    reason: str,
) -> dict[str, Any]:
    """The group `poses`: registered and total images, mean and largest error after alignment.

    estimated: `cam_from_world` by image name. true: the same and the unit of their world, or None
    for the given `reason`. Rotations in degrees; `translation` is the distance of the centres.
    """
    numbers: dict[str, Any] = {"poses": {"registered": len(estimated), "total": total}}
    values: dict[str, float] = {}
    if true is not None:
        try:
            errors = pose_errors(estimated, true[0])
        except ValueError as error:
            reason = f"the poses cannot be aligned with the true ones: {error}"
        else:
            turns, shifts = list(errors.rotation_deg.values()), list(errors.centre.values())
            values = {
                "rotation_deg": float(np.mean(turns)),
                "rotation_deg_max": float(np.max(turns)),
                "translation": float(np.mean(shifts)),
                "translation_max": float(np.max(shifts)),
                "extent": errors.extent,
            }
            numbers["poses"]["unit"] = true[1]
    for name in ("rotation_deg", "rotation_deg_max", "translation", "translation_max", "extent"):
        put(numbers, f"poses.{name}", values.get(name), reason)
    return numbers["poses"]
