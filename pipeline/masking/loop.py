"""One round of the loop: what the views show, gathered on the glass, becomes every view's mask."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.masking.glass import Glass, gather, window
from pipeline.masking.masks import dilate, threshold
from pipeline.masking.remask import Redrawn, redraw


class Round(NamedTuple):
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
    fewest_votes: int,
    width: int = 0,
    dilation: int = 0,
) -> Round:
    """Every view's drop mask redrawn from the `residuals` (None: a view that was not fitted).

    On the glass each cell takes the `quantile` of the residuals over its views; cells with fewer
    than `fewest_votes` keep what the old masks say. With a `width` above 0 a view takes the part of
    its `width` neighbours only: drops may creep. The new masks are grown by `dilation` pixels.
    """
    count = len(drop_masks)
    cache: dict[range, Redrawn] = {}

    def redrawn(views: range) -> Redrawn:
        if views not in cache:
            gathered, votes = gather(glass, residuals, views, quantile)
            old, _ = gather(glass, [m.astype(np.float32) for m in drop_masks], views, None)
            cache[views] = redraw(gathered, votes, np.nan_to_num(old) > 0.5, fewest_votes)
        return cache[views]

    fresh, known = [], []
    for view, old in enumerate(drop_masks):
        found = redrawn(window(count, view, width))
        share = glass.to_view(view, found.drop_mask.astype(np.float32))
        fresh.append(dilate(np.where(np.isfinite(share), share > 0.5, old), dilation))
        known.append(np.nan_to_num(glass.to_view(view, found.known.astype(np.float32))).mean())
    facts = list(cache.values())
    gathered, _ = gather(glass, residuals, range(count), quantile)
    return Round(
        fresh,
        np.nan_to_num(gathered),
        float(np.median([found.contrast for found in facts])),
        float(np.median([found.level for found in facts])),
        float(np.mean(known)),
    )


def attention_on_glass(
    glass: Glass,
    attentions: Sequence[np.ndarray],
    drop_masks: Sequence[np.ndarray],
    t: float,
    width: int = 0,
    dilation: int = 0,
) -> list[np.ndarray]:
    """Equation 5 where the glass is: drop masks from the maps' mean there, thresholded at t.

    The mean alone, without the view's own map beside it. Off the glass the old mask stays.
    """
    count = len(attentions)
    cache: dict[range, np.ndarray] = {}
    fresh = []
    for view, old in enumerate(drop_masks):
        views = window(count, view, width)
        if views not in cache:
            cache[views] = gather(glass, attentions, views, None)[0]
        mean = glass.to_view(view, cache[views])
        fresh.append(np.where(np.isfinite(mean), dilate(threshold(mean, t), dilation), old))
    return fresh


def changed_share(old: Sequence[np.ndarray], new: Sequence[np.ndarray]) -> float:
    """The share of pixels, over all views, whose mask changed."""
    return float(np.mean([(a != b).mean() for a, b in zip(old, new, strict=True)]))
