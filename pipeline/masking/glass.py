"""Where the glass is: maps carried from the views onto it, and back.

Drops stay on the glass. On a pane that moves with the camera a drop keeps its pixel; on one that stands
in the scene it keeps its place on a plane. Maps of several views are averaged there.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np
import torch

from pipeline.geometry.compiled import compiled
from pipeline.geometry.poses import invert
from pipeline.geometry.rays import FOLDS, pixel_rays
from pipeline.geometry.spaces import mean_camera
from pipeline.masking.agreement import Tally

MAX_CELLS = 1_000_000
BAND = 64  # rows of cells whose quantile over the views is taken at a time
EVERY = slice(None)  # row


class GlassCamera(NamedTuple):
    """A view's pose (4, 4), its fx, fy, cx, cy, k1 and its size in pixels."""

    cam_from_world: np.ndarray
    intrinsics: tuple[float, float, float, float, float]
    width: int
    height: int


class Glass(Protocol):
    """Glass with a raster of cells that every view looks at."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of cells."""

    def from_view(self, view: int, values: np.ndarray, rows: slice = EVERY) -> np.ndarray:
        """A view's (H, W) map on the `rows` of cells, float32; NaN where the view does not see a cell."""

    def to_view(self, view: int, values: np.ndarray) -> np.ndarray:
        """A map of the cells as the view sees it, (H, W) float32; NaN beside the glass."""


class LensGlass:
    """Glass that moves with the camera: each pixel is its own cell."""

    def __init__(self, height: int, width: int) -> None:
        self.shape = (height, width)

    def from_view(self, view: int, values: np.ndarray, rows: slice = EVERY) -> np.ndarray:
        """See :class:`Glass`."""
        return np.asarray(values[rows], np.float32)

    def to_view(self, view: int, values: np.ndarray) -> np.ndarray:
        """See :class:`Glass`."""
        return np.asarray(values, np.float32)


