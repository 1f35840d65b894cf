from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.io.scene import ImageRecord
from pipeline.io.transforms import View
from pipeline.tables import shrink
from pipeline.tables.crops import GAP, LABEL_HEIGHT, busiest_window, side_by_side
from pipeline.tables.reading import gathered_scores, mask_scores, read_view_scores, view_scores
from pipeline.tables.rows import ROWS, Row


def test_the_busiest_window_holds_the_most() -> None:
    coverage = np.zeros((8, 10))
    coverage[4:6, 6:9] = 1
    assert busiest_window(coverage, (3, 2)) == (6, 4)
    assert busiest_window(np.zeros((8, 10)), (3, 2)) == (0, 0)
    with pytest.raises(ValueError, match="window"):
        busiest_window(coverage, (11, 2))


def test_a_strip_shows_the_same_window_of_each() -> None:
    pictures = {"a": np.zeros((8, 10, 3), np.float32), "b": np.ones((8, 10, 3), np.float32)}
    pictures["a"][4, 6] = (1, 0, 0)
    strip = side_by_side(pictures, (6, 4), (3, 2), 2)
    assert strip.shape == (LABEL_HEIGHT + 4, 6 + GAP + 6, 3)
    assert np.array_equal(strip[LABEL_HEIGHT, :3], [(1, 0, 0), (1, 0, 0), (0, 0, 0)])
    assert (strip[LABEL_HEIGHT:, 6:] == 1).all()


def test_a_smaller_mask_keeps_only_what_is_kept_whole() -> None:
    keep = np.ones((4, 6), bool)
    keep[1, 2] = False
    assert np.array_equal(shrink.smaller_keep_mask(keep, (3, 2)), [[1, 0, 1], [1, 1, 1]])
    assert shrink.smaller_keep_mask(keep, (6, 4)).tolist() == keep.tolist()


def test_a_smaller_picture_averages() -> None:
    values = np.arange(8, dtype=np.float32).reshape(2, 4)
    assert np.allclose(shrink.smaller_picture(values, (2, 1)), [[2.5, 4.5]])
    assert shrink.smaller_size((401, 300), 2) == (200, 150)


def test_a_point_lands_at_the_scaled_pixel() -> None:
    """u = fx x / z + cx in pixels from the corner, so a half-size picture halves it exactly."""
    view = View("a.png", np.eye(4), 330.0, 331.0, 199.0, 151.0, -0.01, 400, 300, 1.0, 9.0)
    small = shrink.smaller_view(view, (200, 150))
    assert (small.fx, small.fy, small.cx, small.cy) == (165.0, 165.5, 99.5, 75.5)
    assert (small.k1, small.near, small.far) == (-0.01, 1.0, 9.0)
    record = ImageRecord("a.png", "a.jpg", "", 400, 300, 330.0, "test", 0)
    assert shrink.smaller_record(record, (200, 150)).focal_px == 165.0


def test_scores_are_means_over_the_split() -> None:
    text = (
        "image,split,test.psnr,test.ssim,composite.psnr\n"
        "a,test,20.0,0.5,30.0\nb,train,,,40.0\nc,test,24.0,,32.0\nd,train,,,44.0\n"
    )
    assert view_scores(text, Row("x", "x")) == {"psnr": 22.0}
    inputs = Row("x", "x", kind="composite", split="train")
    assert view_scores(text, inputs) == {"psnr": 42.0}
    assert view_scores(text.replace("24.0", "inf"), Row("x", "x")) == {}


def test_mask_numbers() -> None:
    metrics = {"masks": {"iou": 0.5, "precision": None}, "rounds": {"0": {"iou": 0.25}}}
    loop, derain, true = (
        next(r for r in ROWS if r.id == key) for key in ("loop", "derain", "true")
    )
    assert mask_scores(metrics, loop) == mask_scores(metrics, derain) == {"iou": 0.5}
    assert mask_scores(metrics, true) == {}, "the truth is not judged by itself"
    assert gathered_scores(metrics, loop) == {"iou": 0.25}
    assert gathered_scores({}, loop) == gathered_scores(metrics, derain) == {}


@pytest.mark.parametrize("content", [None, b"rain\n1\n", b"split,test.psnr\ntest,wet\n", b"\xff"])
def test_a_table_of_numbers_that_is_none_is_told(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "metrics.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"metrics\.csv is not a table of numbers by image"):
        read_view_scores(path, Row("x", "x"))
