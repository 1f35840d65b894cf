"""Finding the glass: the place where the views' maps agree best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize

from pipeline.geometry.poses import centre
from pipeline.masking.glass import Glass, GlassCamera, LensGlass, PaneGlass, pane_before

Mode = Literal["lens", "pane", "none"]

COARSE, FINE = 72, 200  # longest side of the maps, for the sweep and for its refinement
FEWEST_VIEWS = 3  # that see a cell which counts
FEWEST_CELLS = 0.15  # of the maps' pixels: a plane on which less is shared tells nothing
TILTS_DEG = (-30.0, -15.0, 0.0, 15.0, 30.0)
MOST_TILT_DEG = 45.0
STEP_PX = 2.0  # between neighbouring distances, at the coarse size
MOST_VIEWS = 32  # that are swept
STARTS = 3  # of the sweep's best planes that are refined


class Found(NamedTuple):
    """Where the glass is, and how well the views agree there, at most 1.

    `pane_from_world` (4, 4), `distance` (world units, along the mean camera's axis) and the tilts in
    degrees (see `pane_before`) describe the best plane, whether or not it was chosen; None when
    there was none to try.
    """

    mode: Mode
    lens_agreement: float
    pane_agreement: float
    pane_from_world: np.ndarray | None
    distance: float
    tilt_x_deg: float
    tilt_y_deg: float


def agreement(stack: np.ndarray, fewest_views: int = FEWEST_VIEWS) -> float:
    """How alike the views' values are in the same cell: the intraclass correlation of (V, ...).

    One-way analysis of variance with cells as groups: 1 when the views agree wholly, near 0 when a
    cell says nothing about its values, whatever the number of views per cell. Cells that fewer
    than `fewest_views` see (NaN: does not see) do not count. 0 when nothing varies or too little is
    shared.
    """
    flat = stack.reshape(len(stack), -1)
    seen = ~np.isnan(flat)
    count = seen.sum(axis=0)
    shared = count >= fewest_views
    values = flat[:, shared].astype(np.result_type(flat, np.float32), copy=False)  # the stack stays
    seen, count = seen[:, shared], count[shared].astype(np.float64)
    if count.size < 2:
        return 0.0
    values[~seen] = 0
    total = count.sum()
    mean = values.sum(axis=0, dtype=np.float64) / count
    grand = (mean * count).sum() / total
    between = (count * (mean - grand) ** 2).sum() / (count.size - 1)
    values -= mean.astype(values.dtype)
    values[~seen] = 0
    within = np.square(values, out=values).sum(dtype=np.float64) / (total - count.size)
    per_cell = (total - (count**2).sum() / total) / (count.size - 1)
    whole = between + (per_cell - 1) * within
    return float((between - within) / whole) if whole > 0 else 0.0


def find_glass(
    maps: Sequence[np.ndarray],
    cameras: Sequence[GlassCamera],
    farthest: float,
    *,
    at_least: float,
    start: tuple[float, float, float] | None = None,
) -> Found:
    """Which glass the maps (attention, or residual) were taken through: lens, pane in the scene, none.

    Every pane distance up to `farthest` is tried, upright and tilted; where the maps agree best, the
    plane is refined. The glass that moves with the camera is one more candidate. A mode is chosen
    when its agreement reaches `at_least`. `start`: (distance, tilt x, tilt y in degrees), found
    before; only its neighbourhood is searched then. Broad gradients (sky above, ground below) agree on
    any glass and are taken out first. Maps that hold NaN have no vote there.
    """
    chosen = np.unique(
        np.linspace(0, len(maps) - 1, min(len(maps), MOST_VIEWS)).round().astype(int)
    )
    maps, cameras = [maps[i] for i in chosen], [cameras[i] for i in chosen]
    coarse, coarse_cameras = prepared(maps, cameras, COARSE)
    lens = agreement(_stack(LensGlass(*coarse[0].shape), coarse))
    cams = np.stack([camera.cam_from_world for camera in cameras])
    if start is None:
        # Glass that moves with the camera shows: no need then to look for a tilted pane.
        tilts = (0.0,) if lens >= at_least else TILTS_DEG
        tried = _sweep(coarse, coarse_cameras, cams, farthest, tilts)
    else:
        tried = [(0.0, (float(start[0]), float(start[1]), float(start[2])))]
    if not tried:
        return Found("lens" if lens >= at_least else "none", lens, 0.0, None, 0.0, 0.0, 0.0)
    fine, fine_cameras = prepared(maps, cameras, FINE)
    best, plane = max(
        (
            _refined(place, (coarse, coarse_cameras), (fine, fine_cameras), cams, farthest)
            for _, place in tried
        ),
        key=lambda found: found[0],
    )
    mode: Mode = "none"
    if max(lens, best) >= at_least:
        mode = "pane" if best > lens else "lens"
    return Found(mode, lens, best, pane_before(cams, *plane), *plane)


def agreement_on(glass: PaneGlass, maps: Sequence[np.ndarray | None]) -> float:
    """How well the views' maps agree on a pane as it stands, the views where `glass.moved` has them."""
    return agreement(stack_on(glass, maps))


def stack_on(glass: PaneGlass, maps: Sequence[np.ndarray | None]) -> np.ndarray:
    """(V, rows, columns): the maps of the views that have one, on fewer cells of a pane as it stands.

    Without broad gradients, the views where `glass.moved` has them; NaN where one does not see a cell.
    """
    known = [view for view, values in enumerate(maps) if values is not None]
    fine, cameras = prepared(
        [values for values in maps if values is not None], [glass.cameras[v] for v in known], FINE
    )
    own = PaneGlass(glass.pane_from_world, cameras, max_cells=3 * fine[0].size)
    own.moved = glass.moved[known]
    return _stack(own, fine)


def _sweep(
    maps: list[np.ndarray],
    cameras: list[GlassCamera],
    cams: np.ndarray,
    farthest: float,
    tilts: Sequence[float],
) -> list[tuple[float, tuple[float, float, float]]]:
    """The best few planes (agreement, plane), no two of them neighbours."""
    centres = np.stack([centre(cam) for cam in cams])
    spread = float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if spread <= 0 or len(maps) < FEWEST_VIEWS:
        return []
    # Nearer than this, the frames of most views have nothing on the glass in common.
    nearest = cameras[0].intrinsics[0] * spread / max(maps[0].shape)
    if farthest <= nearest:
        return []
    count = int(cameras[0].intrinsics[0] * spread * (1 / nearest - 1 / farthest) / STEP_PX) + 2
    distances = 1.0 / np.linspace(1 / nearest, 1 / farthest, count)
    scored = [
        (_on_plane(maps, cameras, cams, (float(distance), a, b)), (float(distance), a, b))
        for a in tilts
        for b in tilts
        for distance in distances
    ]
    scored.sort(key=lambda one: -one[0])
    best: list[tuple[float, tuple[float, float, float]]] = []
    for score, place in scored:
        if all(_apart(place, other) for _, other in best):
            best.append((score, place))
        if len(best) == STARTS:
            break
    return best


def _apart(one: tuple[float, float, float], other: tuple[float, float, float]) -> bool:
    return (
        abs(one[0] / other[0] - 1) > 0.15
        or max(abs(one[1] - other[1]), abs(one[2] - other[2])) > 20.0
    )


def _refined(
    place: tuple[float, float, float],
    coarse: tuple[list[np.ndarray], list[GlassCamera]],
    fine: tuple[list[np.ndarray], list[GlassCamera]],
    cams: np.ndarray,
    farthest: float,
) -> tuple[float, tuple[float, float, float]]:
    """The plane near `place` at which the maps agree best, coarse first and then fine."""
    at = place
    for (maps, cameras), (share, degrees), calls in (
        (coarse, (0.04, 7.0), 60),
        (fine, (0.01, 2.0), 40),
    ):
        simplex = np.array([(np.log(at[0]), at[1], at[2])] * 4)
        simplex[1, 0] -= share
        simplex[2, 1] += degrees
        simplex[3, 2] += degrees

        def cost(
            x: np.ndarray, maps: list[np.ndarray] = maps, cameras: list[GlassCamera] = cameras
        ) -> float:
            plane = (float(np.exp(x[0])), float(x[1]), float(x[2]))
            # Towards infinity a plane becomes glass that turns with the world: no pane.
            return 0.0 if plane[0] > farthest else -_on_plane(maps, cameras, cams, plane)

        options = {"initial_simplex": simplex, "maxfev": calls, "xatol": 1e-3, "fatol": 1e-4}
        found = minimize(cost, simplex[0], method="Nelder-Mead", options=options)
        at = (float(np.exp(found.x[0])), float(found.x[1]), float(found.x[2]))
    return -float(found.fun), at


def _on_plane(
    maps: list[np.ndarray],
    cameras: list[GlassCamera],
    cams: np.ndarray,
    plane: tuple[float, float, float],
) -> float:
    if max(abs(plane[1]), abs(plane[2])) > MOST_TILT_DEG:
        return 0.0
    try:
        glass = PaneGlass(pane_before(cams, *plane), cameras, max_cells=3 * maps[0].size)
    except ValueError:
        return 0.0
    stack = _stack(glass, maps)
    shared = (np.isfinite(stack).sum(axis=0) >= FEWEST_VIEWS).sum()
    return agreement(stack) if shared >= FEWEST_CELLS * maps[0].size else 0.0


def _stack(glass: Glass, maps: list[np.ndarray]) -> np.ndarray:
    return np.stack([glass.from_view(view, values) for view, values in enumerate(maps)])


def prepared(
    maps: Sequence[np.ndarray], cameras: Sequence[GlassCamera], longest: int
) -> tuple[list[np.ndarray], list[GlassCamera]]:
    """Maps and cameras with `longest` pixels on their longer side, the maps without broad gradients."""
    out, small = [], []
    for values, camera in zip(maps, cameras, strict=True):
        height, width = values.shape
        factor = min(1.0, longest / max(height, width))
        size = (max(2, round(width * factor)), max(2, round(height * factor)))
        known = np.isfinite(values).astype(np.float32)
        filled = np.nan_to_num(values - _slope(values), nan=0.0).astype(np.float32)
        known = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
        filled = cv2.resize(filled, size, interpolation=cv2.INTER_AREA)
        sigma = max(size) / 10
        broad = cv2.GaussianBlur(filled, (0, 0), sigma)
        weight = cv2.GaussianBlur(known, (0, 0), sigma)
        detail = filled / np.maximum(known, 1e-6) - broad / np.maximum(weight, 1e-6)
        out.append(np.where(known > 0.5, detail, np.nan).astype(np.float32))
        x, y = size[0] / width, size[1] / height
        fx, fy, cx, cy, k1 = camera.intrinsics
        shrunk = (fx * x, fy * y, cx * x, cy * y, k1)
        small.append(GlassCamera(camera.cam_from_world, shrunk, *size))
    return out, small


def _slope(values: np.ndarray) -> np.ndarray:
    """The paraboloid that lies nearest to `values` (H, W) where they are known."""
    y, x = (np.linspace(-1, 1, n) for n in values.shape)
    ones = np.ones(values.shape)
    terms = np.stack([ones, ones * x, ones * y[:, None], ones * x**2, ones * y[:, None] ** 2,
                      x * y[:, None]], axis=-1)  # fmt: skip
    known = np.isfinite(values)
    if known.sum() < terms.shape[-1]:
        return np.zeros(values.shape)
    coefficients, *_ = np.linalg.lstsq(terms[known], values[known].astype(np.float64))
    return terms @ coefficients
