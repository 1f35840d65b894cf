from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.evaluation import score
from pipeline.evaluation.score import Files
from pipeline.evaluation.summary import as_csv, average, headline, summarise
from pipeline.io.images import write_image
from pipeline.io.masks import write_keep_mask
from pipeline.io.scene import ImageRecord

ROWS = {
    "a.png": {
        "test.psnr": 30.0,
        "test.ssim": 0.9,
        "selfcheck.kept_psnr": 28.0,
        "masks.coverage": 0.1,
    },
    "b.png": {
        "test.psnr": 20.0,
        "test.ssim": 0.7,
        "selfcheck.kept_psnr": 24.0,
        "masks.coverage": 0.3,
    },
}


def test_numbers_are_means_over_images_nested_by_their_dots():
    numbers = summarise(ROWS, {"lpips": "no weights"})
    assert numbers["test"]["psnr"] == 25.0
    assert numbers["test"]["ssim"] == 0.8
    assert numbers["masks"]["coverage"] == 0.2
    assert numbers["selfcheck"]["kept_psnr"] == 26.0


def test_what_is_missing_is_null_with_the_strongest_reason_beside_it():
    numbers = summarise(ROWS, {"lpips": "no weights"})
    assert numbers["test"]["lpips"] is None
    assert numbers["test"]["lpips_reason"] == "no weights"
    assert numbers["covered"] == {
        "psnr": None,
        "psnr_reason": "the masks cover no pixel of these views",
    }
    none = summarise({}, {"clean": "no clean views", "lpips": "no weights", "coverage": "no truth"})
    assert none["test"]["lpips_reason"] == none["composite"]["ssim_reason"] == "no clean views"
    assert none["masks"]["iou_reason"] == none["masks"]["true_coverage_reason"] == "no truth"


def test_every_null_has_a_reason_and_json_holds_no_nan():
    for rows in ({}, ROWS, {"a.png": {"test.psnr": math.inf, "masks.coverage": math.nan}}):
        numbers = summarise(rows, {"clean": "no truth"})
        json.dumps(numbers, allow_nan=False)
        for group in numbers.values():
            for leaf, value in group.items():
                assert value is not None or group[f"{leaf}_reason"]


def test_an_identical_view_has_no_mean():
    assert average([20.0, 30.0]) == (25.0, None)
    value, reason = average([20.0, math.inf])
    assert value is None and reason == "1 of 2 images are identical to their references"


def test_mask_scores_come_from_pooled_pixels():
    counts = {"masks.hits": 3.0, "masks.false_alarms": 1.0, "masks.misses": 2.0}
    numbers = summarise({"a.png": counts, "b.png": {}}, {})["masks"]
    assert (numbers["iou"], numbers["precision"], numbers["recall"]) == (0.5, 0.75, 0.6)


def test_csv_has_a_line_per_image_and_leaves_gaps_empty():
    text = as_csv({"a.png": {"split": "test", "test.psnr": 1 / 3}, "b.png": {"split": "train"}})
    lines = list(csv.DictReader(io.StringIO(text)))
    assert [line["image"] for line in lines] == ["a.png", "b.png"]
    assert lines[0]["test.psnr"] == "0.333333"
    assert lines[1]["test.psnr"] == ""


@pytest.mark.parametrize("reasons", [{}, {"clean": "no truth"}])
def test_headline(reasons):
    rows = ROWS if not reasons else {"a.png": {"selfcheck.kept_psnr": 28.0}}
    numbers = summarise(rows, reasons) | {"poses": {"registered": 4, "total": 5}}
    sentence = headline(numbers)
    assert "4 of 5 images registered" in sentence
    assert (
        ("no truth" in sentence and "28.00 dB" in sentence) if reasons else "25.00 dB" in sentence
    )


@pytest.mark.parametrize(
    ("side", "missing"), [(9, {"ssim", "lpips"}), (30, {"lpips"}), (31, set())]
)
def test_an_image_too_small_for_a_measure_goes_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, side: int, missing: set[str]
) -> None:
    picture = np.random.default_rng(0).random((side, side + 3, 3)).astype(np.float32)
    for name in ("photo", "view", "clean"):
        write_image(tmp_path / f"{name}.png", picture)
        picture = 0.9 * picture
    write_keep_mask(tmp_path / "keep.png", np.ones(picture.shape[:2], bool))
    record = ImageRecord("photo.png", "photo.png", "", side + 3, side, None, "test", 0)
    paths = {name: tmp_path / f"{name}.png" for name in ("photo", "view", "clean", "keep")}
    files = Files(record, paths["photo"], paths["photo"], paths["keep"], paths["view"], None, None,
                  paths["clean"], None)  # fmt: skip
    monkeypatch.setattr(score, "_model", lambda backbone: None)
    monkeypatch.setattr(score, "lpips", lambda model, a, b: 0.5)
    rows = {"photo.png": score.score_image(files, 0.05, tmp_path)}
    test = summarise(rows, {})["test"]
    assert {name for name in ("psnr", "ssim", "lpips") if test[name] is None} == missing
    for name in missing:
        assert "pixels each way" in test[f"{name}_reason"]
    told = headline({"test": test, "poses": {"registered": 3, "total": 3}, "masks": {"iou": None}})
    assert ("SSIM" in told) == ("ssim" not in missing)
