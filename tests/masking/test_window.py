from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.masking.account import account
from pipeline.masking.align import aligned
from pipeline.masking.glass import GlassCamera, PaneGlass, pane_before
from pipeline.masking.loop import repair
from pipeline.masking.views import attention_on_glass
from pipeline.masking.window import (
    alike_by_distance,
    alike_on_pane,
    at_equal_overlap,
    chosen_window,
)

WIDTH, HEIGHT, COUNT = 120, 90, 16


def _cameras(count: int = COUNT) -> list[GlassCamera]:
    poses = [np.eye(4) for _ in range(count)]
    for view, pose in enumerate(poses):
        pose[0, 3] = -0.1 * view
    return [
        GlassCamera(pose, (100, 100, WIDTH / 2, HEIGHT / 2, 0), WIDTH, HEIGHT) for pose in poses
    ]


def _discs(shift: float) -> np.ndarray:
    """(H, W): 1 inside discs of radius 4 to 6, moved down by `shift` pixels."""
    rng = np.random.default_rng(2)
    middles = rng.uniform((-20, 0), (HEIGHT, WIDTH), (40, 2))
    radii = rng.uniform(4, 6, 40)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    apart = np.hypot(rows[..., None] - middles[:, 0] - shift, columns[..., None] - middles[:, 1])
    return (apart < radii).any(axis=2)


def _maps(px_per_photo: float, count: int = COUNT) -> list[np.ndarray]:
    """Attention of drops that creep, with false alarms of its own in each view."""
    rng = np.random.default_rng(4)
    return [
        np.where(_discs(px_per_photo * view), 0.9, 0.3 * rng.random((HEIGHT, WIDTH))).astype(np.float32)
        for view in range(count)
    ]  # fmt: skip


def test_likeness_by_distance_by_hand() -> None:
    columns, rows = np.meshgrid(np.arange(40.0), np.arange(30.0))
    one, other = np.sin(columns).astype(np.float32), np.sin(2 * rows).astype(np.float32)
    alike = alike_by_distance([one, other, None, one], _cameras(4))
    # 1 apart: one and the other, unrelated; 2 apart: the other and one; 3 apart: one and itself.
    assert alike == pytest.approx([0, 0, 1], abs=0.05)
    assert np.isnan(alike_by_distance([one, None, other], _cameras(3))[0])
    half = one.copy()
    half[:, 20:] = np.nan  # has no vote there
    assert alike_by_distance([one, half], _cameras(2)) == pytest.approx([1], abs=0.05)


def test_the_window_is_as_wide_as_photos_agree() -> None:
    # Nine tenths of the neighbours' 0.8 are 0.72, which photos 1 to 4 apart reach: five photos.
    falling = np.array([0.8, 0.78, 0.75, 0.73, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2])
    assert chosen_window(falling) == 5
    assert chosen_window(falling - 0.03) == 5  # 0.693 is missed from 5 apart on as well
    # Photos 4 apart agree less: two to either side of the middle do not; the window's ends may.
    assert chosen_window(np.array([0.8, 0.78, 0.75, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2])) == 5
    assert chosen_window(np.array([0.8] + 9 * [0.3])) == 3
    assert chosen_window(np.full(10, 0.8)) == 0
    assert chosen_window(0.8 + 0.05 * np.cos(np.arange(10.0))) == 0
    assert chosen_window(falling[:5]) == 0  # too few photos to tell
    assert chosen_window(np.full(10, np.nan)) == 0
    assert chosen_window(falling - 0.4) == 0  # neighbours hardly agree: noise


def test_drops_that_creep_get_a_window_and_others_none() -> None:
    cameras = _cameras()
    assert chosen_window(alike_by_distance(_maps(0), cameras)) == 0
    assert chosen_window(alike_by_distance(_maps(1.0), cameras)) == 3
    assert chosen_window(alike_by_distance(_maps(0.25), cameras)) == 5
    # Photos without order: nothing to be gained from neighbours in it.
    maps = _maps(1.0)
    for seed in range(3):
        mixed = np.random.default_rng(seed).permutation(COUNT)
        assert chosen_window(alike_by_distance([maps[i] for i in mixed], cameras)) == 0


def test_the_loop_goes_by_the_window_that_it_chose() -> None:
    maps, cameras = _maps(0.5), _cameras()
    truth = [_discs(0.5 * view) for view in range(COUNT)]

    def look(drop_masks: object, found: object) -> list[np.ndarray | None]:
        return [np.where(wet, 0.1, 0.01).astype(np.float32) for wet in truth]

    def overlap(window: int | str) -> float:
        drawn = [seen > 0.5 for seen in maps]
        done = repair(look, maps, cameras, drawn, 5.0, rounds=1, mode="lens", window=window)  # type: ignore[arg-type]
        masks = done.rounds[0].drop_masks
        assert done.rounds[0].window == (3 if window == "auto" else window)
        told = account(done, [str(view) for view in range(COUNT)])
        assert ("over 3 neighbouring photos" in told["why"]) == (window == "auto")
        assert told["rounds"]["0"]["window"] == done.rounds[0].window
        pairs = list(zip(masks, truth, strict=True))
        return sum((a & b).sum() for a, b in pairs) / sum((a | b).sum() for a, b in pairs)

    assert overlap("auto") > overlap(0) + 0.1


