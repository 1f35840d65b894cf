"""The stage masks: what it says of too much water and of none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.io.maps import write_map
from pipeline.io.scene import ImageRecord, write_images_json
from pipeline.stage import Job
from stages.masks import Params, main

PARAMS = Params(
    use_given=True, threshold=0.25, temporal_mean="auto", mean_alone=False, lens_fixed_from=0.3,
    dilation=0, min_area=0,
)  # fmt: skip


def _masked(root: Path, wet_rows: int) -> str:
    """What the stage says of two images of ten rows, so many of them under water."""
    job = Job(root, "made", None, "cpu", None, False)
    records = [ImageRecord(f"{n}.png", f"{n}.jpg", "", 8, 10, None, "train", 0) for n in "ab"]
    job.paths.images.mkdir(parents=True, exist_ok=True)
    job.paths.attention.mkdir(parents=True, exist_ok=True)
    write_images_json(job.paths.images, records)
    attention = np.zeros((10, 8), np.float32)
    attention[:wet_rows] = 1.0
    for record in records:
        write_map(job.paths.attention / f"{record.stem}.exr", attention)
    return main(job, PARAMS)


def test_too_much_water_and_none_are_told_with_what_to_do(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert _masked(tmp_path, 6).startswith("60.0 %") and not caplog.records
    _masked(tmp_path, 7)
    assert "70 % of the pixels are masked" in caplog.text and "wipe the glass" in caplog.text
    assert str(tmp_path / "artifacts/made/masks") in caplog.text
    caplog.clear()
    _masked(tmp_path, 0)
    assert "no drops were found in any image" in caplog.text
    with pytest.raises(UserError, match="every pixel of every image") as error:
        _masked(tmp_path, 10)
    assert "masks.threshold" in error.value.hint
