"""Drop masks redrawn from what was gathered on the glass."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from pipeline.masking.masks import otsu

FLOOR = 1e-3  # residuals below it are equal: 8-bit photos hold no less
LARGEST_HOLE = 0.25  # of the drop around it


class Redrawn(NamedTuple):
    """A drop mask on the glass and what it rests on.

    `drop_mask` bool; `known`: cells with votes enough to decide; `level`: the residual at which drops
    begin; `contrast`: median residual inside the drops over that outside; NaN without either.
    """

    drop_mask: np.ndarray
    known: np.ndarray
    level: float
    contrast: float


def redraw(
    gathered: np.ndarray, votes: np.ndarray, previous: np.ndarray, fewest_votes: int
) -> Redrawn:
    """The drop mask on the glass from the gathered residual; `previous` where too few views voted.

    Otsu's threshold on the logarithm, opening 3x3, holes filled: water has no holes.
    """
    known = np.isfinite(gathered) & (votes >= fewest_votes)
    if not known.any():
        return Redrawn(previous.copy(), known, float("nan"), float("nan"))
    logs = np.log(np.maximum(np.where(known, gathered, 1.0), FLOOR))
    level = otsu(logs[known])
    drop_mask = without_holes(opened(known & (logs > level)))
    inside, outside = gathered[known & drop_mask], gathered[known & ~drop_mask]
    contrast = float("nan")
    if inside.size and outside.size:
        contrast = float(np.median(inside) / max(float(np.median(outside)), FLOOR))
    return Redrawn(np.where(known, drop_mask, previous), known, float(np.exp(level)), contrast)


def opened(drop_mask: np.ndarray) -> np.ndarray:
    """`drop_mask` without what a 3x3 square does not fit into."""
    square = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(drop_mask.astype(np.uint8), cv2.MORPH_OPEN, square).astype(bool)


def without_holes(drop_mask: np.ndarray, largest: float = LARGEST_HOLE) -> np.ndarray:
    """`drop_mask` with its holes filled: clear regions enclosed by one drop.

    A region larger than `largest` times the drop's own area is left clear: several drops that touch
    may stand around dry glass.
    """
    drops, count = ndimage.label(drop_mask, np.ones((3, 3)))
    clear, holes = ndimage.label(~drop_mask)
    if not count or not holes:
        return drop_mask.copy()
    rim = np.unique(np.concatenate([clear[0], clear[-1], clear[:, 0], clear[:, -1]]))
    areas = np.bincount(drops.ravel())
    sizes = np.bincount(clear.ravel())
    # An enclosed region has one drop around it: the largest label in its neighbourhood is that.
    around = ndimage.maximum(
        cv2.dilate(drops.astype(np.float32), np.ones((3, 3), np.uint8)), clear, range(holes + 1)
    ).astype(int)
    fill = sizes <= largest * areas[around]
    fill[0] = False
    fill[rim] = False
    return drop_mask | fill[clear]
