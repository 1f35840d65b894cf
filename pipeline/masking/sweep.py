"""Finding the glass: the place where the views' maps agree best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize

from pipeline.geometry.poses import centre
from pipeline.masking.agreement import FEWEST_VIEWS, agreement, correlation
from pipeline.masking.glass import Glass, GlassCamera, LensGlass, PaneGlass, pane_before

Mode = Literal["lens", "pane", "none"]
Plane = tuple[float, float, float]  # distance, tilt x and tilt y in degrees
Scored = tuple[float, Plane]  # agreement on a plane

COARSE, FINE = 72, 200  # longest side of the maps, for the sweep and for its refinement
FEWEST_CELLS = 0.15  # of the maps' pixels: a plane on which less is shared tells nothing
TILTS_DEG = (-30.0, -15.0, 0.0, 15.0, 30.0)
MOST_TILT_DEG = 45.0
STEP_PX = 2.0  # between neighbouring distances, at the coarse size
MOST_VIEWS = 32  # that are swept
STARTS = 3  # of the sweep's best planes that are refined, at the coarse size
NEAR = 0.02  # of the best plane's agreement, at the coarse size: planes that are refined further with it
AHEAD = 0.1  # of the lens's agreement before every plane's, at the coarse size: no plane is refined further
# Of a refinement: the first steps (share of the distance, degrees), and how many planes are tried.
COARSE_WAY, FINE_WAY = (0.04, 7.0, 60), (0.01, 2.0, 40)


class Found(NamedTuple):
    """Where the glass is, and how well the views agree there, at most 1.

    `pane_from_world` (4, 4), `distance` (world units, along the mean camera's axis) and the tilts in
    degrees (see `pane_before`) describe the best plane, whether or not it was chosen (found at the coarse
    size alone where the lens is far ahead); None when there was none to try.
    """

    mode: Mode
    lens_agreement: float
    pane_agreement: float
    pane_from_world: np.ndarray | None
    distance: float
    tilt_x_deg: float
    tilt_y_deg: float


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
    plane is refined. The glass that moves with the camera is one more candidate; where it is far ahead,
    no plane is refined at the larger size. A mode is chosen when its agreement reaches `at_least`.
    `start`: (distance, tilt x, tilt y in degrees), found before; only its neighbourhood is searched
    then. Broad gradients (sky above, ground below) agree on any glass and are taken out first. Maps that
    hold NaN have no vote there.
    """
    chosen = np.unique(
        np.linspace(0, len(maps) - 1, min(len(maps), MOST_VIEWS)).round().astype(int)
    )
    maps, cameras = [maps[i] for i in chosen], [cameras[i] for i in chosen]
    coarse = prepared(maps, cameras, COARSE)
    lens = agreement(_stack(LensGlass(*coarse[0][0].shape), coarse[0]))
    cams = np.stack([camera.cam_from_world for camera in cameras])
    if start is None:
        # Glass that moves with the camera shows: no need then to look for a tilted pane.
        tilts = (0.0,) if lens >= at_least else TILTS_DEG
        tried = _sweep(*coarse, cams, farthest, tilts)
    else:
        tried = [(0.0, (float(start[0]), float(start[1]), float(start[2])))]
    if not tried:
        return Found("lens" if lens >= at_least else "none", lens, 0.0, None, 0.0, 0.0, 0.0)
    refined = [_refined(place, *coarse, cams, farthest, COARSE_WAY) for _, place in tried]
    best, plane = max(refined)
    if lens < at_least or best > lens - AHEAD:
        fine = prepared(maps, cameras, FINE)
        close = [one for one in refined if one[0] >= best - NEAR]
        best, plane = max(
            _refined(place, *fine, cams, farthest, FINE_WAY) for _, place in _leaders(close)
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
    plane, cells = glass.pane_from_world, 3 * fine[0].size
    try:
        own = PaneGlass(plane, cameras, cells)
    except ValueError:  # of cameras all around, the mean of some may look away
        own = PaneGlass(plane, cameras, cells, glass.mean)
    own.moved = glass.moved[known]
    return _stack(own, fine)


def _sweep(
    maps: list[np.ndarray],
    cameras: list[GlassCamera],
    cams: np.ndarray,
    farthest: float,
    tilts: Sequence[float],
) -> list[Scored]:
    """The best few planes, no two of them neighbours."""
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
    return _leaders(scored)


def _leaders(scored: list[Scored]) -> list[Scored]:
    """The best few, no two of them neighbours."""
    best: list[Scored] = []
    for score, place in sorted(scored, key=lambda one: -one[0]):
        if all(_apart(place, other) for _, other in best):
            best.append((score, place))
        if len(best) == STARTS:
            break
    return best


def _apart(one: Plane, other: Plane) -> bool:
    return (
        abs(one[0] / other[0] - 1) > 0.15
        or max(abs(one[1] - other[1]), abs(one[2] - other[2])) > 20.0
    )


def _refined(
    place: Plane,
    maps: list[np.ndarray],
    cameras: list[GlassCamera],
    cams: np.ndarray,
    farthest: float,
    way: tuple[float, float, int],
) -> Scored:
    """The plane near `place` at which the maps agree best, sought by simplex on the way given."""
    share, degrees, calls = way
    simplex = np.array([(np.log(place[0]), place[1], place[2])] * 4)
    simplex[1, 0] -= share
    simplex[2, 1] += degrees
    simplex[3, 2] += degrees

    def cost(x: np.ndarray) -> float:
        plane = (float(np.exp(x[0])), float(x[1]), float(x[2]))
        # Towards infinity a plane becomes glass that turns with the world: no pane.
        return 0.0 if plane[0] > farthest else -_on_plane(maps, cameras, cams, plane)

    options = {"initial_simplex": simplex, "maxfev": calls, "xatol": 1e-3, "fatol": 1e-4}
    found = minimize(cost, simplex[0], method="Nelder-Mead", options=options)
    return -float(found.fun), (float(np.exp(found.x[0])), float(found.x[1]), float(found.x[2]))


def _on_plane(
    maps: list[np.ndarray],
    cameras: list[GlassCamera],
    cams: np.ndarray,
    plane: Plane,
) -> float:
    if max(abs(plane[1]), abs(plane[2])) > MOST_TILT_DEG:
        return 0.0
    try:
        glass = PaneGlass(pane_before(cams, *plane), cameras, max_cells=3 * maps[0].size)
    except ValueError:
        return 0.0
    tally = glass.tally(maps)
    shared = (tally.votes >= FEWEST_VIEWS).sum()
    return correlation(tally) if shared >= FEWEST_CELLS * maps[0].size else 0.0


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
        known, filled = (
            cv2.resize(one.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            for one in (np.isfinite(values), np.nan_to_num(values))
        )
        filled -= known * _slope(filled / np.maximum(known, 1e-6), known)
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


def _slope(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The paraboloid (H, W) that lies nearest to `values`, which weigh as much as is `known` of each."""
    y, x = (np.linspace(-1, 1, n) for n in values.shape)
    ones = np.ones(values.shape)
    terms = np.stack([ones, ones * x, ones * y[:, None], ones * x**2, ones * y[:, None] ** 2,
                      x * y[:, None]], axis=-1)  # fmt: skip
    if (known > 0).sum() < terms.shape[-1]:
        return np.zeros(values.shape, np.float32)
    weights = np.sqrt(known, dtype=np.float64)[..., None]
    weighted = (weights * terms).reshape(-1, terms.shape[-1])
    coefficients, *_ = np.linalg.lstsq(weighted, (weights[..., 0] * values).ravel())
    return (terms @ coefficients).astype(np.float32)
