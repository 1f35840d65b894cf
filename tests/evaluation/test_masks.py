from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.evaluation.masks import MaskCounts, mask_counts, mask_scores


def test_scores_of_a_hand_made_map():
    coverage = np.array([[0.0, 0.05, 0.06, 1.0], [0.9, 0.0, 0.0, 0.5]], np.float32)
    dropped = np.array([[True, True, True, False], [True, False, False, False]])
    # Above 0.05 are four pixels; two of them are dropped, and two clear ones are dropped too.
    counts = mask_counts(dropped, coverage, 0.05)
    assert counts == MaskCounts(hits=2, false_alarms=2, misses=2)
    assert mask_scores([counts]) == (2 / 6, 2 / 4, 2 / 4)


def test_scores_pool_the_pixels_of_all_images():
    empty, full = MaskCounts(0, 0, 0), MaskCounts(6, 2, 0)
    assert mask_scores([empty, full]) == (0.75, 0.75, 1.0)


def test_without_any_drop_there_is_no_score():
    assert all(math.isnan(score) for score in mask_scores([MaskCounts(0, 0, 0)]))
    nothing_found = mask_scores([MaskCounts(0, 0, 5)])
    assert nothing_found.iou == 0 and nothing_found.recall == 0
    assert math.isnan(nothing_found.precision)


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="coverage"):
        mask_counts(np.zeros((2, 3), bool), np.zeros((3, 2)), 0.05)
