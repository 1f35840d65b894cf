"""Poses moved until a rendering lies on its photo: exact renderings of boxes, moved by a known motion."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "field"))

from scene import camera, photograph

from experiments.poses.aligned import aligned, moved
from pipeline.field.render import RenderedView

WIDTH, HEIGHT, FOCAL = 200, 150, 190.0
INTRINSICS = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, 0.0)
TRUE = camera(3, 24)
OFF = np.array([0.012, -0.008, 0.01, 0.001, -0.002, 0.0015])  # metres, radians


def seen_at(pose: np.ndarray) -> RenderedView:
    rgb, depth = photograph(pose, WIDTH, HEIGHT, FOCAL)
    opaque = np.ones(depth.shape, np.float32)
    return RenderedView(rgb.astype(np.float32), depth.astype(np.float32), opaque)


def pixels_off(pose: np.ndarray) -> float:
    """Mean distance of where `pose` and the true one show a lattice of points, in pixels."""
    lattice = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-0.5, 0.5], [4.0, 7.0, 11.0]), -1)
    points = lattice.reshape(-1, 3)
    places = []
    for one in (pose, TRUE):
        inside = points @ one[:3, :3].T + one[:3, 3]
        places.append(FOCAL * inside[:, :2] / inside[:, 2:])
    return float(np.linalg.norm(places[0] - places[1], axis=1).mean())


def test_a_camera_that_is_off_is_brought_back() -> None:
    photo, pose = seen_at(TRUE).rgb, moved(TRUE, OFF)
    before = pixels_off(pose)
    for _ in range(4):
        pose = aligned(photo, np.ones((HEIGHT, WIDTH), bool), seen_at(pose), INTRINSICS, pose)
    assert before > 0.4
    assert pixels_off(pose) < 0.15 * before


def test_covered_pixels_have_no_say() -> None:
    keep_mask = np.ones((HEIGHT, WIDTH), bool)
    keep_mask[40:110, 60:120] = False
    seen, photo = seen_at(moved(TRUE, OFF)), seen_at(TRUE).rgb
    wet = np.where(keep_mask[..., None], photo, np.float32(0.9))
    # The blur reaches a few pixels into what lies beside a drop; the mask is grown by one.
    steps = [aligned(one, keep_mask, seen, INTRINSICS, moved(TRUE, OFF)) for one in (photo, wet)]
    assert abs(pixels_off(steps[0]) - pixels_off(steps[1])) < 0.05
