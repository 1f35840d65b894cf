"""The loop: where a fitted scene and the photos disagree on the glass, the masks are redrawn."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from pipeline.masking.align import aligned
from pipeline.masking.glass import (
    Glass,
    GlassCamera,
    LensGlass,
    PaneGlass,
    gather,
    neighbours,
)
from pipeline.masking.masks import automatic_threshold, dilate, threshold
from pipeline.masking.remask import Redrawn, redraw
from pipeline.masking.sweep import Found, agreement_on, find_glass
from pipeline.masking.sweep import agreement as agreement_of

log = logging.getLogger(__name__)

# The residual (H, W) of every view, None where it was not fitted, for given drop masks and glass.
Look = Callable[[Sequence[np.ndarray], Found], Sequence[np.ndarray | None]]
FEWEST_ON_PANE = 2  # votes, without attention; with it a single view's residual has its say too
SHARE_ON_LENS = 0.25
MEANS = 0.6  # of the threshold of single maps: a mean seldom reaches their heights
STEADY = 0.6  # agreement on a pane, once aligned, from which gathering gains more than it blurs
CLEAR = 0.6  # agreement of the residual on the glass from which it adds to what the attention told
OFF = 25  # the longer side over this: how far poses may put a view off on the pane
SURROUNDINGS = 20  # the longer side over this: how far around a place counts as its surroundings


class Round(NamedTuple):
    """The state after a round: round 0 is the start, before any fit.

    `found` is the glass that the round went by, `changed` the share of pixels whose mask it changed,
    `redrawn` what the residual said (None for the start).
    """

    drop_masks: list[np.ndarray]
    found: Found
    changed: float
    redrawn: RedrawnViews | None


class Repaired(NamedTuple):
    """All rounds, first to last, and why there are no more."""

    rounds: list[Round]
    ended: str


def repair(
    look: Look,
    attentions: Sequence[np.ndarray],
    cameras: Sequence[GlassCamera],
    drop_masks: Sequence[np.ndarray],
    farthest: float,
    *,
    rounds: int,
    mode: Literal["auto", "lens", "pane"] = "auto",
    agreement: float = 0.3,
    use_attention: bool = True,
    gather_attention: bool = True,
    quantile: float = 0.5,
    window: int = 0,
    dilation: int = 0,
    contrast: float = 2.0,
    settled: float = 0.002,
) -> Repaired:
    """Drop masks repaired from a scene that is fitted anew with them, round after round.

    `look` fits the scene to what the masks leave and returns the residuals. The glass is found from
    the `attentions`, and again from the residuals unless the attention showed a pane; `mode` lens or
    pane is taken on trust. With `gather_attention` the loop starts from the attention gathered there
    (the general form of equation 5). The loop ends early when fewer than the share `settled` of the
    pixels change, and keeps the masks that it had when the residual shows no glass, when it agrees
    there less than is needed to add to the attention (a poor field disagrees everywhere), or when the
    disagreement inside the new masks is not `contrast` times that outside. Other parameters as in
    `redraw_views`.
    """
    found = _chosen(find_glass(attentions, cameras, farthest, at_least=agreement), mode)
    masks = list(drop_masks)
    glass = _glass(found, cameras, attentions)
    if use_attention and isinstance(glass, PaneGlass):
        stack = np.stack([glass.from_view(view, seen) for view, seen in enumerate(attentions)])
        if (steady := agreement_of(stack)) < STEADY:
            why = f"the views do not cover each other well enough on the pane ({steady:.2f})"
            return Repaired([Round(masks, found, 0.0, None)], why)
    if gather_attention and found.mode != "none":
        t = MEANS * automatic_threshold(attentions)
        masks = attention_on_glass(glass, attentions, masks, t, window, dilation)
    done = [Round(masks, found, changed_share(drop_masks, masks), None)]
    while len(done) <= rounds:
        residuals = look(done[-1].drop_masks, found)
        if not (use_attention and isinstance(glass, PaneGlass)):
            found = _look_again(residuals, cameras, farthest, agreement, found, mode)
            glass = _glass(found, cameras, attentions if use_attention else residuals)
        if isinstance(glass, PaneGlass):
            found = found._replace(pane_agreement=agreement_on(glass, residuals))
        if found.mode == "none":
            return Repaired(done, "what disagrees with the scene does not stay on any glass")
        if use_attention and _agreement(found) < CLEAR:
            return Repaired(done, f"the residual agrees too little {describe(found)}")
        fitted = sum(values is not None for values in residuals)
        redrawn = redraw_views(
            glass,
            residuals,
            done[-1].drop_masks,
            quantile=quantile,
            attentions=attentions if use_attention else None,
            fewest_votes=_fewest(found, min(window or fitted, fitted), use_attention),
            width=window,
            dilation=dilation,
        )
        if not redrawn.contrast >= contrast:
            return Repaired(
                done, f"the disagreement is only {redrawn.contrast:.1f} times as large on it"
            )
        changed = changed_share(done[-1].drop_masks, redrawn.drop_masks)
        done.append(Round(redrawn.drop_masks, found, changed, redrawn))
        log.info("round %d: %s, %.1f %% masked, %.2f %% of the pixels changed", len(done) - 1,
                 describe(found), 100 * np.mean(redrawn.drop_masks), 100 * changed)  # fmt: skip
        if changed < settled:
            return Repaired(done, "the masks have settled")
    return Repaired(done, "all rounds were made")


def describe(found: Found) -> str:
    """The glass in words."""
    if found.mode == "pane":
        tilts = f"tilted {found.tilt_x_deg:.1f} and {found.tilt_y_deg:.1f} degrees"
        return (
            f"on a pane {found.distance:.3g} away, {tilts} (agreement {found.pane_agreement:.2f})"
        )
    if found.mode == "lens":
        return f"on the lens (agreement {found.lens_agreement:.2f})"
    return f"no glass (agreement {max(found.lens_agreement, found.pane_agreement):.2f})"


def _agreement(found: Found) -> float:
    """How well the views agree on the glass that was found."""
    return found.pane_agreement if found.mode == "pane" else found.lens_agreement


def _look_again(
    residuals: Sequence[np.ndarray | None],
    cameras: Sequence[GlassCamera],
    farthest: float,
    agreement: float,
    before: Found,
    mode: Literal["auto", "lens", "pane"],
) -> Found:
    """The glass from the residuals, near the pane that was found before if there was one."""
    known = [(v, camera) for v, camera in zip(residuals, cameras, strict=True) if v is not None]
    start = (before.distance, before.tilt_x_deg, before.tilt_y_deg)
    found = find_glass(
        [values for values, _ in known],
        [camera for _, camera in known],
        farthest,
        at_least=agreement,
        start=start if before.mode == "pane" else None,
    )
    return _chosen(found, mode)


def _chosen(found: Found, mode: Literal["auto", "lens", "pane"]) -> Found:
    if mode == "auto" or (mode == "pane" and found.pane_from_world is None):
        return found
    return found._replace(mode=mode)


def _glass(
    found: Found, cameras: Sequence[GlassCamera], maps: Sequence[np.ndarray | None]
) -> Glass:
    """The glass that was found; on a pane the views are brought to cover by their `maps`."""
    if found.mode == "pane" and found.pane_from_world is not None:
        glass = PaneGlass(found.pane_from_world, cameras)
        glass.moved = aligned(glass, maps, max(cameras[0].width, cameras[0].height) / OFF)
        return glass
    return LensGlass(cameras[0].height, cameras[0].width)


def _fewest(found: Found, views: int, use_attention: bool) -> int:
    if found.mode == "pane":
        return 1 if use_attention else FEWEST_ON_PANE
    return max(2, round(SHARE_ON_LENS * views))


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
    fewest_votes: int,
    attentions: Sequence[np.ndarray] | None = None,
    width: int = 0,
    dilation: int = 0,
) -> RedrawnViews:
    """Every view's drop mask redrawn from the `residuals` (None: a view that was not fitted).

    On the glass each cell takes the `quantile` of the residuals over its views; cells with fewer
    than `fewest_votes` keep what the old masks say. The `attentions` of all views, gathered likewise, have
    their say (see `redraw`). With a `width` above 0 a view takes the part of
    its `width` neighbours only: drops may creep. The new masks are grown by `dilation` pixels.
    """
    count = len(drop_masks)
    cache: dict[range, Redrawn] = {}

    def redrawn(views: range) -> Redrawn:
        if views not in cache:
            gathered, votes = gather(glass, residuals, views, quantile)
            old, _ = gather(glass, [m.astype(np.float32) for m in drop_masks], views, None)
            seen = None if attentions is None else gather(glass, attentions, views, None)[0]
            reach = max(drop_masks[0].shape) / SURROUNDINGS
            previous = np.nan_to_num(old) > 0.5
            cache[views] = redraw(
                gathered, votes, previous, fewest_votes, reach=reach, attention=seen
            )
        return cache[views]

    fresh, known = [], []
    for view, old in enumerate(drop_masks):
        found = redrawn(neighbours(count, view, width))
        share = glass.to_view(view, found.drop_mask.astype(np.float32))
        fresh.append(dilate(np.where(np.isfinite(share), share > 0.5, old), dilation))
        known.append(np.nan_to_num(glass.to_view(view, found.known.astype(np.float32))).mean())
    facts = list(cache.values())
    gathered, _ = gather(glass, residuals, range(count), quantile)
    return RedrawnViews(
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
        views = neighbours(count, view, width)
        if views not in cache:
            cache[views] = gather(glass, attentions, views, None)[0]
        mean = glass.to_view(view, cache[views])
        fresh.append(np.where(np.isfinite(mean), dilate(threshold(mean, t), dilation), old))
    return fresh


def changed_share(old: Sequence[np.ndarray], new: Sequence[np.ndarray]) -> float:
    """The share of pixels, over all views, whose mask changed."""
    return float(np.mean([(a != b).mean() for a, b in zip(old, new, strict=True)]))
