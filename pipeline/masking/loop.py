"""The loop: where a fitted scene and the photos disagree on the glass, the masks are redrawn."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from pipeline.masking.glass import Glass, GlassCamera, PaneGlass
from pipeline.masking.seek import Seeker, Wish, cover, describe, shown
from pipeline.masking.sweep import Found
from pipeline.masking.views import RedrawnViews, attention_on_glass, changed_share, redraw_views
from pipeline.masking.window import alike_by_distance, alike_on_pane, chosen_window

log = logging.getLogger(__name__)

# The residual (H, W) of every view, None where it was not fitted, for given drop masks and glass.
Look = Callable[[Sequence[np.ndarray], Found], Sequence[np.ndarray | None]]
Window = int | Literal["auto"]
STEADY = 0.6  # agreement on a pane, once aligned, from which gathering gains more than it blurs
CLEAR = 0.6  # agreement of the residual on the glass from which it adds to what the attention told


OUT_OF_REACH = (
    "no plane is within reach: the photos were taken from one place, or from too far apart"
)


class Round(NamedTuple):
    """The state after a round: round 0 is the start, before any fit.

    `found` is the glass that the round went by, `window` the number of neighbouring photos that it
    gathered over (0: all), `changed` the share of pixels whose mask it changed, `redrawn` what the residual
    said (None for the start).
    """

    drop_masks: list[np.ndarray]
    found: Found
    window: int
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
    mode: Wish = "auto",
    agreement: float = 0.3,
    use_attention: bool = True,
    gather_attention: bool = True,
    quantile: float = 0.5,
    window: Window = "auto",
    dilation: int = 0,
    contrast: float = 2.0,
    settled: float = 0.002,
) -> Repaired:
    """Drop masks repaired from a scene that is fitted anew with them, round after round.

    `look` fits the scene to what the masks leave and returns the residuals. The glass is found from
    the `attentions`, and again from the residuals unless the attention showed a pane; `mode` lens or
    pane is taken on trust. With `gather_attention` the loop starts from the attention gathered there
    (the general form of equation 5). The loop ends early when fewer than the share `settled` of the pixels
    change, and keeps the masks that it had when `mode` is pane and none is within reach, when the residual
    shows no glass, when it agrees there less than is needed to add to the attention (a poor field disagrees
    everywhere), or when the disagreement inside the new masks is not `contrast` times that outside. `window`
    auto: see `chosen_window`. Other parameters as in `redraw_views`.
    """
    told = attentions if use_attention else None
    seeker = Seeker(cameras, farthest, agreement, mode)
    found, glass = seeker.first(attentions)
    width = _width(window, found, glass, attentions, cameras)
    masks, doubt = list(drop_masks), ""
    if mode == "pane" and found.pane_from_world is None:
        doubt = f"refine.mode is pane, but {OUT_OF_REACH}"
    if use_attention and isinstance(glass, PaneGlass) and (c := cover(glass, attentions)) < STEADY:
        doubt = f"the views do not cover each other well enough on the pane ({c:.2f})"
    if gather_attention and found.mode != "none" and not doubt:
        masks = attention_on_glass(glass, attentions, masks, width, dilation)
    done = [Round(masks, found, width, changed_share(drop_masks, masks), None)]
    redrawn_on = partial(redraw_views, quantile=quantile, attentions=told, dilation=dilation)
    while not doubt and len(done) <= rounds:
        old = done[-1].drop_masks
        residuals = look(old, found)
        found, glass = seeker.again(residuals, (found, glass), told)
        if doubt := _doubt(found, use_attention):
            break
        if told is None or found.mode != done[-1].found.mode:  # else the same maps tell the same
            maps = residuals if told is None else told
            width = _width(window, found, glass, maps, cameras)
        redrawn = redrawn_on(glass, residuals, old, width=width)
        if doubt := _faint(redrawn.contrast, contrast):
            break
        changed = changed_share(old, redrawn.drop_masks)
        done.append(Round(redrawn.drop_masks, found, width, changed, redrawn))
        log.info("round %d: %s, %.1f %% masked, %.2f %% of the pixels changed", len(done) - 1,
                 describe(found), 100 * np.mean(redrawn.drop_masks), 100 * changed)  # fmt: skip
        if changed < settled:
            return Repaired(done, "the masks have settled")
    return Repaired(done, doubt or "all rounds were made")


def _width(
    window: Window,
    found: Found,
    glass: Glass,
    maps: Sequence[np.ndarray | None],
    cameras: Sequence[GlassCamera],
) -> int:
    """The window in photos, 0 for all; auto looks how far apart `maps` still agree on the glass."""
    if window != "auto":
        return window
    if isinstance(glass, PaneGlass):
        return chosen_window(alike_on_pane(glass, maps))
    return chosen_window(alike_by_distance(maps, cameras)) if found.mode == "lens" else 0


def _faint(contrast: float, least: float) -> str:
    """Why new masks are not believed when the disagreement on them is `contrast` times the rest's."""
    if math.isnan(contrast):
        return "there is too little to tell drops from the rest by"
    return f"the disagreement is only {contrast:.1f} times as large on it" * (contrast < least)


def _doubt(found: Found, use_attention: bool) -> str:
    """Why the residual is not believed before any mask is redrawn from it; empty when it is."""
    if found.mode == "none":
        return "what disagrees with the scene does not stay on any glass"
    if use_attention and shown(found) < CLEAR:
        return f"the residual agrees too little {describe(found)}"
    return ""
