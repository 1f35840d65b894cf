"""A wet pane that stays in the scene while the camera moves, painted onto each posed photo.

The same height field as on the lens, seen by any pinhole camera: every pixel's ray meets the pane
where the camera's homography says, is bent there by the water's slope, and looks from there into the
photo, whose scene is taken to be far away. Lengths in metres, poses `cam_from_pane` (4, 4) with the
pane frame of `shape`: x right, y down, z towards the scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.drops.optics import Environment, Image, blur_diameter_px
from pipeline.drops.painter import composed, lit_layer, photo_light
from pipeline.drops.shape import Drop, extended_height, reach
from pipeline.errors import UserError
from pipeline.geometry.poses import average_pose, invert

Matrix = NDArray[np.float64]
STEEPEST = 0.15  # least cosine between a photo's rays and the pane's normal
NEAREST_M = 0.02  # least distance of a camera from the pane
_CIRCLE = np.linspace(0, 2 * np.pi, 16, endpoint=False)


@dataclass(frozen=True)
class Shot:
    """A photo's camera: cam_from_world (4, 4) in metres, K (3, 3) in pixels, size (width, height)."""

    cam_from_world: Matrix
    k: Matrix
    size: tuple[int, int]


@dataclass(frozen=True)
class Pane:
    """Where a pane stands, world_from_pane (4, 4), and the half width and height that is seen of it."""

    world_from_pane: Matrix
    half: tuple[float, float]


def pixel_from_pane(k: Matrix, cam_from_pane: Matrix) -> Matrix:
    """Homography (3, 3) from pane metres (x, y, 1) to pixels."""
    return k @ cam_from_pane[:3][:, [0, 1, 3]]


def depth_on_axis(cam_from_pane: Matrix) -> float:
    """Depth, along the optical axis, at which the axis meets the pane."""
    normal, origin = cam_from_pane[:3, 2], cam_from_pane[:3, 3]
    return float(normal @ origin / normal[2])


def pane_before(shots: Mapping[str, Shot], distance: float, margin: float = 0.0) -> Pane:
    """The pane `distance` before the mean camera, square to it, as large as what the photos see.

    Its origin is the middle of that part, grown by `margin` on all sides. UserError naming a photo
    whose camera stands at the pane or behind it, or looks along it.
    """
    mean_from_world = average_pose([shot.cam_from_world for shot in shots.values()])
    world_from_pane = invert(mean_from_world)
    world_from_pane[:3, 3] += distance * world_from_pane[:3, 2]
    seen = np.concatenate(
        [_corners(name, shot, world_from_pane, distance) for name, shot in shots.items()]
    )
    low, high = seen.min(axis=0), seen.max(axis=0)
    world_from_pane[:3, 3] += world_from_pane[:3, :2] @ ((low + high) / 2)
    half = (high - low) / 2 + margin
    return Pane(world_from_pane, (float(half[0]), float(half[1])))


def _corners(name: str, shot: Shot, world_from_pane: Matrix, distance: float) -> Matrix:
    """Pane points (4, 2) at which the rays through the photo's corners arrive."""
    pane_from_cam = invert(shot.cam_from_world @ world_from_pane)
    before = -pane_from_cam[2, 3]
    if before < NEAREST_M:
        raise UserError(
            f"{name} was taken {abs(before):.2f} m {'before' if before > 0 else 'behind'} the pane, "
            f"which stands {distance:g} m before the mean camera.",
            "Set synthesize.pane_m larger, or synthesize.paint_pane: lens.",
        )
    width, height = shot.size
    pixels = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]])
    rays = pixels @ np.linalg.inv(shot.k).T @ pane_from_cam[:3, :3].T
    if (rays[:, 2] < STEEPEST * np.linalg.norm(rays, axis=1)).any():
        raise UserError(
            f"{name} looks along the pane or away from it.",
            "A pane in the scene needs photos that look one way; or set synthesize.paint_pane: lens.",
        )
    points: Matrix = pane_from_cam[:2, 3] + rays[:, :2] * (before / rays[:, 2:])
    return points


def paint_pane(
    image: Image,
    drops: list[Drop],
    cam_from_pane: Matrix,
    k: Matrix,
    *,
    aperture_radius: float = 0.0,
    focus_distance: float = np.inf,
    highlight: float = 2.0,
    sky_gain: float = 1.5,
    rim_light: float = 0.4,
    supersample: int = 2,
) -> tuple[Image, NDArray[np.float32]]:
    """The photo as seen through the drops on a pane, and how much of each pixel the water covers.

    image: (H, W, 3) float32 sRGB in [0, 1] of a pinhole camera with K = `k`. Everything else as in
    `painter.paint`, which this equals for a pane that is parallel to the sensor. The pane is
    defocused as where the optical axis meets it.
    """
    height, width = image.shape[:2]
    if not drops:
        return image.copy(), np.zeros((height, width), np.float32)
    focal = float(np.sqrt(k[0, 0] * k[1, 1]))
    light, around = photo_light(
        image, focal, highlight=highlight, sky_gain=sky_gain, centre=(k[0, 2], k[1, 2])
    )
    layer = pane_layer(
        (height, width),
        drops,
        replace(around, turn=cam_from_pane[:3, :3]),
        cam_from_pane,
        k,
        blur_px=blur_diameter_px(
            focal, aperture_radius, depth_on_axis(cam_from_pane), focus_distance
        ),
        rim_light=rim_light,
        supersample=supersample,
    )
    return composed(image, light, layer)


