"""How many neighbouring photos show the drops in the same place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.masking.glass import GlassCamera
from pipeline.masking.sweep import FINE, prepared

HOLDS = 0.9  # of the agreement of neighbours: less is not the same place any more
NEIGHBOURS = 0.5  # agreement of neighbours from which their order means something
FEWEST_PHOTOS = 8  # fewer show no trend


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


def chosen_window(alike: np.ndarray) -> int:
    """Over how many neighbouring photos drops stay in place, odd; 0: over all of them.

    `alike` as from `alike_by_distance`. Drops that stay, and photos without order, are as alike far apart
    as side by side; where neighbours hardly agree, order means nothing. Where photos in the farther half
    of the distances agree less than `HOLDS` of what neighbours do, the window is as wide as photos in it
    still agree to that.
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
