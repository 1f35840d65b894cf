"""Cameras moved until a rendering lies on its photo: exact renderings of boxes, moved by a known motion."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))

from scene import camera, photograph

from pipeline.field.align import aligned, lay_on_photo, moved
from pipeline.field.growing import aligned_poses, moved_px
from pipeline.field.render import RenderedView
from pipeline.geometry.poses import pose_errors
from pipeline.io.posed import PosedImage
from pipeline.io.scene import ImageRecord
from pipeline.io.transforms import View

WIDTH, HEIGHT, FOCAL = 200, 150, 190.0
INTRINSICS = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, 0.0)
TRUE = camera(3, 24)
OFF = np.array([0.012, -0.008, 0.01, 0.001, -0.002, 0.0015])  # metres, radians


def seen_at(pose: np.ndarray) -> RenderedView:
    rgb, depth = photograph(pose, WIDTH, HEIGHT, FOCAL)
    return RenderedView(rgb.astype(np.float32), depth.astype(np.float32))


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
    found = aligned(photo, np.ones((HEIGHT, WIDTH), bool), pose, INTRINSICS, seen_at, 4)
    assert pixels_off(pose) > 0.4
    assert pixels_off(found) < 0.15 * pixels_off(pose)


def test_covered_pixels_have_no_say() -> None:
    keep_mask = np.ones((HEIGHT, WIDTH), bool)
    keep_mask[40:110, 60:120] = False
    off = moved(TRUE, OFF)
    seen, photo = seen_at(off), seen_at(TRUE).rgb
    wet = np.where(keep_mask[..., None], photo, np.float32(0.9))
    # The blur reaches a few pixels into what lies beside a drop; the mask is grown by one.
    steps = [moved(off, lay_on_photo(one, keep_mask, seen, INTRINSICS)) for one in (photo, wet)]
    assert abs(pixels_off(steps[0]) - pixels_off(steps[1])) < 0.05


def test_a_camera_stays_where_no_step_helps_and_where_all_is_covered() -> None:
    photo, keep_mask = seen_at(TRUE).rgb, np.ones((HEIGHT, WIDTH), bool)
    assert aligned(photo, keep_mask, TRUE, INTRINSICS, seen_at, 3) is TRUE
    off = moved(TRUE, OFF)
    np.testing.assert_array_equal(aligned(photo, ~keep_mask, off, INTRINSICS, seen_at, 2), off)


def test_a_motion_moves_the_world_in_the_cameras_axes() -> None:
    ahead = moved(TRUE, np.array([0, 0, 0.5, 0, 0, 0.0]))
    assert np.allclose(ahead[:3, 3] - TRUE[:3, 3], [0, 0, 0.5])
    quarter = moved(np.eye(4), np.array([0, 0, 0, 0, 0, np.pi / 2]))
    assert np.allclose(quarter @ [1, 0, 0, 1], [0, 1, 0, 1])


def photo_at(number: int, count: int, pose: np.ndarray) -> PosedImage:
    """A photo from a true place, told to be at ``pose``."""
    width, height, focal = 80, 60, 76.0
    rgb, _ = photograph(camera(number, count), width, height, focal)
    record = ImageRecord(
        name=f"{number:02d}.png", source="", sha256="", width=width, height=height,
        focal_px=None, split="test" if number == 4 else "train", turned=0,
    )  # fmt: skip
    view = View(record.name, pose, focal, focal, width / 2, height / 2, 0.0, width, height, 2.8, 13)
    return PosedImage(record, view, rgb.astype(np.float32), np.ones((height, width), bool))


def in_turn(function: Callable[..., Any], tasks: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
    return {name: function(*task) for name, task in tasks.items()}


def test_points_move_by_focal_length_over_depth() -> None:
    view = View("one.png", np.eye(4), 80.0, 80.0, 40.0, 30.0, 0.0, 80, 60, 1.0, 9.0)
    aside = moved(np.eye(4), np.array([0.1, 0, 0, 0, 0, 0.0]))
    points = np.array([[0, 0, 2.0], [0.5, 0.1, 4.0], [0, 0, -3.0]])  # the last one behind
    assert moved_px(points, view, np.eye(4), aside) == pytest.approx((4 + 2) / 2)
    assert moved_px(points[2:], view, np.eye(4), aside) == 0


def test_cameras_that_are_all_off_come_nearer_to_the_truth() -> None:
    count, random = 12, np.random.default_rng(5)
    true = {f"{i:02d}.png": camera(i, count) for i in range(count)}
    noise = random.normal(size=(count, 6)) * ([0.02] * 3 + [0.003] * 3)
    told = {name: moved(true[name], noise[i]) for i, name in enumerate(true)}
    images = [photo_at(i, count, told[name]) for i, name in enumerate(true)]
    landmarks = np.random.default_rng(6).uniform((-2, -1, 4), (2, 1, 8), (50, 3))
    align = partial(
        aligned_poses, images, in_turn, scale=1.0, landmarks=landmarks, seed=0, device="cpu", threads=1
    )  # fmt: skip
    found = align(fits=(120, 60), settled_px=0.0)

    def off(poses: dict[str, np.ndarray]) -> float:
        return float(np.mean(list(pose_errors(poses, true).centre.values())))

    assert off(found) < 0.6 * off(told)
    assert set(found) == set(true)
    # The first round moves the points by less than ten pixels: it is the last then.
    one, settled = align(fits=(120,), settled_px=0.0), align(fits=(120, 60), settled_px=10.0)
    assert all(np.array_equal(settled[name], one[name]) for name in true)
    assert any(not np.array_equal(found[name], one[name]) for name in true)
