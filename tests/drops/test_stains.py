"""Stains on the pane, and drops that creep."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.drops import stains
from pipeline.drops.creep import crept
from pipeline.drops.shape import Drop
from pipeline.drops.stains import NAMES, over, sample_stains, seen_layer, stained
from pipeline.errors import UserError


@pytest.mark.parametrize("kind", NAMES)
def test_stains_cover_their_share_and_are_as_opaque_as_their_kind(kind: str) -> None:
    layer = sample_stains(np.random.default_rng(1), kind, (200, 260), 0.12, 3.0)
    opacity = layer[..., 3]
    assert (opacity > 0.1).mean() == pytest.approx(0.12, abs=0.06)
    assert (layer[..., :3] <= opacity[..., None] + 1e-6).all()
    opaque = kind in ("dirt", "snow")
    assert (opacity.max() > 0.91) == opaque
    again = sample_stains(np.random.default_rng(1), kind, (200, 260), 0.12, 3.0)
    np.testing.assert_array_equal(layer, again)


def test_a_share_that_is_not_reached_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a pane of 100x100 pixels, a hundred specks of dust hide some; what is missing is not passed over."""
    monkeypatch.setattr(stains, "MOST", 100)
    some = sample_stains(np.random.default_rng(1), "dust", (100, 100), 0.01, 1.0)
    reached = (some[..., 3] > 0.1).mean()
    assert 0.01 <= reached < 0.02
    told = r"100 stains of kind dust cover only \d\.\d\d% of the pane, not 90\.00%"
    with pytest.raises(UserError, match=told):
        sample_stains(np.random.default_rng(1), "dust", (100, 100), 0.9, 1.0)


def test_unknown_stain_is_refused() -> None:
    with pytest.raises(UserError, match="mud"):
        sample_stains(np.random.default_rng(1), "mud", (20, 20), 0.1, 3.0)


def test_layer_seen_from_the_front_is_the_layer_and_moves_with_the_pane() -> None:
    layer = np.zeros((40, 60, 4), np.float32)
    layer[10:20, 30:44] = 0.5
    # 2 mm a pixel, 500 px focal length, 1 m away: one to one, the centre at (30, 20).
    front = np.array([[500.0, 0, 30], [0, 500.0, 20], [0, 0, 1]])
    seen = seen_layer(layer, 0.002, front, (40, 60), 0.0)
    np.testing.assert_allclose(seen[11:19, 31:43], 0.5, atol=1e-6)
    assert seen[..., 3].sum() == pytest.approx(layer[..., 3].sum(), rel=1e-3)
    moved = front.copy()
    moved[0, 2] += 4
    right = seen_layer(layer, 0.002, moved, (40, 60), 0.0)
    np.testing.assert_allclose(right[:, 4:], seen[:, :-4], atol=1e-5)
    blurred = seen_layer(layer, 0.002, front, (40, 60), 5.0)
    assert blurred[..., 3].sum() == pytest.approx(layer[..., 3].sum(), rel=0.01)


def test_opaque_stain_hides_and_half_opaque_one_mixes() -> None:
    light = np.full((1, 2, 3), 0.4, np.float32)
    layer = np.array([[[0.1, 0.1, 0.1, 1.0], [0.25, 0.25, 0.25, 0.5]]], np.float32)
    assert stained(light, layer)[0, 0, 0] == pytest.approx(0.1 * 0.4)
    assert stained(light, layer)[0, 1, 0] == pytest.approx(0.4 * 0.5 + 0.25 * 0.4)
    both = over(layer, np.full((1, 2, 4), 0.5, np.float32))
    assert both[0, 0].tolist() == layer[0, 0].tolist()
    assert both[0, 1, 3] == pytest.approx(0.75)


def test_large_drops_creep_most_and_swallow_what_they_meet() -> None:
    big, small = Drop((0.0, 0.0), 0.004, 1.0), Drop((0.05, 0.0), 0.002, 1.0)
    moved = {drop.radius: drop.center[1] for drop in crept([small, big], 0.008)}
    assert moved == {0.004: pytest.approx(0.008), 0.002: pytest.approx(0.002)}
    below = Drop((0.0, 0.007), 0.002, 1.0)
    (one,) = crept([big, below], 0.004)
    assert one.radius**3 == pytest.approx(0.004**3 + 0.002**3)
    assert crept([big, below], 0.0) == [big, below]
