"""Lenses that `ingest` took away, kept with the images so that what belongs to their photos can follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.io.given import GivenView, Straightener
from pipeline.io.scene import Lens, Pinhole


def lens_of(straighten: Straightener) -> Lens:
    """The lens that `straighten` takes away."""
    bent = straighten.bent
    return Lens(
        width=bent.width,
        height=bent.height,
        bent=_pinhole(bent),
        distortion=bent.distortion,
        fisheye=bent.fisheye,
        straight=_pinhole(straighten.straight),
    )


def straightener(lens: Lens) -> Straightener:
    """What takes the pixels of a photo, or of what lies over it, to those of its image, at any scale."""
    bent = _view(lens, lens.bent, lens.distortion, lens.fisheye)
    return Straightener(bent, _view(lens, lens.straight, (), False))


def _pinhole(view: GivenView) -> Pinhole:
    return Pinhole(view.fx, view.fy, view.cx, view.cy)


def _view(lens: Lens, hole: Pinhole, distortion: tuple[float, ...], fisheye: bool) -> GivenView:
    pose = np.eye(4)  # of no account: pixels move within their photo
    return GivenView(
        Path(), pose, lens.width, lens.height, hole.fx, hole.fy, hole.cx, hole.cy, distortion, fisheye
    )  # fmt: skip
