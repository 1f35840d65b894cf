"""Drop masks redrawn from what was gathered on the glass."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from pipeline.masking.masks import otsu

FLOOR = 1e-3  # residuals below it are equal: 8-bit photos hold no less
LARGEST_HOLE = 0.25  # of the drop around it
SUREST = 0.02  # attention is never taken for more certain than this
ATTENTION_WEIGHT = 1.0  # of its log-odds against the log of the residual
SPILL = 0.15  # share of the strongest evidence nearby that a place has from its blur
LEAST = 0.05  # the margin of a cell that only its neighbours turned
UNKNOWN = 0.5  # the margin of a cell that keeps its old mask


class Redrawn(NamedTuple):
    """A drop mask on the glass and what it rests on.

    `drop_mask` bool; `margin`: how far a cell is from the drop's rim, in units of the way from the clear
    median to Otsu's threshold, within -1 and 1, above 0 where `drop_mask`: where a rim runs between two
    cells; `known`: cells with votes enough to decide; `level`: how many times its
    surroundings' the residual must be where a drop begins, without other evidence; `contrast`: median
    residual inside the drops over that outside; NaN without either.
    """

    drop_mask: np.ndarray
    margin: np.ndarray
    known: np.ndarray
    level: float
    contrast: float


def redraw(
    gathered: np.ndarray,
    votes: np.ndarray,
    previous: np.ndarray,
    fewest_votes: int,
    *,
    reach: float,
    spill: float,
    join: float,
    attention: np.ndarray | None = None,
) -> Redrawn:
    """The drop mask on the glass from the gathered residual; `previous` where too few views voted.

    What counts is the logarithm of the residual over that of the clear surroundings within `reach`
    cells: a field is worse in foliage than on a road, and drops are smaller than either. The log-odds
    of the gathered `attention`, where there is one, add to it. Blur carries the evidence of a drop over its
    rim, that of a strong drop farther: of the sum, a share of the largest within `spill` cells is taken
    off. Otsu's threshold tells what surely is a drop; what lies `join` of the way up to it from the clear
    median joins such a drop nearby. Then an opening 3x3, and holes are filled: water has none.
    """
    known = np.isfinite(gathered) & (votes >= fewest_votes)
    if known.sum() < 2:
        margin = np.where(previous, UNKNOWN, -UNKNOWN).astype(np.float32)
        return Redrawn(previous.copy(), margin, known, float("nan"), float("nan"))
    logs = np.log(np.maximum(np.where(known, gathered, 1.0), FLOOR)).astype(np.float32)
    above = _above_surroundings(logs, known, reach)
    score = above
    if attention is not None:
        odds = np.clip(np.nan_to_num(attention, nan=0.5), SUREST, 1 - SUREST)
        odds = np.log(odds / (1 - odds))
        score = above + ATTENTION_WEIGHT * (odds - np.median(odds[known]))
    score = without_spill(score, known, spill)
    sure = otsu(score[known])
    middle = float(np.median(score[known & (score <= sure)]))
    begin = middle + join * (sure - middle)
    # Old masks stand in where nobody can tell: as holes they would take their neighbours along.
    wide, seeds = (np.where(known, score > level, previous) for level in (begin, sure))
    drop_mask = np.where(known, without_holes(joined(wide, seeds)), previous)
    inside, outside = gathered[known & drop_mask], gathered[known & ~drop_mask]
    contrast = float("nan")
    if inside.size and outside.size:
        contrast = float(np.median(inside) / max(float(np.median(outside)), FLOOR))
    level = float(np.exp((begin - middle) / (1 - SPILL)))
    way = np.clip((score - begin) / max(sure - middle, 1e-6), -1, 1)
    way = np.where(drop_mask, np.maximum(way, LEAST), np.minimum(way, -LEAST))
    margin = np.where(known, way, np.where(drop_mask, UNKNOWN, -UNKNOWN)).astype(np.float32)
    return Redrawn(drop_mask, margin, known, level, contrast)


def _above_surroundings(logs: np.ndarray, known: np.ndarray, reach: float) -> np.ndarray:
    """`logs` minus their mean over the clear cells around; what is clear is found on the way."""
    clear = known & (logs <= otsu(logs[known]))
    above = logs
    for _ in range(4):
        share = cv2.GaussianBlur(clear.astype(np.float32), (0, 0), reach)
        around = cv2.GaussianBlur(np.where(clear, logs, np.float32(0)), (0, 0), reach)
        everywhere = float(logs[clear].mean())
        # Where nothing near is clear, what is clear everywhere has to do.
        above = logs - (around + 1e-3 * everywhere) / (share + 1e-3)
        clear = known & (above <= otsu(above[known]))
    return above


def without_spill(score: np.ndarray, known: np.ndarray, radius: float) -> np.ndarray:
    """`score` less `SPILL` times the largest score of the known cells in a disc around; itself included."""
    lowest = np.where(known, score, score[known].min()).astype(np.float32)
    steps = np.arange(-int(radius), int(radius) + 1)
    disc = (steps[:, None] ** 2 + steps**2 <= radius**2).astype(np.uint8)
    return score - np.float32(SPILL) * cv2.dilate(lowest, disc)


def joined(wide: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The regions of `wide`, opened by 3x3, that hold a pixel of `seeds` (hysteresis)."""
    regions, _ = ndimage.label(opened(wide), np.ones((3, 3)))
    found = np.unique(regions[seeds & (regions > 0)])
    return np.isin(regions, found[found > 0])


def opened(drop_mask: np.ndarray) -> np.ndarray:
    """`drop_mask` without what a 3x3 square does not fit into."""
    square = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(drop_mask.astype(np.uint8), cv2.MORPH_OPEN, square).astype(bool)


def without_holes(drop_mask: np.ndarray, largest: float = LARGEST_HOLE) -> np.ndarray:
    """`drop_mask` with its holes filled: clear regions enclosed by one drop.

    A region larger than `largest` times the area of that drop, or of a larger one that stands in the
    region, is left clear: several drops that touch may stand around dry glass.
    """
    drops, count = ndimage.label(drop_mask, np.ones((3, 3)))
    clear, holes = ndimage.label(~drop_mask)
    if not count or not holes:
        return drop_mask.copy()
    rim = np.unique(np.concatenate([clear[0], clear[-1], clear[:, 0], clear[:, -1]]))
    areas = np.bincount(drops.ravel())
    areas[0] = 0
    sizes = np.bincount(clear.ravel())
    # An enclosed region has one drop around it and perhaps others inside: the largest beside it counts.
    beside = cv2.dilate(areas[drops].astype(float), np.ones((3, 3), np.uint8))
    fill = sizes <= largest * ndimage.maximum(beside, clear, range(holes + 1))
    fill[0] = False
    fill[rim] = False
    return drop_mask | fill[clear]
