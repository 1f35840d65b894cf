"""Drop masks from attention maps (paper, equations 3 and 5)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

AUTOMATIC = (0.2, 0.6)
MUCH = 0.6  # of the pixels: the user is asked whether so many can be wet


def threshold(attention: np.ndarray, t: float) -> np.ndarray:
    """The (H, W) drop mask M(u, v) = f(A(u, v), t) of equation 3: True where the attention exceeds t."""
    return attention > t


class Together(NamedTuple):
    """Attention maps of one size pixel by pixel: how many they are, in how many it exceeds t, their mean.

    `votes` (H, W) float64; `mean` (H, W) float32 is the sum over A_i / n in equation 5.
    """

    views: int
    votes: np.ndarray
    mean: np.ndarray


def together(attentions: Iterable[np.ndarray], t: float) -> Together:
    """What the maps say together of each pixel; they are looked at once, one after the other."""
    count, votes, total = 0, np.zeros(()), np.zeros(())
    for attention in attentions:
        count += 1
        votes = votes + threshold(attention, t)
        total = total + attention
    if not count:
        raise ValueError("the mean of no attention maps does not exist")
    return Together(count, votes, (total / count).astype(np.float32))


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


def otsu(values: np.ndarray, bins: int = 256, weights: np.ndarray | None = None) -> float:
    """The threshold that parts values (N,) into the two classes with the least variance within.

    Otsu 1979, doi:10.1109/TSMC.1979.4310076, on a histogram; `weights` (N,): how often each value occurs.
    The largest value where there is nothing to part: where they are equal, or so alike that their floats
    do not know `bins` steps between them.
    """
    low, high = float(values.min()), float(values.max())
    steps = np.linspace(low, high, bins + 1, dtype=np.result_type(low, high, values))
    if (steps[1:] <= steps[:-1]).any():
        return high
    counts, edges = np.histogram(values, bins=bins, range=(low, high), weights=weights)
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


def automatic_threshold(attentions: Iterable[np.ndarray]) -> float:
    """t between 0.2 and 0.6 that parts the maps' values best (Otsu), rounded to two digits.

    The paper chooses t between 0.2 and 0.4 by hand. The bounds hold where there is nothing to part:
    maps of dry glass have no second class. The maps are looked at once, one after the other: what is kept
    of them is how often each value occurs, of which half precision knows few.
    """
    values: np.ndarray = np.zeros(0, np.float32)
    counts: np.ndarray = np.zeros(0)
    for attention in attentions:
        more, occur = np.unique(attention, return_counts=True)
        values, place = np.unique(np.concatenate([values, more]), return_inverse=True)
        counts = np.bincount(place, np.concatenate([counts, occur]))
    return round(float(np.clip(otsu(values, weights=counts), *AUTOMATIC)), 2)


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


def lens_fixedness(maps: Together) -> float:
    """How much better the maps agree per pixel than chance would have it, at most 1.

    For masks that never move, the chance that a pixel marked in one view is
    marked in another is 1; for masks unrelated between views it is their density p. Returned is
    (agreement - p) / (1 - p), from all pairs of views at once; 0 when nothing, or everything, is marked.
    """
    count, votes = maps.views, maps.votes
    if count < 2:
        return 0.0
    density = votes.mean() / count
    if density in (0.0, 1.0):
        return 0.0
    # sum over pixels of ordered pairs of views in which both mark it / ordered pairs in which the first does
    agreement = float((votes * (votes - 1)).sum() / (votes.sum() * (count - 1)))
    return float((agreement - density) / (1.0 - density))


def chosen_threshold(attentions: Iterable[np.ndarray], wish: float | str) -> tuple[float, str]:
    """The threshold t, and where it comes from: `wish`, or with "auto" `automatic_threshold`."""
    if isinstance(wish, str):
        return automatic_threshold(attentions), "auto: where the maps' values part best"
    return wish, "masks.threshold"


def on_the_lens(maps: Together | None, wish: str, agree_from: float) -> tuple[bool, str]:
    """Whether equation 5 holds, and why: `wish` is "on", "off", or "auto", which the `maps` decide.

    auto: drops are on the lens when `lens_fixedness` is at least `agree_from`.
    """
    if wish != "auto" or maps is None:
        return wish == "on", f"masks.temporal_mean is {wish}"
    agreement = lens_fixedness(maps)
    sign = ">=" if agreement >= agree_from else "<"
    return (
        agreement >= agree_from,
        f"the maps agree to {agreement:.2f} {sign} {agree_from:g} per pixel",
    )


def said(share: float, whole: Sequence[str], given: bool, folder: Path) -> list[str]:
    """What the user should hear of masks that drop `share` of the pixels, and all of the images `whole`.

    `given`: they came with the photos; the `folder` holds them.
    """
    less = "set masks.use_given: false" if given else "lower masks.threshold"
    told = [f"{name} is masked entirely and will teach the scene nothing" for name in whole]
    if share == 0:
        told.append(f"no drops were found in any image; {less} if there are some")
    elif share > MUCH:
        told.append(
            f"{100 * share:.0f} % of the pixels are masked, little is left to learn from: look at {folder}; "
            f"where dry glass is masked, {less.replace('lower', 'raise')}, else wipe the glass and take "
            "the photos again"
        )
    return told
