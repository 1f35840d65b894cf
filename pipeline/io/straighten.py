"""One pinhole for all views of a scene, so that readers who know no distortion can be served."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.io.given import Straightener, of_view
from pipeline.io.transforms import View

STEPS = 40


def common_pinholes(views: Sequence[View]) -> dict[str, View]:
    """The views by name with one focal length, the principal point in the middle, no distortion.

    The focal length is the smallest that every view's picture covers wholly: nothing is made up at
    the borders. ValueError when the views are of several sizes.
    """
    if len({(view.width, view.height) for view in views}) != 1:
        raise ValueError("one pinhole serves views of one size")
    centre = max(view.fx for view in views)
    low, high = 0.25 * centre, 4.0 * centre
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        if all(_covered(view, middle) for view in views):
            high = middle
        else:
            low = middle
    return {
        view.name: replace(
            view, fx=high, fy=high, cx=view.width / 2, cy=view.height / 2, k1=0.0
        )
        for view in views
    }  # fmt: skip


def _covered(view: View, focal: float) -> bool:
    """Whether `view` sees all that a pinhole of its size with this focal length would show."""
    across = np.linspace(-0.5, 0.5, 33) * view.width / focal
    down = np.linspace(-0.5, 0.5, 33) * view.height / focal
    edge = np.concatenate(
        [
            np.stack(np.broadcast_arrays(across, side), axis=1)
            for side in (down[0], down[-1])
        ]
        + [np.stack(np.broadcast_arrays(side, down), axis=1) for side in (across[0], across[-1])]
    )  # fmt: skip
    r2 = (edge**2).sum(axis=1)
    if (1 + 3 * view.k1 * r2 <= 0).any():  # beyond, the lens model folds back
        return False
    bent = edge * (1 + view.k1 * r2)[:, None]
    u, v = bent[:, 0] * view.fx + view.cx, bent[:, 1] * view.fy + view.cy
    return bool(
        (u >= 0).all() and (v >= 0).all() and (u <= view.width).all() and (v <= view.height).all()
    )


def straighteners_to(
    views: Sequence[View], straight: Mapping[str, View]
) -> dict[str, Straightener]:
    """By name, what takes each view's pixels to its pinhole's."""
    return {view.name: Straightener(of_view(view), of_view(straight[view.name])) for view in views}
