"""From pycolmap's model to views, depths and points; and to COLMAP's text files."""

from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, see the package
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.geometry.cameras import field_of_view_deg
from pipeline.geometry.poses import as_4x4
from pipeline.io.transforms import View

WIDEST_DEG = 170.0
NARROWEST_DEG = 2.0
MOST_BENT = 0.6  # |k1| r^2 in the corner; the widest lenses of action cameras reach about 0.4
SMALLEST_MODEL = 3  # pycolmap's mappers place two photos nowhere
FEWEST_POINTS = 15  # seen by an image, at the median; placing one takes as many
DEPTH_PERCENTILES = (1.0, 99.0)
SURE_VIEWS = 3  # a wrong match of two photos makes a point at any depth; a third photo rules it out


def largest(models: Iterable[pycolmap.Reconstruction]) -> pycolmap.Reconstruction:
    """The model with the most registered images, then the most points; the first of equals."""
    return max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))


def usable(model: pycolmap.Reconstruction) -> bool:
    """Whether a model says anything: enough images and of what they see, through a possible lens.

    A few photos of drops on the lens agree on scenes that no lens shows: two photos, k1 in the tens. The
    global mapper places photos taken by turning on the spot, with next to no points.
    """
    if model.num_reg_images() < SMALLEST_MODEL:
        return False
    seen = [image.num_points3D for image in model.images.values() if image.has_pose]
    if np.median(seen) < FEWEST_POINTS:
        return False
    for camera in model.cameras.values():
        focal, cx, cy, k1 = camera.params
        if focal <= 0 or abs(k1) * ((cx / focal) ** 2 + (cy / focal) ** 2) > MOST_BENT:
            return False
    return True


def registered_names(model: pycolmap.Reconstruction) -> list[str]:
    """Names of the images that have a pose, sorted."""
    return sorted(image.name for image in model.images.values() if image.has_pose)


def views_of(model: pycolmap.Reconstruction, margin: float) -> dict[str, View]:
    """The registered images as views, sorted by name.

    `near` and `far` are the 1st and 99th percentile of the depths of the points that the image and
    two others observe, widened by the share `margin`; of all points where an image has none.
    """
    views = {}
    everything = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        pose = as_4x4(image.cam_from_world().matrix())
        near, far = _depth_range(model, image, pose, everything, margin) or (0.0, 0.0)
        camera = image.camera
        focal, cx, cy, k1 = (float(value) for value in camera.params)
        views[image.name] = View(
            name=image.name,
            cam_from_world=pose,
            fx=focal,
            fy=focal,
            cx=cx,
            cy=cy,
            k1=k1,
            width=int(camera.width),
            height=int(camera.height),
            near=near,
            far=far,
        )
    return views


def _depth_range(
    model: pycolmap.Reconstruction,
    image: pycolmap.Image,
    pose: np.ndarray,
    everything: np.ndarray,
    margin: float,
) -> tuple[float, float] | None:
    seen = [model.points3D[p.point3D_id] for p in image.get_observation_points2D()]
    sure = [point.xyz for point in seen if len(point.track.elements) >= SURE_VIEWS]
    for points in (np.array(sure).reshape(-1, 3), everything):
        depth = points @ pose[2, :3] + pose[2, 3]
        depth = depth[depth > 0]
        if len(depth):
            low, high = np.percentile(depth, DEPTH_PERCENTILES)
            return float(low * (1.0 - margin)), float(high * (1.0 + margin))
    return None


def with_depths(
    views: Mapping[str, View], model: pycolmap.Reconstruction, margin: float
) -> dict[str, View]:
    """The views, sorted by name, with depths of the points that their images see where they know none."""
    everything = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    images = {image.name: image for image in model.images.values()}
    found = dict(sorted(views.items()))
    for name, view in found.items():
        if 0 < view.near < view.far or name not in images:
            continue
        bounds = _depth_range(model, images[name], view.cam_from_world, everything, margin)
        if bounds is not None:
            found[name] = replace(view, near=bounds[0], far=bounds[1])
    return found


def implausible(views: dict[str, View]) -> str | None:
    """What cannot be true of these views, as half a sentence; None when nothing is found."""
    for view in views.values():
        numbers = [*view.cam_from_world.ravel(), view.fx, view.k1, view.near, view.far]
        if not np.isfinite(numbers).all():
            return f"{view.name} has a pose or a camera that is not a number"
        if view.far <= 0:
            return f"all points lie behind {view.name}"
        angle = field_of_view_deg(view.fx, max(view.width, view.height)) if view.fx > 0 else 180.0
        if not NARROWEST_DEG <= angle <= WIDEST_DEG:
            return f"{view.name} would see an angle of {angle:.0f} degrees"
    centres = np.array([np.linalg.inv(view.cam_from_world)[:3, 3] for view in views.values()])
    nearest = min(view.near for view in views.values())
    if np.linalg.norm(centres - centres.mean(axis=0), axis=1).max() < 1e-4 * nearest:
        return "all photos would have been taken from one point"
    return None


def points_of(model: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) float64, colours (N, 3) uint8 and errors in pixels (N,), by point id."""
    points = [model.points3D[key] for key in sorted(model.points3D)]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    error = np.array([point.error for point in points], dtype=np.float64)
    return xyz, rgb, error


def write_sparse(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Writes cameras.txt, images.txt, points3D.txt, rigs.txt and frames.txt into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write_text(str(folder))
