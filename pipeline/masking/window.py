"""How many neighbouring photos show the drops in the same place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.masking.glass import GlassCamera, PaneGlass
from pipeline.masking.sweep import FINE, prepared, stack_on

HOLDS = 0.9  # of the agreement of neighbours: less is not the same place any more
NEIGHBOURS = 0.5  # agreement of neighbours from which their order means something
FEWEST_PHOTOS = 8  # fewer show no trend
LEAST_SHARED = 0.05  # of what a photo sees of a pane: photos that share less of it say nothing
FEWEST_PAIRS = 12  # of photos that share so much
SURE = 3.0  # standard errors by which likeness must fall with the distance in order
OWN_WAY = 1.0  # photos by which distances in order must differ at equal overlap


def alike_by_distance(
    maps: Sequence[np.ndarray | None], cameras: Sequence[GlassCamera]
) -> np.ndarray:
    """How alike maps are that lie 1, 2, ... apart in their order: (V - 1,) mean correlations.

    Pixel by pixel, at a smaller size and without broad gradients. None for views without a map; NaN in a
    map has no vote; NaN comes out where no two maps lie that far apart.
    """
    known = [view for view, values in enumerate(maps) if values is not None]
    small, _ = prepared([v for v in maps if v is not None], [cameras[view] for view in known], FINE)
    flat = np.stack(small).reshape(len(small), -1)
    alike = _correlations(flat)
    apart = np.abs(np.subtract.outer(known, known))
    found = np.full(len(maps) - 1, np.nan)
    for distance in range(1, len(maps)):
        values = alike[(apart == distance) & np.isfinite(alike)]
        if values.size:
            found[distance - 1] = values.mean()
    return found


def alike_on_pane(glass: PaneGlass, maps: Sequence[np.ndarray | None]) -> np.ndarray:
    """How alike maps are on a pane that lie 1, 2, ... apart in their order, were their overlap the same.

    Photos far apart in order mostly look at the pane from other places as well, and agree less for that
    alone: see `at_equal_overlap`, of all pairs that share a place. Up to the farthest apart of these.
    """
    known = np.flatnonzero([values is not None for values in maps])
    flat = stack_on(glass, maps).reshape(len(known), -1)
    seen = np.isfinite(flat).astype(np.float32)
    shared = seen @ seen.T
    shared /= max(float(np.diag(shared).mean()), 1.0)
    pairs = np.triu_indices(len(known), 1)
    alike, overlap = _correlations(flat)[pairs], shared[pairs]
    apart = known[pairs[1]] - known[pairs[0]]
    used = (overlap >= LEAST_SHARED) & np.isfinite(alike)
    return at_equal_overlap(alike[used], apart[used], overlap[used])


def at_equal_overlap(alike: np.ndarray, apart: np.ndarray, overlap: np.ndarray) -> np.ndarray:
    """The likeness of photos 1, 2, ... apart in order, of pairs (N,) with their overlap: a straight line.

    Likeness is fitted by a constant, the overlap and the distance in order, pairs with more overlap
    weighing more; the line is that of the mean overlap. It is level where the fall with the order is not
    `SURE`, or where the order goes with the place, as on a walk along the pane: nobody can tell then.
    Empty of too few pairs.
    """
    if len(alike) < FEWEST_PAIRS:
        return np.zeros(0)
    weights = overlap / overlap.sum()
    left, own_way = (_without(overlap, values, weights) for values in (alike, apart))
    spread = max(float(weights @ own_way**2), 1e-12)
    fall = float(weights @ (left * own_way)) / spread
    error = float(weights @ (left - fall * own_way) ** 2) / (len(alike) - 3) / spread
    if spread < OWN_WAY**2 or fall + SURE * error**0.5 > 0:
        fall = 0.0
    near = float(weights @ alike) - fall * float(weights @ apart)
    return near + fall * np.arange(1, int(apart.max()) + 1)


def chosen_window(alike: np.ndarray) -> int:
    """Over how many neighbouring photos drops stay in place, odd; 0: over all of them.

    `alike` as from `alike_by_distance` or `alike_on_pane`. Drops that stay, and photos without order, are
    as alike far apart as side by side; where neighbours hardly agree, order means nothing. Where photos in
    the farther half of the distances agree less than `HOLDS` of what neighbours do, the window reaches
    half as far to either side of its middle as the nearest photos that agree less than that lie apart; its
    ends may lie as far apart as these.
    """
    count = len(alike) + 1
    if count < FEWEST_PHOTOS or not alike[0] >= NEIGHBOURS:  # NaN too
        return 0
    least = HOLDS * alike[0]
    far = alike[count // 2 - 1 :]
    if not np.isfinite(far).any() or np.nanmean(far) >= least:
        return 0
    first_less = int(np.flatnonzero(alike < least)[0]) + 1
    width = 2 * (first_less // 2) + 1
    return width if width < count else 0


def _without(overlap: np.ndarray, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """What a constant and `overlap` leave of `values` (N,), fitted with `weights` that add up to 1."""
    off, other = overlap - weights @ overlap, values - weights @ values
    return other - float(weights @ (off * other)) / max(float(weights @ off**2), 1e-12) * off


def _correlations(flat: np.ndarray) -> np.ndarray:
    """(V, V): the correlation of rows (V, N) over the columns that both know; NaN where undefined."""
    seen = np.isfinite(flat).astype(np.float64)
    values = np.nan_to_num(flat).astype(np.float64)
    count = seen @ seen.T
    with np.errstate(divide="ignore", invalid="ignore"):
        own, other = values @ seen.T / count, seen @ values.T / count
        square = (values**2) @ seen.T / count - own**2
        other_square = seen @ (values**2).T / count - other**2
        return (values @ values.T / count - own * other) / np.sqrt(square * other_square)
