from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.evaluation.rounds import score_rounds
from pipeline.evaluation.score import Files
from pipeline.io.images import write_image
from pipeline.io.masks import write_keep_mask
from pipeline.io.scene import ImageRecord


def test_scores_of_a_round_by_hand(tmp_path: Path) -> None:
    record = ImageRecord("a.png", "a.png", "0", 4, 2, None, "test", 0)
    coverage = np.zeros((2, 4, 3), np.uint8)
    coverage[0] = 255  # the upper row is covered
    clean = np.full((2, 4, 3), 100, np.uint8)
    cv2.imwrite(str(tmp_path / "coverage.png"), coverage)
    cv2.imwrite(str(tmp_path / "clean.png"), clean)
    nothing = tmp_path / "none.png"
    paths = {"clean": tmp_path / "clean.png", "coverage": tmp_path / "coverage.png"}
    files = {"a.png": Files(record, nothing, nothing, nothing, None, None, None, **paths)}
    keep_mask = np.ones((2, 4), bool)
    keep_mask[:, 0] = False  # one pixel right, one wrong, three missed
    write_keep_mask(tmp_path / "rounds/0/masks/a.png", keep_mask)
    write_keep_mask(tmp_path / "rounds/1/masks/a.png", coverage[..., 0] == 0)
    write_image(tmp_path / "rounds/0/test/a.png", clean + np.uint8(51))
    found = score_rounds(tmp_path, files, 0.05)
    assert found["0"]["coverage"] == 0.25
    assert found["0"]["iou"] == pytest.approx(1 / 5)
    assert found["0"]["precision"] == 0.5
    assert found["0"]["recall"] == 0.25
    assert found["0"]["test_psnr"] == pytest.approx(-10 * np.log10(0.2**2), abs=1e-5)
    assert found["1"] == {"coverage": 0.5, "iou": 1.0, "precision": 1.0, "recall": 1.0}
    assert score_rounds(tmp_path / "elsewhere", files, 0.05) == {}
