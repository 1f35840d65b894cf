"""A composite keeps what the photo knows; the count of witnesses knows what no photo saw."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.field.compose import composite_photo
from pipeline.field.visibility import Witness, witness_count

RNG = np.random.default_rng(0)


def wet() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    clean = (0.3 + 0.4 * RNG.random((40, 50, 3))).astype(np.float32)
    keep = np.ones((40, 50), bool)
    keep[10:20, 15:30] = False
    photo = clean.copy()
    photo[~keep] = 0.95
    return clean, photo, keep


def test_far_from_drops_the_photo_is_untouched_and_inside_it_is_gone() -> None:
    clean, photo, keep = wet()
    out = composite_photo(photo, clean * 0.9, keep, feather_px=2.0)
    assert np.array_equal(out[30:], photo[30:])
    # The rendering is a tenth darker: the gain brings it back to the photo's exposure.
    np.testing.assert_allclose(out[~keep], clean[~keep], atol=0.01)


def test_nothing_covered_returns_the_photo_and_all_covered_the_rendering() -> None:
    clean, photo, _ = wet()
    assert np.array_equal(composite_photo(photo, clean, np.ones((40, 50), bool)), photo)
    out = composite_photo(photo, clean, np.zeros((40, 50), bool))
    np.testing.assert_allclose(out, clean, atol=1e-6)


def test_without_a_fade_every_kept_pixel_is_the_photos_own() -> None:
    clean, photo, keep = wet()
    out = composite_photo(photo, clean * 0.9, keep, feather_px=0.0)
    assert np.array_equal(out[keep], photo[keep])
    np.testing.assert_allclose(out[~keep], clean[~keep], atol=0.01)


def wall(shift: float, keep: np.ndarray) -> Witness:
    """A camera at x = shift that looks at a wall 2 away: depth 2 everywhere."""
    pose = np.eye(4)
    pose[0, 3] = -shift
    return Witness(pose, (20.0, 20.0, 10.0, 10.0, 0.0), keep, np.full((20, 20), 2.0, np.float32))


def test_a_pixel_counts_the_photos_that_saw_its_surface_dry() -> None:
    dry = np.ones((20, 20), bool)
    left = dry.copy()
    left[:, :10] = False
    # The shift of 0.5 at depth 2 moves the wall by 20 * 0.5 / 2 = 5 columns.
    count = witness_count(wall(0.0, dry), [wall(0.0, left), wall(0.5, dry)], stride=1)
    assert count[:, :5].max() == 0  # left of both: covered in one, outside of the other
    assert (count[:, 5:10] == 1).all()
    assert (count[:, 10:] == 2).all()


@pytest.mark.parametrize("depth", [1.0, 4.0])
def test_a_surface_behind_or_before_what_the_photo_saw_does_not_count(depth: float) -> None:
    dry = np.ones((20, 20), bool)
    other = wall(0.0, dry)._replace(depth=np.full((20, 20), depth, np.float32))
    assert witness_count(wall(0.0, dry), [other], stride=1).max() == 0


def test_a_long_video_is_counted_to_its_end() -> None:
    """More witnesses than a byte holds: 256 are not none."""
    dry = np.ones((20, 20), bool)
    count = witness_count(wall(0.0, dry), [wall(0.0, dry)] * 256, stride=4)
    assert (count == 256).all()


def test_a_lens_that_bends_inwards_sees_nothing_from_beyond_its_frame() -> None:
    """At radius 2 this lens would show a point at 2 - 0.2 * 8 = 0.4, inside its frame of 0.5: it folds."""
    bent = (100.0, 100.0, 50.5, 50.5, -0.2)
    turned = np.eye(4)  # looks along (2, 0, 1), at something that is 1 deep for the other camera
    turned[:3, :3] = np.array([[1, 0, -2], [0, 5**0.5, 0], [2, 0, 1]]) / 5**0.5
    dry = np.ones((101, 101), bool)
    view = Witness(turned, bent, dry, np.full(dry.shape, 5**0.5, np.float32))
    ahead = Witness(np.eye(4), bent, dry, np.ones(dry.shape, np.float32))
    assert witness_count(view, [ahead])[25, 25] == 0
    assert witness_count(view, [view])[25, 25] == witness_count(ahead, [ahead])[25, 25] == 1
