from __future__ import annotations

import numpy as np
import pytest

from pipeline.masking.account import account
from pipeline.masking.glass import GlassCamera
from pipeline.masking.loop import repair
from pipeline.masking.window import alike_by_distance, chosen_window

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
