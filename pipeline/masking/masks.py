"""Drop masks from attention maps (paper, equations 3 and 5)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

AUTOMATIC = (0.2, 0.6)


def threshold(attention: np.ndarray, t: float) -> np.ndarray:
    """The (H, W) drop mask M(u, v) = f(A(u, v), t) of equation 3: True where the attention exceeds t."""
    return attention > t


def temporal_mean(attentions: Iterable[np.ndarray]) -> np.ndarray:
    """The (H, W) float32 mean of n attention maps of one size, the sum over A_i / n in equation 5."""
    total: np.ndarray | None = None
    count = 0
    for attention in attentions:
        total = attention.astype(np.float64) if total is None else total + attention
        count += 1
    if total is None:
        raise ValueError("the mean of no attention maps does not exist")
    return (total / count).astype(np.float32)


def enhanced(attention: np.ndarray, mean_attention: np.ndarray, t: float) -> np.ndarray:
    """The (H, W) drop mask of equation 5: f(A, t) or f(mean A, t)."""
    return threshold(attention, t) | threshold(mean_attention, t)


def drop_mask_of(
    attention: np.ndarray, mean_attention: np.ndarray | None, t: float, mean_alone: bool = False
) -> np.ndarray:
    """The (H, W) drop mask of equation 3, or of equation 5 when there is a mean map.

    `mean_alone`: f(mean A, t) instead, for drops that never move; the view's own map adds noise then.
    """
    if mean_attention is None:
        return threshold(attention, t)
    return threshold(mean_attention, t) if mean_alone else enhanced(attention, mean_attention, t)


def otsu(values: np.ndarray, bins: int = 256) -> float:
    """The threshold that parts values (N,) into the two classes with the least variance within.

    Otsu 1979, doi:10.1109/TSMC.1979.4310076, on a histogram. The largest value where there is nothing to
    part: where they are equal, or so alike that their floats do not know `bins` steps between them.
    """
    low, high = float(values.min()), float(values.max())
    steps = np.linspace(low, high, bins + 1, dtype=np.result_type(low, high, values))
    if (steps[1:] <= steps[:-1]).any():
        return high
    counts, edges = np.histogram(values, bins=bins, range=(low, high))
    middle = 0.5 * (edges[1:] + edges[:-1])
    below = np.cumsum(counts).astype(np.float64)
    sums = np.cumsum(counts * middle)
    above = below[-1] - below
    with np.errstate(divide="ignore", invalid="ignore"):
        gap = sums / below - (sums[-1] - sums) / above
    between = np.nan_to_num(below * above * gap**2)[:-1]
    # Between two far clusters many thresholds are equally good: take their middle.
    best = np.flatnonzero(between >= between.max() * (1 - 1e-12))
    return float(edges[1:-1][best].mean())


def automatic_threshold(attentions: Sequence[np.ndarray]) -> float:
    """t between 0.2 and 0.6 that parts the maps' values best (Otsu), rounded to two digits.

    The paper chooses t between 0.2 and 0.4 by hand. The bounds hold where there is nothing to part:
    maps of dry glass have no second class.
    """
    values = np.concatenate([attention.ravel() for attention in attentions])
    return round(float(np.clip(otsu(values), *AUTOMATIC)), 2)


def dilate(drop_mask: np.ndarray, pixels: int) -> np.ndarray:
    """`drop_mask` grown by `pixels` in every direction (a disc); 0 leaves it as it is."""
    if pixels == 0:
        return drop_mask
    rows, columns = np.ogrid[-pixels : pixels + 1, -pixels : pixels + 1]
    disc = (rows**2 + columns**2 <= pixels**2).astype(np.uint8)
    return cv2.dilate(drop_mask.astype(np.uint8), disc).astype(bool)


def without_specks(drop_mask: np.ndarray, min_area: int) -> np.ndarray:
    """`drop_mask` without connected regions of fewer than `min_area` pixels (8-neighbourhood)."""
    if min_area <= 1:
        return drop_mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        drop_mask.astype(np.uint8), connectivity=8
    )
    large = stats[:, cv2.CC_STAT_AREA] >= min_area
    large[0] = False
    return large[labels]


def lens_fixedness(attentions: Sequence[np.ndarray], t: float) -> float:
    """How much better the maps agree per pixel than chance would have it, at most 1.

    Each map is thresholded at t. For masks that never move, the chance that a pixel marked in one view is
    marked in another is 1; for masks unrelated between views it is their density p. Returned is
    (agreement - p) / (1 - p), from all pairs of views at once; 0 when nothing, or everything, is marked.
    """
    count = len(attentions)
    if count < 2:
        return 0.0
    votes = np.zeros(attentions[0].shape, np.float64)
    for attention in attentions:
        votes += threshold(attention, t)
    density = votes.mean() / count
    if density in (0.0, 1.0):
        return 0.0
    # sum over pixels of ordered pairs of views in which both mark it / ordered pairs in which the first does
    agreement = float((votes * (votes - 1)).sum() / (votes.sum() * (count - 1)))
    return float((agreement - density) / (1.0 - density))


def chosen_threshold(attentions: Sequence[np.ndarray], wish: float | str) -> tuple[float, str]:
    """The threshold t, and where it comes from: `wish`, or with "auto" `automatic_threshold`."""
    if isinstance(wish, str):
        return automatic_threshold(attentions), "auto: where the maps' values part best"
    return wish, "masks.threshold"


def on_the_lens(
    attentions: Sequence[np.ndarray], t: float, wish: str, agree_from: float
) -> tuple[bool, str]:
    """Whether equation 5 holds, and why: `wish` is "on", "off", or "auto".

    auto: drops are on the lens when `lens_fixedness` at t is at least `agree_from`.
    """
    if wish != "auto":
        return wish == "on", f"masks.temporal_mean is {wish}"
    agreement = lens_fixedness(attentions, t)
    sign = ">=" if agreement >= agree_from else "<"
    return (
        agreement >= agree_from,
        f"the maps agree to {agreement:.2f} {sign} {agree_from:g} per pixel",
    )
