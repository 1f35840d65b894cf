"""How well drop masks agree with the true coverage."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np


class MaskCounts(NamedTuple):
    """Pixels that are rightly dropped, dropped though clear, and kept though covered."""

    hits: int
    false_alarms: int
    misses: int


class MaskScores(NamedTuple):
    """Agreement in [0, 1]; NaN where nothing was there to divide by."""

    iou: float
    precision: float
    recall: float


def mask_counts(drop_mask: np.ndarray, coverage: np.ndarray, threshold: float) -> MaskCounts:
    """Pixel counts of a drop mask (H, W) bool against true coverage (H, W) in [0, 1].

    A pixel is truly covered when its coverage is above `threshold`. ValueError when shapes differ.
    """
    if drop_mask.shape != coverage.shape or drop_mask.ndim != 2:
        raise ValueError(f"a mask {drop_mask.shape} for coverage {coverage.shape}")
    covered = coverage > threshold
    counted = (drop_mask & covered, drop_mask & ~covered, ~drop_mask & covered)
    return MaskCounts(*(int(np.count_nonzero(pixels)) for pixels in counted))


def mask_scores(counts: Iterable[MaskCounts]) -> MaskScores:
    """Intersection over union, precision and recall of the pixels of all images taken together.

    Pooled, not averaged over images: an image without drops has no score of its own, and a wrong
    pixel costs the same wherever it is.
    """
    pooled = list(counts)
    hits = sum(count.hits for count in pooled)
    false_alarms = sum(count.false_alarms for count in pooled)
    misses = sum(count.misses for count in pooled)
    return MaskScores(
        _share(hits, hits + false_alarms + misses),
        _share(hits, hits + false_alarms),
        _share(hits, hits + misses),
    )


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan
