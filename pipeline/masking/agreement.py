"""How alike the views' maps are on the glass: the intraclass correlation of what they say of its cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

FEWEST_VIEWS = 3  # that see a cell which counts


class Tally(NamedTuple):
    """What the views say of each cell: how many see it, their values' sum and their squares'; float64."""

    votes: np.ndarray
    total: np.ndarray
    squares: np.ndarray


def tally_of(stack: np.ndarray) -> Tally:
    """The tally of maps (V, ...), NaN where a view does not see a cell."""
    tally = Tally(*np.zeros((3, *stack.shape[1:])))
    for values in stack:  # one after the other: all of them in float64 may be too much
        seen = np.isfinite(values)
        known = np.where(seen, values, 0).astype(np.float64)
        for sums, more in zip(tally, (seen, known, known**2), strict=True):
            sums += more
    return tally


def agreement(stack: np.ndarray, fewest_views: int = FEWEST_VIEWS) -> float:
    """The :func:`correlation` of maps (V, ...), NaN where a view does not see a cell."""
    return correlation(tally_of(stack), fewest_views)


def correlation(tally: Tally, fewest_views: int = FEWEST_VIEWS) -> float:
    """How alike the views' values are in the same cell: the intraclass correlation.

    One-way analysis of variance with cells as groups: 1 when the views agree wholly, near 0 when a
    cell says nothing about its values, whatever the number of views per cell. Cells that fewer
    than `fewest_views` see do not count. 0 when nothing varies or too little is shared.
    """
    shared = tally.votes >= fewest_views
    votes, total, squares = (sums[shared] for sums in tally)
    if votes.size < 2:
        return 0.0
    values, mean = votes.sum(), total / votes
    between = (votes * (mean - total.sum() / values) ** 2).sum() / (votes.size - 1)
    within = max(float((squares - total * mean).sum()), 0.0) / (values - votes.size)
    per_cell = (values - (votes**2).sum() / values) / (votes.size - 1)
    whole = between + (per_cell - 1) * within
    return float((between - within) / whole) if whole > 0 else 0.0