def pane_layer(
    size: tuple[int, int],
    drops: list[Drop],
    environment: Environment,
    cam_from_pane: Matrix,
    k: Matrix,
    *,
    blur_px: float = 0.0,
    rim_light: float = 0.4,
    supersample: int = 2,
) -> Image:
    """Premultiplied linear RGB and alpha (H, W, 4) of the drops alone, defocused.

    size: (H, W) of the photo; blur_px: diameter of the disc of confusion. The environment takes
    directions of the pane's frame.
    """
    pad = int(np.ceil(blur_px / 2)) + 2
    shape = ((size[0] + 2 * pad) * supersample, (size[1] + 2 * pad) * supersample)
    to_raster = np.array(
        [[supersample, 0, supersample * pad], [0, supersample, supersample * pad], [0, 0, 1.0]]
    )
    fine = to_raster @ k
    slope, covered = seen_slopes(shape, drops, pixel_from_pane(fine, cam_from_pane))
    at = np.nonzero(covered)
    pixels = np.stack([at[1] + 0.5, at[0] + 0.5, np.ones(len(at[0]))], axis=1)
    ray = pixels @ (cam_from_pane[:3, :3].T @ np.linalg.inv(fine)).T
    ray = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32)
    return lit_layer(
        covered, slope, ray, environment, pad=pad, blur_px=blur_px, rim_light=rim_light, supersample=supersample
    )  # fmt: skip


def seen_slopes(
    shape: tuple[int, int], drops: list[Drop], raster_from_pane: Matrix
) -> tuple[Image, NDArray[np.bool_]]:
    """Slope (H, W, 2) of the water over the pane, where a raster's pixels see it, and where they do.

    raster_from_pane (3, 3): homography from pane metres to raster pixels, whose centres are at 0.5.
    """
    slope = np.zeros((*shape, 2), np.float32)
    covered = np.zeros(shape, np.bool_)
    pane_from_raster = np.asarray(np.linalg.inv(raster_from_pane), np.float64)
    for drop in drops:
        window = _window(drop, raster_from_pane, shape)
        if window is None:
            continue
        x, y, jacobian = _on_pane(pane_from_raster, window)
        level = extended_height(drop, x, y)
        inside = level > 0
        if not inside.any():
            continue
        down, across = np.gradient(level)
        (x_u, x_v), (y_u, y_v) = jacobian
        det = x_u * y_v - x_v * y_u
        steep = np.stack(
            [(across * y_v - down * y_u) / det, (down * x_u - across * x_v) / det], axis=-1
        )
        covered[window] |= inside
        slope[window][inside] = steep[inside]
    return slope, covered


def _window(
    drop: Drop, raster_from_pane: Matrix, shape: tuple[int, int]
) -> tuple[slice, slice] | None:
    """Rows and columns of the raster that the drop can touch; None where there are none."""
    around = reach(drop) / np.cos(np.pi / 16) * np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], axis=1)
    corners = np.column_stack([around + drop.center, np.ones(16)]) @ raster_from_pane.T
    if (corners[:, 2] <= 0).any():  # reaches behind the camera: beyond what the photos see
        return None
    place = corners[:, :2] / corners[:, 2:]
    low = np.maximum(np.floor(place.min(axis=0) - 2), 0)
    high = np.minimum(np.ceil(place.max(axis=0) + 2), shape[::-1])
    if (high - low < 2).any():
        return None
    (left, top), (right, bottom) = low.astype(int), high.astype(int)
    return slice(top, bottom), slice(left, right)


def _on_pane(
    pane_from_raster: Matrix, window: tuple[slice, slice]
) -> tuple[Matrix, Matrix, tuple[tuple[Matrix, Matrix], tuple[Matrix, Matrix]]]:
    """Pane points x, y (h, w) that the window's pixels see, and their derivatives by u and v."""
    rows, columns = window
    u = np.arange(columns.start, columns.stop)[None, :] + 0.5
    v = np.arange(rows.start, rows.stop)[:, None] + 0.5
    g = pane_from_raster
    x, y, w = (row[0] * u + row[1] * v + row[2] for row in g)
    x, y = x / w, y / w
    by_u = ((g[0, 0] - x * g[2, 0]) / w, (g[0, 1] - x * g[2, 1]) / w)
    by_v = ((g[1, 0] - y * g[2, 0]) / w, (g[1, 1] - y * g[2, 1]) / w)
    return x, y, (by_u, by_v)