class PaneGlass:
    """A plane in the scene, with the pixels of the mean camera for cells.

    `pane_from_world` (4, 4) is rigid; the plane is z = 0. The raster spans what the views see of it;
    cells grow when it would hold more than `max_cells`. `mean`: another camera (4, 4) than the mean one.
    ValueError when the mean camera or every view looks away from the plane.
    """

    def __init__(
        self,
        pane_from_world: np.ndarray,
        cameras: Sequence[GlassCamera],
        max_cells: int = MAX_CELLS,
        mean: np.ndarray | None = None,
    ) -> None:
        self.cameras = list(cameras)
        if mean is None:
            mean = mean_camera(np.stack([camera.cam_from_world for camera in cameras]))
        self.mean = mean
        mean_from_pane = mean @ invert(pane_from_world)
        normal = mean_from_pane[:3, 2]
        offset = float(normal @ mean_from_pane[:3, 3])
        # Written so that the mean camera's own axis meets the plane at a positive depth.
        self.normal = normal if offset > 0 else -normal
        if abs(offset) < 1e-12 or self.normal[2] <= 0:
            raise ValueError("the mean camera looks away from the plane")
        self.depth = abs(offset)
        self.from_mean = [camera.cam_from_world @ invert(mean) for camera in cameras]
        self.pane_from_world = pane_from_world
        # What to add to each view's translation for the plane's sake, in the world's units and axes: poses
        # good enough for the scene may be centimetres off for a pane close by.
        self.moved = np.zeros((len(self.cameras), 3))
        spots = [
            places[ahead]
            for view, camera in enumerate(self.cameras)
            for places, ahead in [self._on_glass(view, _lattice(*camera[1:]))]
        ]
        seen = np.concatenate(spots)
        if not len(seen):
            raise ValueError("no view looks at the plane")
        # A grazing view's horizon would stretch the raster without end.
        self.low, high = np.quantile(seen, 0.002, axis=0), np.quantile(seen, 0.998, axis=0)
        pixel = 1.0 / float(np.median([camera.intrinsics[0] for camera in cameras]))
        self.low, extent = self.low - pixel, np.maximum(high - self.low, 0) + 2 * pixel
        self.cell = pixel * max(1.0, math.sqrt(float(extent.prod()) / pixel**2 / max_cells))
        columns, rows = np.ceil(extent / self.cell).astype(int)
        self.shape = (int(rows), int(columns))

    def view_from_glass(self, view: int) -> np.ndarray:
        """(3, 3): the homography from the plane, as the mean camera sees it, to the view."""
        pose = self.from_mean[view]
        moved = self.cameras[view].cam_from_world[:3, :3] @ self.moved[view]
        return self.depth * pose[:3, :3] + np.outer(pose[:3, 3] + moved, self.normal)

    def from_view(self, view: int, values: np.ndarray, rows: slice = EVERY) -> np.ndarray:
        """See :class:`Glass`."""
        across, down, matrix, lens = self._way(view)
        x, y = np.empty((2, down[rows].size, across.size), np.float32)
        _places(across, down[rows], matrix, lens, x, y)
        return _sample(values, x, y)

    def tally(self, maps: Sequence[np.ndarray]) -> Tally:
        """What the views' maps say of each cell, a map for each view."""
        tally = Tally(*np.zeros((3, *self.shape)))
        for view, values in enumerate(maps):
            _add_view(*self._way(view), np.ascontiguousarray(values, np.float32), *tally)
        return tally

    def _way(self, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """From the cells to a view's pixels, as `_place` takes it."""
        fx, fy, cx, cy, k1 = self.cameras[view].intrinsics
        across = (self.low[0] + (np.arange(self.shape[1]) + 0.5) * self.cell).astype(np.float32)
        down = (self.low[1] + (np.arange(self.shape[0]) + 0.5) * self.cell).astype(np.float32)
        matrix = np.vstack([self.view_from_glass(view), self.normal]).astype(np.float32)
        lens = np.array([fx, fy, cx - 0.5, cy - 0.5, k1], np.float32)
        return across, down, matrix, lens

    def to_view(self, view: int, values: np.ndarray) -> np.ndarray:
        """See :class:`Glass`."""
        camera = self.cameras[view]
        rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
        spots, ahead = self._on_glass(view, _directions(camera.intrinsics, columns, rows))
        cells = (spots - self.low) / self.cell - 0.5
        cells[~ahead] = -1e6
        x, y = cells.astype(np.float32).T.reshape(2, camera.height, camera.width)
        return _sample(values, x, y)

    def _on_glass(self, view: int, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where a view's rays (3, N) meet the plane, as the mean camera sees it: (N, 2), and which do."""
        spots = np.linalg.inv(self.view_from_glass(view)) @ directions
        with np.errstate(divide="ignore", invalid="ignore"):
            places = (spots[:2] / spots[2]).T
        # Depths in the view and in the mean camera: both in front.
        ahead = (spots[2] > 0) & (self.normal @ spots > 0) & np.isfinite(places).all(axis=1)
        return places, ahead


def pane_before(
    cams: np.ndarray, distance: float, tilt_x_deg: float = 0.0, tilt_y_deg: float = 0.0
) -> np.ndarray:
    """`pane_from_world` (4, 4) of a plane across the mean axis of cameras `cams` (V, 4, 4).

    Parallel to the mean image plane at `distance` in front of the mean camera, then turned about the
    point where the axis meets it: by `tilt_x_deg` about the camera's x axis, and after that by
    `tilt_y_deg` about its y axis.
    """
    a, b = math.radians(tilt_x_deg), math.radians(tilt_y_deg)
    about_x = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    about_y = np.array([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    pane_from_mean = np.eye(4)
    pane_from_mean[:3, :3] = (about_y @ about_x).T
    pane_from_mean[:3, 3] = -pane_from_mean[:3, :3] @ np.array([0.0, 0.0, distance])
    return pane_from_mean @ mean_camera(np.asarray(cams, np.float64))


def neighbours(count: int, middle: int, width: int) -> range:
    """The `width` neighbours in order of view `middle` among `count` views; 0: all of them."""
    if width <= 0 or width >= count:
        return range(count)
    first = min(max(0, middle - width // 2), count - width)
    return range(first, first + width)


def gather(
    glass: Glass, maps: Sequence[np.ndarray | None], views: Sequence[int], quantile: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """The views' maps on the glass: their mean (eq. 5's, per cell) or a quantile, and the votes.

    `maps[view]` (H, W), bool or float, may hold NaN for pixels without a vote; None for a view without a
    map. Out come float32 values, NaN where nobody votes, and the number of votes per cell, int32.
    """
    voting = [(view, values) for view in views if (values := maps[view]) is not None]
    if quantile is not None:
        return _quantile_on(glass, voting, quantile)
    votes, total = np.zeros(glass.shape, np.int32), np.zeros(glass.shape)
    for view, values in voting:
        seen = glass.from_view(view, values)
        known = np.isfinite(seen)
        votes += known
        total += np.where(known, seen, np.float32(0))
    return (total / np.where(votes > 0, votes, np.nan)).astype(np.float32), votes


def _quantile_on(
    glass: Glass, voting: Sequence[tuple[int, np.ndarray]], quantile: float
) -> tuple[np.ndarray, np.ndarray]:
    """The quantile of the views' maps on the glass, and the votes."""
    found, votes = np.full(glass.shape, np.nan, np.float32), np.zeros(glass.shape, np.int32)
    if not voting:
        return found, votes
    # A few rows at a time: the stack of all views may be larger than the photos.
    for row in range(0, glass.shape[0], BAND):
        rows = slice(row, row + BAND)
        stack = np.stack([glass.from_view(view, values, rows) for view, values in voting])
        found[rows] = quantile_over_views(stack, quantile)
        votes[rows] = np.isfinite(stack).sum(axis=0)
    return found, votes


def quantile_over_views(stack: np.ndarray, quantile: float) -> np.ndarray:
    """The quantile along the first axis of (V, ...) without NaN, linear between neighbours."""
    ordered = np.sort(stack, axis=0)  # NaN comes last
    count = np.isfinite(stack).sum(axis=0)
    place = quantile * np.maximum(count - 1, 0)
    lower = np.floor(place).astype(np.int64)
    upper = np.minimum(lower + 1, np.maximum(count - 1, 0))
    low = np.take_along_axis(ordered, lower[None], axis=0)[0]
    high = np.take_along_axis(ordered, upper[None], axis=0)[0]
    return (low + (high - low) * (place - lower)).astype(np.float32)


@functools.lru_cache(maxsize=64)
def _lattice(
    intrinsics: tuple[float, float, float, float, float], width: int, height: int
) -> np.ndarray:
    """Directions (3, N), in the camera's frame, of pixels around the frame and across it."""
    columns, rows = np.meshgrid(np.linspace(0, width - 1, 13), np.linspace(0, height - 1, 13))
    return _directions(intrinsics, columns.ravel(), rows.ravel())


def _directions(
    intrinsics: tuple[float, float, float, float, float], columns: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Directions (3, N) of pixels in their camera's frame, with z = 1."""
    u, v = (torch.from_numpy(np.asarray(pixel, np.float64)) for pixel in (columns, rows))
    numbers = torch.tensor(intrinsics, dtype=torch.float64)
    return pixel_rays(u, v, numbers, torch.eye(4, dtype=torch.float64)[:3])[1].numpy()


@compiled
def _place(u, v, matrix, lens):  # type: ignore[no-untyped-def]
    """The pixel (x, y) at which a view shows a cell that the mean camera sees at ``u``, ``v``.

    ``matrix`` (4, 3) leads from there to the view, its last row to the mean camera's depth; ``lens``: fx, fy,
    cx - 0.5, cy - 0.5, k1; float32. A cell that the view does not look at lies far off.
    """
    fx, fy, cx, cy, k1 = lens
    one, nowhere = np.float32(1.0), np.float32(-1e6)
    z = matrix[2, 0] * u + (matrix[2, 1] * v + matrix[2, 2])
    front = matrix[3, 0] * u + (matrix[3, 1] * v + matrix[3, 2])
    s = (matrix[0, 0] * u + (matrix[0, 1] * v + matrix[0, 2])) / z
    t = (matrix[1, 0] * u + (matrix[1, 1] * v + matrix[1, 2])) / z
    gain = one + k1 * (s * s + t * t)
    # Farther out a lens with k1 < 0 folds points back into its frame.
    whole = gain > np.float32(FOLDS)
    return fx * s * gain + cx if z > 0 and front > 0 and whole else nowhere, fy * t * gain + cy


@compiled
def _places(across, down, matrix, lens, x, y):  # type: ignore[no-untyped-def]
    """Fills ``x`` and ``y`` (R, C) with the pixels of the cells at ``down`` (R,) and ``across`` (C,)."""
    for row in range(down.size):
        for column in range(across.size):
            u, v = across[column], down[row]
            x[row, column], y[row, column] = _place(u, v, matrix, lens)


@compiled
def _add_view(across, down, matrix, lens, values, votes, total, squares):  # type: ignore[no-untyped-def]
    """Adds to a tally of the cells what a view's map ``values`` says of those that it sees."""
    rows, columns = values.shape
    right, bottom = np.float32(columns - 0.5), np.float32(rows - 0.5)
    for row in range(down.size):
        for column in range(across.size):
            x, y = _place(across[column], down[row], matrix, lens)
            if not (x >= -0.5 and x <= right and y >= -0.5 and y <= bottom):
                continue
            x, y = max(x, np.float32(0.0)), max(y, np.float32(0.0))
            left, top = min(int(x), columns - 1), min(int(y), rows - 1)
            after, below = min(left + 1, columns - 1), min(top + 1, rows - 1)
            s, t = x - np.float32(left), y - np.float32(top)
            high = values[top, left] + s * (values[top, after] - values[top, left])
            low = values[below, left] + s * (values[below, after] - values[below, left])
            seen = np.float64(high + t * (low - high))
            if seen == seen:  # not NaN
                votes[row, column] += 1.0
                total[row, column] += seen
                squares[row, column] += seen * seen


def _sample(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """`values` between its pixels at column and row indices x, y (float32); NaN outside its frame."""
    pixels = np.asarray(values, np.float32)
    found = cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    _blank_beside(x, y, np.float32(pixels.shape[1] - 0.5), np.float32(pixels.shape[0] - 0.5), found)
    return found


@compiled
def _blank_beside(x, y, right, bottom, found):  # type: ignore[no-untyped-def]
    """NaN in ``found`` where ``x``, ``y`` lie beyond -0.5 and ``right`` or ``bottom``, or are NaN."""
    for row in range(found.shape[0]):
        for column in range(found.shape[1]):
            u, v = x[row, column], y[row, column]
            if not (u >= -0.5 and u <= right and v >= -0.5 and v <= bottom):
                found[row, column] = np.nan
