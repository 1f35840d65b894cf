"""Which pixels of a photo have witnesses: as counted over all photos, but no more are asked than must be."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.field import visibility
from pipeline.field.growing import GrowingField
from pipeline.field.visibility import Witness, seen_by_others, witness_count


def _row_of(count: int, k1: float = 0.0) -> list[Witness]:
    """Photos along a wavy wall, each with drops of its own."""
    rng = np.random.default_rng(0)
    found = []
    for number in range(count):
        pose = np.eye(4)
        pose[0, 3] = -0.15 * number
        depth = (3 + 0.1 * rng.standard_normal((30, 41))).astype(np.float32)
        keep = rng.random((30, 41)) > 0.4
        found.append(Witness(pose, (32.0, 32.0, 20.5, 15.0, k1), keep, depth))
    return found


@pytest.mark.parametrize("k1", [0.0, -0.05])
@pytest.mark.parametrize("fewest", [0, 1, 3, 9])
def test_pixels_with_witnesses_are_those_that_all_photos_counted_give(
    fewest: int, k1: float
) -> None:
    row = _row_of(8, k1)
    for index, own in enumerate(row):
        others = row[:index] + row[index + 1 :]
        whole = witness_count(own, others) >= fewest
        found = seen_by_others(index, row, fewest)
        assert np.array_equal(found[::2, ::2], whole) and found.shape == own.depth.shape
        assert np.array_equal(found[1::2, 1::2], whole[: 30 // 2, : 41 // 2])


def test_no_more_photos_are_asked_than_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a hundred that all see everything, two neighbours do."""
    dry = Witness(
        np.eye(4), (8.0, 8.0, 4, 4, 0.0), np.ones((8, 8), bool), np.ones((8, 8), np.float32)
    )
    row, asked = [dry._replace() for _ in range(100)], []
    sees = visibility._sees

    def noted(other: Witness, points: np.ndarray) -> np.ndarray:
        asked.append(next(n for n, one in enumerate(row) if one is other))
        return sees(other, points)

    monkeypatch.setattr(visibility, "_sees", noted)
    assert seen_by_others(50, row, 2).all() and sorted(asked) == [49, 51]


def test_the_photos_of_a_field_are_asked_by_whoever_runs_the_tasks() -> None:
    """On threads, as `map_named` does."""
    views = [
        SimpleNamespace(cam_from_world=w.cam_from_world, intrinsics=w.intrinsics)
        for w in _row_of(3)
    ]
    splits = ["train", "test", "train"]
    field = object.__new__(GrowingField)
    field.images = [
        SimpleNamespace(record=SimpleNamespace(name=str(n), split=split), view=view)
        for n, (split, view) in enumerate(zip(splits, views, strict=True))
    ]  # type: ignore[misc]
    depths = {str(n): np.full((30, 41), 3.0, np.float32) for n in range(3)}
    dry = {name: np.zeros((30, 41), bool) for name in depths}
    ran: list[str] = []

    def each(function: Any, tasks: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
        ran.extend(tasks)
        return {name: function(*args) for name, args in tasks.items()}

    sure = field.sure(depths, dry, 1, each)
    assert ran == ["0", "2"] == list(sure)
    # Two photos 0.3 apart, 3 away: what one sees, the other does, but for 3.2 columns at its side.
    assert sure["0"][:, 5:].all() and not sure["0"][:, :2].any()
