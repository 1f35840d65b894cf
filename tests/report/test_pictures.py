from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from pipeline.report.pictures import (
    attention_heat,
    data_uri,
    depth_colours,
    mask_overlay,
    upright,
)


def decode(uri: str) -> np.ndarray:
    kind, data = uri.split(",")
    assert kind == "data:image/jpeg;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR_RGB)


def test_pictures_are_scaled_down_never_up_and_keep_their_colours():
    rgb = np.broadcast_to(np.array([0.8, 0.4, 0.2], np.float32), (60, 120, 3))
    assert decode(data_uri(rgb, 40, 90)).shape == (20, 40, 3)
    small = decode(data_uri(rgb, 400, 90))
    assert small.shape == (60, 120, 3)
    np.testing.assert_allclose(small[30, 60], [204, 102, 51], atol=3)


def test_only_what_is_dropped_or_attended_is_coloured():
    photo = np.full((20, 20, 3), 0.5, np.float32)
    keep_mask = np.ones((20, 20), bool)
    keep_mask[5:10, 5:10] = False
    painted = mask_overlay(photo, keep_mask)
    assert (painted[keep_mask] == 0.5).all()
    assert (painted[~keep_mask][:, 0] > 0.7).all()
    heat = attention_heat(photo, 1.0 - keep_mask)
    assert np.ptp(heat[keep_mask], axis=-1).max() < 1e-6
    assert heat[~keep_mask].mean() > heat[keep_mask].mean()


def test_near_is_warm_and_far_is_cold():
    depth = np.tile(np.geomspace(1, 50, 100, dtype=np.float32), (10, 1))
    colours = depth_colours(depth)
    assert colours[0, 0, 0] > colours[0, 0, 2] and colours[0, -1, 2] > colours[0, -1, 0]
    assert np.isfinite(depth_colours(np.ones((4, 4), np.float32))).all()


@pytest.mark.parametrize("turned", [0, 90, 180, 270])
def test_turned_photos_are_shown_upright(turned):
    photo = np.arange(24).reshape(2, 4, 3)
    assert (upright(np.rot90(photo, turned // 90), turned) == photo).all()
