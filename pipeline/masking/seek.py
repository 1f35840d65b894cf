"""Where the glass is, sought first in the attention maps and then in the residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from pipeline.masking.agreement import correlation
from pipeline.masking.align import aligned
from pipeline.masking.glass import Glass, GlassCamera, LensGlass, PaneGlass
from pipeline.masking.sweep import Found, agreement_on, find_glass

Wish = Literal["auto", "lens", "pane"]
OFF = 25  # the longer side over this: how far poses may put a view off on the pane


class Seeker:
    """Finds the glass and brings the views to cover each other there.

    `farthest` and `at_least` as in `find_glass`; `wish` lens or pane is taken on trust, but for a pane where
    no plane is within reach.
    """

    def __init__(
        self, cameras: Sequence[GlassCamera], farthest: float, at_least: float, wish: Wish
    ) -> None:
        self.cameras, self.farthest, self.at_least, self.wish = cameras, farthest, at_least, wish

    def first(self, attentions: Sequence[np.ndarray]) -> tuple[Found, Glass]:
        """The glass as the attention maps show it."""
        found = find_glass(attentions, self.cameras, self.farthest, at_least=self.at_least)
        return self._on(self._granted(found), attentions)

    def again(
        self,
        residuals: Sequence[np.ndarray | None],
        before: tuple[Found, Glass],
        attentions: Sequence[np.ndarray] | None,
    ) -> tuple[Found, Glass]:
        """The glass as the residuals show it, unless the `attentions` (None: not used) showed a pane.

        A pane that they showed stays, and so do the views on it; told is then how well the
        residuals agree on it, and nothing of the lens (NaN), on which they were not looked at.
        """
        found, glass = before
        if attentions is None or not isinstance(glass, PaneGlass):
            found = self._look_again(residuals, found)
            found, glass = self._on(found, residuals if attentions is None else attentions)
        else:
            found = found._replace(lens_agreement=math.nan)
        if isinstance(glass, PaneGlass):
            found = found._replace(pane_agreement=agreement_on(glass, residuals))
        return found, glass

    def _look_again(self, residuals: Sequence[np.ndarray | None], before: Found) -> Found:
        """Near the pane that was found before, if there was one."""
        pairs = zip(residuals, self.cameras, strict=True)
        known = [(values, camera) for values, camera in pairs if values is not None]
        start = (before.distance, before.tilt_x_deg, before.tilt_y_deg)
        found = find_glass(
            [values for values, _ in known],
            [camera for _, camera in known],
            self.farthest,
            at_least=self.at_least,
            start=start if before.mode == "pane" else None,
        )
        return self._granted(found)

    def _granted(self, found: Found) -> Found:
        if self.wish == "auto":
            return found
        if self.wish == "pane" and found.pane_from_world is None:
            return found._replace(mode="none")
        return found._replace(mode=self.wish)

    def _on(
        self, found: Found, maps: Sequence[np.ndarray | None]
    ) -> tuple[Found, PaneGlass | LensGlass]:
        """The glass that was found; on a pane the views are brought to cover by their `maps`."""
        width, height = self.cameras[0].width, self.cameras[0].height
        if found.mode == "pane" and found.pane_from_world is not None:
            try:
                glass = PaneGlass(found.pane_from_world, self.cameras)
            except ValueError:  # some of the views agreed on it, but all together look elsewhere
                return found._replace(mode="none"), LensGlass(height, width)
            glass.moved = aligned(glass, maps, max(width, height) / OFF)
            return found, glass
        return found, LensGlass(height, width)


def cover(glass: PaneGlass, attentions: Sequence[np.ndarray]) -> float:
    """How well the views' attention agrees, cell by cell, on a pane on which they were brought to cover."""
    return correlation(glass.tally(attentions))


def shown(found: Found) -> float:
    """How well the views agree on the glass that was found."""
    return found.pane_agreement if found.mode == "pane" else found.lens_agreement


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
