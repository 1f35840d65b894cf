"""All views' drop masks, redrawn from what was gathered on the glass."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pipeline.masking.glass import Glass, PaneGlass, gather, neighbours
from pipeline.masking.masks import automatic_threshold, dilate, threshold
from pipeline.masking.remask import Redrawn, redraw

MEANS = 0.6  # of the threshold of single maps
# Votes without attention; with it a single view's residual has its say too.
FEWEST_ON_PANE, SHARE_ON_LENS = 2, 0.25
# Where a drop begins, between the clear median (0) and Otsu's threshold (1). Later with attention, whose
# log-odds fall off slowly around a drop, and latest on a pane, where what views still miss each other by
# smears them.
JOIN, JOIN_ON_LENS, JOIN_ON_PANE = 0.4, 0.6, 0.7
SURROUNDINGS = 20  # the longer side over this: how far around a place counts as its surroundings
NEARBY = 90  # the longer side over this: how far the blur of residual and attention carries a drop's evidence


class RedrawnViews(NamedTuple):
    """New drop masks of all views, the residual gathered from all of them, and what it says.

    `contrast` and `level` as in `Redrawn`; `known` is the share of the masks' pixels that enough views
    voted on.
    """

    drop_masks: list[np.ndarray]
    gathered: np.ndarray
    contrast: float
    level: float
    known: float


def redraw_views(
    glass: Glass,
    residuals: Sequence[np.ndarray | None],
    drop_masks: Sequence[np.ndarray],
    *,
    quantile: float,
    attentions: Sequence[np.ndarray] | None = None,
    width: int = 0,
    dilation: int = 0,
) -> RedrawnViews:
    """Every view's drop mask redrawn from the `residuals` (None: a view that was not fitted).

    On the glass each cell takes the `quantile` of the residuals over its views; cells with fewer votes
    than `fewest_votes` keep what the old masks say. The `attentions` of all views, gathered likewise,
    have their say (see `redraw`). With a `width` above 0 a view takes the part of its `width` neighbours
    only: drops may creep. What is new is grown by `dilation` pixels, what is kept was grown before.
    """
    count = len(drop_masks)
    fitted = sum(values is not None for values in residuals)
    fewest = fewest_votes(glass, min(width or fitted, fitted), attentions is not None)
    join = JOIN
    if attentions is not None:
        join = JOIN_ON_PANE if isinstance(glass, PaneGlass) else JOIN_ON_LENS
    everything, longer = range(count), max(drop_masks[0].shape)
    overall = gather(glass, residuals, everything, quantile)

    @lru_cache(maxsize=1)  # neighbours only move on, and each holds as much as several photos
    def redrawn(views: range) -> Redrawn:
        apart = views != everything
        gathered, votes = gather(glass, residuals, views, quantile) if apart else overall
        old, _ = gather(glass, drop_masks, views, None)
        seen = None if attentions is None else gather(glass, attentions, views, None)[0]
        found = redraw(
            gathered, votes, np.nan_to_num(old) > 0.5, fewest,
            reach=longer / SURROUNDINGS, spill=longer / NEARBY, join=join, attention=seen,
        )  # fmt: skip
        told.append((found.contrast, found.level))
        return found

    fresh, known, told = [], [], list[tuple[float, float]]()
    for view, old in enumerate(drop_masks):
        found = redrawn(neighbours(count, view, width))
        margin = glass.to_view(view, found.margin)
        decided = np.nan_to_num(glass.to_view(view, found.known.astype(np.float32)))
        drops = np.where(np.isfinite(margin), margin > 0, old)
        fresh.append(drops | dilate(drops & (decided > 0.5), dilation))
        known.append(decided.mean())
    contrast, level = (_median(values) for values in zip(*told, strict=True))
    return RedrawnViews(fresh, np.nan_to_num(overall[0]), contrast, level, float(np.mean(known)))


def _median(values: Sequence[float]) -> float:
    """The median of those that are numbers: of some neighbours no drop may be known; NaN of none."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.median(known)) if known else math.nan


def fewest_votes(glass: Glass, views: int, with_attention: bool) -> int:
    """How many of the `views` must look at a place of the glass for it to be redrawn."""
    if with_attention:
        return 1
    return FEWEST_ON_PANE if isinstance(glass, PaneGlass) else max(2, round(SHARE_ON_LENS * views))


def attention_on_glass(
    glass: Glass,
    attentions: Sequence[np.ndarray],
    drop_masks: Sequence[np.ndarray],
    width: int = 0,
    dilation: int = 0,
) -> list[np.ndarray]:
    """Equation 5 where the glass is: drop masks from the maps' mean there.

    The mean alone, without the view's own map beside it. The threshold is chosen from the single maps; a
    mean seldom reaches their heights. Off the glass the old mask stays.
    """
    t = MEANS * automatic_threshold(attentions)
    count = len(attentions)

    @lru_cache(maxsize=1)  # neighbours only move on
    def gathered(views: range) -> np.ndarray:
        return gather(glass, attentions, views, None)[0]

    fresh = []
    for view, old in enumerate(drop_masks):
        mean = glass.to_view(view, gathered(neighbours(count, view, width)))
        fresh.append(np.where(np.isfinite(mean), dilate(threshold(mean, t), dilation), old))
    return fresh


def changed_share(old: Sequence[np.ndarray], new: Sequence[np.ndarray]) -> float:
    """The share of pixels, over all views, whose mask changed."""
    return float(np.mean([(a != b).mean() for a, b in zip(old, new, strict=True)]))