# Photos in four rows of six before a pane, to and fro: neighbours in a row and below each other share half.
PLACES = [(30 * (k % 6 if k // 6 % 2 == 0 else 5 - k % 6), 24 * (k // 6)) for k in range(24)]


def _before_a_pane(px_per_photo: float) -> tuple[PaneGlass, list[np.ndarray], list[np.ndarray]]:
    """A pane, where drops are in each view of 60x48, and its attention, which errs in its own way.

    The largest drops creep down by `px_per_photo`, the others in proportion to the square of their radius.
    """
    rng, width, height, focal, away = np.random.default_rng(3), 60, 48, 60.0, 1.5
    middles, radii = rng.uniform(0, (210, 140), (160, 2)), rng.uniform(3, 7, 160)
    cameras, truth, maps = [], [], []
    for view, (left, top) in enumerate(PLACES):
        pose = np.eye(4)
        pose[:2, 3] = -np.array([left, top]) * away / focal
        cameras.append(GlassCamera(pose, (focal, focal, width / 2, height / 2, 0), width, height))
        wet = np.zeros((height, width), np.uint8)
        for (x, y), radius in zip(middles, radii, strict=True):
            y += px_per_photo * view * (radius / 7) ** 2
            spot = (round(16 * (x - left)), round(16 * (y - top)))
            cv2.circle(wet, spot, round(16 * radius), 1, -1, shift=4)
        truth.append(wet > 0)
        blurred = cv2.GaussianBlur(0.9 * wet.astype(np.float32), (0, 0), 1.0)
        maps.append(np.clip(blurred + 0.2 * rng.random(wet.shape), 0, 1).astype(np.float32))
    poses = np.stack([camera.cam_from_world for camera in cameras])
    return PaneGlass(pane_before(poses, away), cameras), truth, maps


def _window_of(glass: PaneGlass, maps: list[np.ndarray], order: np.ndarray) -> int:
    """The window of photos in another order, once they are brought to cover."""
    own = PaneGlass(glass.pane_from_world, [glass.cameras[view] for view in order])
    mixed = [maps[view] for view in order]
    own.moved = aligned(own, mixed, 4)
    return chosen_window(alike_on_pane(own, mixed))


def test_drops_that_creep_down_a_pane_get_a_window_and_others_none() -> None:
    in_order, mixed = np.arange(24), np.random.default_rng(1).permutation(24)
    for px_per_photo in (0.0, 1.2):
        glass, _, maps = _before_a_pane(px_per_photo)
        assert (_window_of(glass, maps, in_order) > 0) == (px_per_photo > 0)
        assert _window_of(glass, maps, mixed) == 0


def test_a_window_on_a_pane_follows_drops_that_creep() -> None:
    glass, truth, maps = _before_a_pane(1.2)
    glass.moved = aligned(glass, maps, 4)
    drawn = [seen > 0.5 for seen in maps]

    def overlap(width: int) -> float:
        pairs = list(zip(attention_on_glass(glass, maps, drawn, width), truth, strict=True))
        return sum((a & b).sum() for a, b in pairs) / sum((a | b).sum() for a, b in pairs)

    assert overlap(chosen_window(alike_on_pane(glass, maps))) > overlap(0) + 0.02


def test_a_fall_with_the_overlap_is_none_with_the_order() -> None:
    rng = np.random.default_rng(0)
    apart = rng.integers(1, 14, 60)
    # Photos farther apart share less, and photos that share less agree less: the pane is still.
    overlap = np.clip(0.8 - 0.04 * apart + rng.normal(0, 0.1, 60), 0.05, 1)
    still = 0.7 + 0.3 * overlap + rng.normal(0, 0.01, 60)
    level = at_equal_overlap(still, apart, overlap)
    assert len(level) == apart.max() and np.ptp(level) == 0
    line = at_equal_overlap(still - 0.02 * (apart - 1), apart, overlap)
    assert np.diff(line) == pytest.approx(-0.02, abs=0.002)
    assert chosen_window(line) > 0 and chosen_window(level) == 0
    # On a walk along the pane the overlap tells the order: what falls with one falls with the other.
    walk = 0.8 - 0.04 * apart
    assert np.ptp(at_equal_overlap(0.9 - 0.02 * apart, apart, walk)) == 0
    assert chosen_window(at_equal_overlap(still[:5], apart[:5], overlap[:5])) == 0
