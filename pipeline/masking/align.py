"""Views brought to cover on the glass: where their cameras must stand for their maps to agree there."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import cv2
import numpy as np
import scipy.fft

from pipeline.masking.glass import PaneGlass

CELLS = 120_000
# Of each view while all are brought to cover: per cell, and per pixel what the loop holds besides.
CELL_BYTES, PIXEL_BYTES = 17, 22
SWEEPS = ((2.0, 3), (1.0, 4))  # blur in pixels, and how often every view is fitted with it
PROBE_PX = 0.5  # how far a camera is moved to see what that does to its map
MOST_PX = 2.0  # that a camera moves at a time
RIDGE = 1e-3  # keeps still what the maps say nothing about


def aligned(
    glass: PaneGlass, maps: Sequence[np.ndarray | None], reach_px: float, rounds: int = 3
) -> np.ndarray:
    """`moved` (V, 3) that brings each view's map to where the other views have it on the plane.

    First across the plane, by cross-correlation with the sum of the others within `reach_px` pixels;
    then in all three directions by least squares (Gauss-Newton) against the others' mean: a camera a
    centimetre nearer to the pane sees its drops larger. On cells a few pixels large. Views without a
    map stay. Sets nothing: give it to `glass.moved`.
    """
    coarse = copy.copy(glass)
    factor = max(1.0, math.sqrt(glass.shape[0] * glass.shape[1] / CELLS))
    coarse.cell = glass.cell * factor
    coarse.shape = (math.ceil(glass.shape[0] / factor), math.ceil(glass.shape[1] / factor))
    coarse.moved = glass.moved.copy()
    chosen = [view for view, values in enumerate(maps) if values is not None]
    if len(chosen) < 3:
        return glass.moved.copy()
    reach = max(1, math.ceil(reach_px / factor))
    for _ in range(rounds):
        _shift(coarse, maps, reach)
        coarse.moved[chosen] -= coarse.moved[chosen].mean(axis=0)
    for blur, times in SWEEPS:
        smooth = [None if values is None else _blurred(values, blur) for values in maps]
        for _ in range(times):
            _fit(coarse, smooth)
            coarse.moved[chosen] -= coarse.moved[chosen].mean(axis=0)
    return coarse.moved


def held_bytes(pixels: int) -> int:
    """Per pixel of views of so many `pixels`, what is held at most while they are brought to cover."""
    return PIXEL_BYTES + math.ceil(CELL_BYTES * CELLS / pixels)


def _shift(glass: PaneGlass, maps: Sequence[np.ndarray | None], reach: int) -> None:
    """Moves every view's camera across the plane, to the peak of the correlation with the others."""
    spectra = {}
    for view, values in enumerate(maps):
        if values is not None:
            seen = glass.from_view(view, values)
            detail = seen - np.nanmean(seen) if np.isfinite(seen).any() else seen
            spectra[view] = scipy.fft.rfft2(np.nan_to_num(detail), workers=1)
    total = np.sum(list(spectra.values()), axis=0)
    for view, own in spectra.items():
        match = scipy.fft.irfft2(own * np.conj(total - own), s=glass.shape, workers=1)
        shift = glass.view_from_glass(view)[:, :2] @ (glass.cell * _peak(match, reach))
        rotation = glass.cameras[view].cam_from_world[:3, :3]
        glass.moved[view] += rotation.T @ shift / glass.normal[2]


def _fit(glass: PaneGlass, maps: Sequence[np.ndarray | None]) -> None:
    """One step of every view's camera, one after the other, towards the mean of the other views' maps."""
    seen = {v: glass.from_view(v, values) for v, values in enumerate(maps) if values is not None}
    total = np.sum([np.nan_to_num(one) for one in seen.values()], axis=0)
    votes = np.sum([np.isfinite(one) for one in seen.values()], axis=0)
    probe = PROBE_PX * glass.depth / glass.cameras[0].intrinsics[0]
    for view, own in seen.items():
        values = maps[view]
        assert values is not None
        shared = np.isfinite(own) & (votes > 1)
        here = glass.moved[view].copy()
        slopes = []
        for axis in np.eye(3):
            glass.moved[view] = here + probe * axis
            slopes.append(glass.from_view(view, values) - own)
        slope = np.stack(slopes)
        shared &= np.isfinite(slope).all(axis=0)
        others = (total - np.nan_to_num(own))[shared] / (votes - 1)[shared]
        slope = slope[:, shared].astype(np.float64)
        normal = slope @ slope.T
        normal += RIDGE * max(float(np.trace(normal)), 1e-12) * np.eye(3)
        step = np.linalg.solve(normal, slope @ (others - own[shared]))
        step *= min(1.0, MOST_PX / PROBE_PX / max(float(np.abs(step).max()), 1e-12))
        glass.moved[view] = here + probe * step
        now = glass.from_view(view, values)
        total += np.nan_to_num(now) - np.nan_to_num(own)
        votes += np.isfinite(now).astype(votes.dtype) - np.isfinite(own)


def _blurred(values: np.ndarray, sigma: float) -> np.ndarray:
    """`values` (H, W) blurred by a Gaussian; NaN stay and have no weight."""
    known = np.isfinite(values).astype(np.float32)
    share = cv2.GaussianBlur(known, (0, 0), sigma)
    smooth = cv2.GaussianBlur(np.nan_to_num(values).astype(np.float32), (0, 0), sigma)
    return np.where(known > 0, smooth / np.maximum(share, 1e-6), np.nan).astype(np.float32)


def _peak(match: np.ndarray, reach: int) -> np.ndarray:
    """The shift (x, y) at the highest value of a circular correlation within `reach`, to a fraction."""
    span = np.arange(-reach, reach + 1)
    near = match[np.ix_(span % match.shape[0], span % match.shape[1])]
    row, column = np.unravel_index(int(near.argmax()), near.shape)

    def vertex(line: np.ndarray, at: int) -> float:
        if not 0 < at < len(line) - 1:
            return float(at)
        before, here, after = (float(v) for v in line[at - 1 : at + 2])
        bend = before - 2 * here + after
        return at + 0.5 * (before - after) / bend if bend < 0 else float(at)

    return np.array([vertex(near[row], int(column)), vertex(near[:, column], int(row))]) - reach
