"""A generator whose draws depend on what is asked for alone, not on the order of asking."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

# How far aside what is bell-shaped lies, in deviations: of the three colours, and of all else as of red.
ASIDE = np.array([1.0, -0.5, 0.3])


class Answers:
    """Stands for a numpy Generator where two ways draw the same things in different orders.

    place: what `random` draws, in [0,1); numbers of a range lie at that part of it.
    """

    def __init__(self, place: float) -> None:
        self.place = place

    def random(self, size: Any = ()) -> Any:
        return self.uniform(0, 1, size)

    def uniform(self, low: float, high: float, size: Any = ()) -> Any:
        return np.full(size, low + self.place * (high - low))[()]

    def integers(self, low: int, high: int | None = None, size: Any = ()) -> Any:
        low, high = (0, low) if high is None else (low, high)
        return np.full(size, low + int(self.place * (high - low)))[()]

    def normal(self, mean: float, deviation: float, size: Any = ()) -> Any:
        """Three at an axis of `size` are the three colours."""
        values = np.full(size, ASIDE[0])
        if 3 in values.shape:
            values = values / ASIDE[0] * (ASIDE if values.shape[-1] == 3 else ASIDE[:, None])
        return (mean + deviation * values)[()]

    def permutation(self, count: int) -> np.ndarray:
        return np.roll(np.arange(count), 1)

    def standard_normal(self, size: Any, dtype: Any = np.float64) -> np.ndarray:
        return np.ones(size, dtype)

    def choice(self, count: int, p: Any = None) -> int:
        return int(self.place * count)

    def binomial(self, count: int, share: float) -> int:
        return round(count * share)

    def multinomial(self, count: int, shares: np.ndarray) -> np.ndarray:
        return np.eye(len(shares), dtype=int)[0] * count


def answers(place: float) -> np.random.Generator:
    """`Answers` for what is typed as a Generator."""
    return cast(np.random.Generator, Answers(place))
