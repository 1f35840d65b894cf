"""Mean and spread over seeds, and when one row may be called better than another."""

from __future__ import annotations

import math
from collections.abc import Sequence


def mean(values: Sequence[float]) -> float:
    """The arithmetic mean; ValueError without values."""
    if not values:
        raise ValueError("no values to average")
    return math.fsum(values) / len(values)


def spread(values: Sequence[float]) -> float | None:
    """The sample standard deviation (divisor n - 1); None for fewer than two values."""
    if len(values) < 2:
        return None
    centre = mean(values)
    return math.sqrt(math.fsum((v - centre) ** 2 for v in values) / (len(values) - 1))


def better_beyond_spread(
    values: Sequence[float], others: Sequence[float], *, higher: bool = True
) -> bool:
    """Whether the mean of `values` is ahead of that of `others` by more than both spreads together.

    A single value counts as without spread. Of two single values nothing is claimed: how much
    chance is in them is unknown.
    """
    spreads = [spread(values), spread(others)]
    if not values or not others or all(one is None for one in spreads):
        return False
    ahead = mean(values) - mean(others) if higher else mean(others) - mean(values)
    return ahead > sum(one or 0.0 for one in spreads)
