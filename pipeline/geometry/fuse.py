"""Depth maps to points: those that several views agree on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.cameras import intrinsic_matrix, project
from pipeline.geometry.poses import centre, invert

NEIGHBOURS = 8


@dataclass(frozen=True)
class DepthView:
    """A pinhole view: `depth` (H, W) along z, 0 where unknown; `rgb` (H, W, 3) uint8; its camera."""

    depth: np.ndarray
    rgb: np.ndarray
    cam_from_world: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def intrinsics(self) -> np.ndarray:
        """K (3, 3)."""
        return intrinsic_matrix(self.fx, self.fy, self.cx, self.cy)


def fuse(
    views: Sequence[DepthView], *, step: int = 2, tolerance: float = 0.02, agreeing: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """World points (N, 3) and colours (N, 3) uint8 of the pixels whose depth other views confirm.

    Every `step`-th pixel of each view is lifted; it stays when at least `agreeing` of the nearest
    other views see a depth within the share `tolerance` of its own there. A pixel that a view before
    it has already given a point is left out, so that surfaces are not stacked.
    """
    points, colours = [], []
    for index, view in enumerate(views):
        xyz, rgb = _lifted(view, step)
        others = _nearest(views, index)
        agree = np.zeros(len(xyz), int)
        told = np.zeros(len(xyz), bool)
        for other in others:
            near = _confirms(views[other], xyz, tolerance)
            agree += near
            if other < index:
                told |= near
        keep = (agree >= min(agreeing, len(others))) & ~told
        points.append(xyz[keep])
        colours.append(rgb[keep])
    return np.concatenate(points), np.concatenate(colours)


def _lifted(view: DepthView, step: int) -> tuple[np.ndarray, np.ndarray]:
    """World points (N, 3) and colours of every step-th pixel that has a depth."""
    height, width = view.depth.shape
    rows, columns = (
        grid.ravel() for grid in np.mgrid[step // 2 : height : step, step // 2 : width : step]
    )
    depth = view.depth[rows, columns].astype(np.float64)
    known = depth > 0
    rows, columns, depth = rows[known], columns[known], depth[known]
    x = (columns + 0.5 - view.cx) / view.fx * depth
    y = (rows + 0.5 - view.cy) / view.fy * depth
    world = invert(view.cam_from_world)
    xyz = np.stack([x, y, depth], axis=1) @ world[:3, :3].T + world[:3, 3]
    return xyz, view.rgb[rows, columns]


def _nearest(views: Sequence[DepthView], index: int) -> list[int]:
    centres = np.stack([centre(view.cam_from_world) for view in views])
    order = np.argsort(np.linalg.norm(centres - centres[index], axis=1), kind="stable")
    return [int(other) for other in order if other != index][:NEIGHBOURS]


def _confirms(view: DepthView, xyz: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether `view` sees a surface where the points (N, 3) are, (N,) bool."""
    height, width = view.depth.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels, depth = project(xyz, view.cam_from_world, view.intrinsics)
    inside = (depth > 0) & (pixels >= 0).all(axis=1)
    inside &= (pixels[:, 0] < width) & (pixels[:, 1] < height)
    found = np.zeros(len(xyz), bool)
    column, row = pixels[inside].astype(int).T
    seen = view.depth[row, column]
    found[inside] = (seen > 0) & (np.abs(seen - depth[inside]) <= tolerance * depth[inside])
    return found
