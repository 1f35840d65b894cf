"""Posed views as nerfstudio's transforms.json: the one door where camera conventions change.

Inside the project `cam_from_world` maps to OpenCV axes (x right, y down, z forward). The file holds
`transform_matrix`, the inverse with OpenGL axes (x right, y up, z backward), as nerfstudio reads it.

Fits count in 32 bits, which know a place 5,000,000 units from the origin to half a unit. Poses in
coordinates of the whole earth (UTM) are therefore moved to an origin in their midst (`near_origin`);
the file says as `world_origin` where that lies, and `View.as_given` moves back.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.io.atomic import read_json, write_json

GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
Place = tuple[float, float, float]
ORIGIN: Place = (0.0, 0.0, 0.0)
# -k1 r^2 in the picture up to which a ray leads there: that of `pipeline.geometry.rays`, which reads no files.
MOST_FOLDED = 0.145
FAR_OFF = 1e4  # units from the origin up to which poses stay: 32 bits know these to a thousandth


@dataclass(frozen=True)
class View:
    """One posed image: a pinhole with one radial term.

    `cam_from_world` is (4, 4) float64, OpenCV axes. `fx, fy, cx, cy` are in pixels with pixel (0, 0)'s
    centre at (0.5, 0.5). A point at normalised radius r lands at r (1 + k1 r^2). `near` and `far` bound
    the depths of its sparse points, in world units. `origin` is where the world's origin lies in the
    coordinates that the capture came with.
    """

    name: str
    cam_from_world: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    width: int
    height: int
    near: float
    far: float
    origin: Place = ORIGIN

    @property
    def world_from_cam(self) -> np.ndarray:
        """(4, 4) inverse of `cam_from_world`."""
        return np.linalg.inv(self.cam_from_world)

    def without_ray(self) -> np.ndarray:
        """Which pixels (H, W) no ray leads to: those beyond where a lens with k1 < 0 folds back."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        return np.asarray(-self.k1 * (x[None, :] ** 2 + y[:, None] ** 2) > MOST_FOLDED)

    @property
    def intrinsics(self) -> tuple[float, float, float, float, float]:
        """fx, fy, cx, cy, k1."""
        return self.fx, self.fy, self.cx, self.cy, self.k1

    @property
    def as_given(self) -> View:
        """The same view in the coordinates that the capture came with."""
        if self.origin == ORIGIN:
            return self
        return replace(_shifted(self, self.origin), origin=ORIGIN)


def near_origin(views: Sequence[View]) -> list[View]:
    """The views as they are, or of cameras far from the origin in a world that begins in their midst.

    The new origin has whole coordinates. Its distance from the old one decides (FAR_OFF).
    """
    middle = np.round(np.median([view.world_from_cam[:3, 3] for view in views], axis=0))
    if np.linalg.norm(middle) <= FAR_OFF:
        return list(views)
    x, y, z = middle.tolist()
    return [replace(_shifted(view, (-x, -y, -z)), origin=(x, y, z)) for view in views]


def _shifted(view: View, by: Place) -> View:
    """The view with its world's points moved, its camera with them."""
    pose = view.cam_from_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ by
    return replace(view, cam_from_world=pose)


_NUMBERS = {
    "fl_x": "fx",
    "fl_y": "fy",
    "cx": "cx",
    "cy": "cy",
    "k1": "k1",
    "near": "near",
    "far": "far",
}


def write_transforms(
    path: Path,
    views: Iterable[View],
    extras: Mapping[str, Any] | None = None,
    beside: str = "../",
) -> None:
    """Writes transforms.json with intrinsics, image and mask path per frame.

    `beside` leads from the file's folder to the one that holds `images/` and `masks/`. The views have
    one world.
    """
    ordered = sorted(views, key=lambda view: view.name)
    head: dict[str, Any] = {"camera_model": "OPENCV", **(extras or {})}
    if ordered and ordered[0].origin != ORIGIN:
        head["world_origin"] = list(ordered[0].origin)
    write_json(path, {**head, "frames": [_frame(view, beside) for view in ordered]})


def _frame(view: View, beside: str) -> dict[str, Any]:
    numbers = {key: round(float(getattr(view, field)), 10) for key, field in _NUMBERS.items()}
    return numbers | {
        "file_path": f"{beside}images/{view.name}",
        "mask_path": f"{beside}masks/{view.name}",
        "w": view.width,
        "h": view.height,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "transform_matrix": np.round(view.world_from_cam @ GL_FROM_CV, 12).tolist(),
    }


def read_transforms(path: Path) -> dict[str, View]:
    """The posed views by image name; UserError when missing, damaged or not rigid."""
    content = read_json(path, made_by="poses")
    try:
        frames = content["frames"]
        x, y, z = (float(value) for value in content.get("world_origin", ORIGIN))
        views = [_view(frame, (x, y, z)) for frame in frames]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"{path} is not a list of posed views ({error!r}).",
            "Run `python -m stages.poses` again.",
        ) from None
    seen: set[str] = set()
    for view in views:
        problem = "two poses" if view.name in seen else _problem(view)
        seen.add(view.name)
        if problem:
            raise UserError(
                f"{path}: {view.name} has {problem}.", "Run `python -m stages.poses` again."
            )
    return {view.name: view for view in views}


def _problem(view: View) -> str:
    """What is wrong with a view, or nothing."""
    numbers = [getattr(view, field) for field in _NUMBERS.values()]
    if not np.isfinite([*numbers, *view.origin, *view.cam_from_world.ravel()]).all():
        return "numbers that are not finite"
    rotation = view.cam_from_world[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        return "a pose that is not a rotation and a translation"
    if min(view.fx, view.fy, view.width, view.height) <= 0:
        return "a focal length or size that is not positive"
    return ""


def _view(frame: Mapping[str, Any], origin: Place) -> View:
    world_from_gl = np.asarray(frame["transform_matrix"], np.float64).reshape(4, 4)
    numbers = {field: float(frame[key]) for key, field in _NUMBERS.items()}
    return View(
        name=Path(frame["file_path"]).name,
        cam_from_world=np.linalg.inv(world_from_gl @ GL_FROM_CV),
        width=int(frame["w"]),
        height=int(frame["h"]),
        origin=origin,
        **numbers,
    )
