"""Pinholes for views through lenses, so that readers who know no distortion can be served."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import UserError
from pipeline.io.given import Straightener, of_view
from pipeline.io.transforms import View

log = logging.getLogger(__name__)

STEPS = 40
WIDEST, NARROWEST = 0.25, 64.0  # focal lengths that are tried, in those of the lens
MOST_CUT = 0.6  # of a photo that shows less than this share is told


@dataclass(frozen=True)
class Pinholes:
    """Views without distortion by name, and what takes the pixels of their photos there."""

    views: Mapping[str, View]
    straighteners: Mapping[str, Straightener]

    def rgb(self, name: str, pixels: np.ndarray) -> np.ndarray:
        """The photo (H, W, 3) in [0, 1] as its pinhole shows it."""
        return np.clip(self.straighteners[name](pixels), 0.0, 1.0)

    def keep(self, name: str, keep_mask: np.ndarray) -> np.ndarray:
        """Its keep mask (H, W)."""
        return self.straighteners[name](keep_mask.astype(np.uint8)) > 0


def pinholes(bent: Sequence[View], straight: Mapping[str, View]) -> Pinholes:
    """The views `straight` (by name) with what takes the pixels of the views `bent` to theirs."""
    takes = {view.name: Straightener(of_view(view), of_view(straight[view.name])) for view in bent}
    return Pinholes(straight, takes)


def own_pinholes(views: Sequence[View]) -> dict[str, View]:
    """The views by name without distortion, each with its own principal point; equal lenses stay equal.

    A view without distortion stays as it is. Others are zoomed as far as needed for their pictures to be
    covered wholly: nothing is made up at the borders. UserError when no zoom does.
    """
    zooms: dict[tuple[float, ...], float] = {}
    for view in views:
        lens = (*view.intrinsics, float(view.width), float(view.height))
        if lens not in zooms:
            zooms[lens] = 1.0 if view.k1 == 0 else _own_zoom(view)
    straight = {}
    for view in views:
        zoom = zooms[(*view.intrinsics, float(view.width), float(view.height))]
        straight[view.name] = replace(view, fx=view.fx * zoom, fy=view.fy * zoom, k1=0.0)
    return straight


def _own_zoom(view: View) -> float:
    def covered(zoom: float) -> bool:
        return _covered(view, replace(view, fx=view.fx * zoom, fy=view.fy * zoom))

    zoom = _least(covered, WIDEST, NARROWEST)
    if zoom is None:
        raise UserError(
            f"the lens of {view.name} cannot be straightened: {_off_centre(view)}.",
            "nerfstudio/ takes it as it is: export.formats: [nerfstudio].",
        )
    return zoom


def common_pinholes(views: Sequence[View]) -> dict[str, View]:
    """The views by name with one focal length, the principal point in the middle, no distortion.

    The focal length is the smallest that every view's picture covers wholly: nothing is made up at
    the borders. UserError when none does; ValueError when the views are of several sizes.
    """
    if len({(view.width, view.height) for view in views}) != 1:
        raise ValueError("one pinhole serves views of one size")

    def pinhole(view: View, focal: float) -> View:
        return replace(view, fx=focal, fy=focal, cx=view.width / 2, cy=view.height / 2, k1=0.0)

    def covered(focal: float) -> bool:
        return all(_covered(view, pinhole(view, focal)) for view in views)

    longest = max(view.fx for view in views)
    focal = _least(covered, WIDEST * longest, NARROWEST * longest)
    if focal is None:
        worst = max(views, key=_eccentricity)
        raise UserError(
            f"one pinhole cannot serve all photos, as LLFF's readers want it: {_off_centre(worst)}.",
            "nerfstudio/ and colmap/ give each camera its own: export.formats: [nerfstudio, colmap].",
        )
    return {view.name: pinhole(view, focal) for view in views}


def _off_centre(view: View) -> str:
    return (
        f"the optical axis of {view.name} meets its picture of {view.width}x{view.height} at "
        f"({view.cx:.0f}, {view.cy:.0f}), at the edge or outside"
    )


def _eccentricity(view: View) -> float:
    """How far the optical axis is from the middle of the picture: 1 at the edge."""
    across, down = 2 * view.cx / view.width - 1, 2 * view.cy / view.height - 1
    return max(abs(across), abs(down))


def _least(covered: Callable[[float], bool], low: float, high: float) -> float | None:
    """The smallest number between `low` and `high` from which on `covered` holds; None: not at `high`."""
    if not covered(high):
        return None
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        if covered(middle):
            high = middle
        else:
            low = middle
    return high


def _covered(view: View, pinhole: View) -> bool:
    """Whether `view` sees all that a `pinhole` at its place, of its size, would show."""
    edge = _edge(view, pinhole)
    if edge is None:
        return False
    return bool((edge >= 0).all() and (edge <= [view.width, view.height]).all())


def _edge(view: View, pinhole: View) -> np.ndarray | None:
    """Where `view` sees the edge of the `pinhole`'s picture, pixels (N, 2) once around; None: nowhere."""
    way = np.linspace(0.0, 1.0, 32, endpoint=False)
    x = np.concatenate([way, np.ones(32), 1 - way, np.zeros(32)]) * pinhole.width
    y = np.concatenate([np.zeros(32), way, np.ones(32), 1 - way]) * pinhole.height
    rays = np.stack([(x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy], axis=1)
    r2 = (rays**2).sum(axis=1)
    if (1 + 3 * view.k1 * r2 <= 0).any():  # beyond, the lens model folds back
        return None
    return rays * (1 + view.k1 * r2)[:, None] * [view.fx, view.fy] + [view.cx, view.cy]


def kept_share(view: View, pinhole: View) -> float:
    """The share of `view`'s picture that a `pinhole` shows which it covers wholly."""
    edge = _edge(view, pinhole)
    if edge is None:
        raise ValueError(f"{view.name} does not cover the pinhole")
    x, y = edge.T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))
    return area / (view.width * view.height)


def tell_cut(where: str, views: Sequence[View], straight: Mapping[str, View], why: str) -> None:
    """Warns when the pinholes `straight` cut more than MOST_CUT leaves from any of the `views`' photos."""
    shares = {view.name: kept_share(view, straight[view.name]) for view in views}
    least = min(shares, key=lambda name: shares[name])
    if shares[least] < MOST_CUT:
        few = sum(share < MOST_CUT for share in shares.values())
        log.warning(
            "%s/ shows only %.0f %% of %s, and less than %.0f %% of %d photos: %s",
            where, 100 * shares[least], least, 100 * MOST_CUT, few, why,
        )  # fmt: skip
