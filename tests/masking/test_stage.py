"""The stage masks: which equation it goes by, and what it says of too much water and of none."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.io.maps import write_map
from pipeline.io.masks import read_keep_mask, write_keep_mask
from pipeline.io.scene import GIVEN_MASKS, ImageRecord, Origin, write_images_json
from pipeline.stage import Job
from stages.masks import Params, main

PARAMS = Params(
    use_given=True, threshold=0.25, temporal_mean="auto", mean_alone=False, lens_fixed_from=0.3,
    dilation=0, min_area=0,
)  # fmt: skip


def _scene(root: Path, maps: Sequence[np.ndarray]) -> Job:
    """A job on images a, b, c ... with these attention maps."""
    job = Job(root, "made", None, "cpu", None, False)
    height, width = maps[0].shape
    records = [
        ImageRecord(f"{name}.png", f"{name}.jpg", "", width, height, None, "train", 0)
        for name, _ in zip("abcdef", maps, strict=False)
    ]
    job.paths.images.mkdir(parents=True, exist_ok=True)
    job.paths.attention.mkdir(parents=True, exist_ok=True)
    write_images_json(job.paths.images, records, Origin(masked="mask pictures"))
    for record, attention in zip(records, maps, strict=True):
        write_map(job.paths.attention / f"{record.stem}.exr", attention.astype(np.float32))
    return job


def _made(
    root: Path, maps: Sequence[np.ndarray], **params: Any
) -> tuple[list[np.ndarray], Mapping[str, Any]]:
    """The drop masks of images with these maps, and masks.json."""
    job = _scene(root, maps)
    main(job, PARAMS.model_copy(update=params))
    told = json.loads((job.paths.masks / "masks.json").read_text())
    names = sorted(path.name for path in job.paths.masks.glob("*.png"))
    return [~read_keep_mask(job.paths.masks / name) for name in names], told


# What maps see of a drop, and of what is none. Three views of one lens: the drop that stays in rows 0 to 2
# is missed by the third, whose mean of 0.6 still is above t = 0.5; the second errs at the bottom (mean 0.3).
DROP, ERROR = (slice(0, 3), slice(0, 8)), (slice(9, 10), slice(0, 2))


def _on_the_lens() -> list[np.ndarray]:
    maps = [np.full((10, 8), 0.0) for _ in range(3)]
    maps[0][DROP] = maps[1][DROP] = maps[1][ERROR] = 0.9
    return maps


def _in_the_scene() -> list[np.ndarray]:
    """Each view has its drop somewhere else; where the first two meet, the mean is above t."""
    maps = [np.full((10, 8), 0.0) for _ in range(3)]
    for number, rows in enumerate((slice(0, 3), slice(2, 5), slice(6, 9))):
        maps[number][rows] = 0.9
    return maps


def test_equation_5_gives_every_view_the_drop_that_most_see_and_none_their_errors(
    tmp_path: Path,
) -> None:
    drops, told = _made(tmp_path, _on_the_lens(), threshold=0.5, temporal_mean="on")
    assert all(mask[DROP].all() for mask in drops)
    assert [bool(mask[ERROR].any()) for mask in drops] == [False, True, False]
    assert [int(mask.sum()) for mask in drops] == [24, 26, 24]
    assert (told["mode"], told["why"]) == ("lens-fixed", "masks.temporal_mean is on")
    assert (told["threshold"], told["threshold_why"]) == (0.5, "masks.threshold")
    assert told["coverage"] == {"a.png": 0.3, "b.png": 0.325, "c.png": 0.3}
    assert told["fully_masked"] == [] and not told["mean_alone"]
    assert not list((tmp_path / "artifacts/.work").rglob("*.npy"))


def test_equation_3_gives_every_view_what_it_sees_itself(tmp_path: Path) -> None:
    maps = _on_the_lens()
    drops, told = _made(tmp_path, maps, threshold=0.5, temporal_mean="off")
    assert all(np.array_equal(mask, seen > 0.5) for mask, seen in zip(drops, maps, strict=True))
    assert not drops[2].any()
    assert (told["mode"], told["why"]) == ("per-image", "masks.temporal_mean is off")


def test_the_maps_decide_which_of_the_equations_holds(tmp_path: Path) -> None:
    # 50 marks on 240 pixels, of them 24 pixels with two and 2 with one: of 100 ordered pairs 48 agree, and
    # (0.48 - 50/240) / (1 - 50/240) = 0.34.
    drops, told = _made(tmp_path, _on_the_lens(), threshold=0.5)
    assert drops[2][DROP].all() and not drops[2][ERROR].any()
    assert told["mode"] == "lens-fixed" and told["why"] == "the maps agree to 0.34 >= 0.3 per pixel"
    # 72 marks, of them 8 pixels with two: 16 of 144 pairs, (0.11 - 0.3) / 0.7 = -0.27.
    maps = _in_the_scene()
    drops, told = _made(tmp_path, maps, threshold=0.5)
    assert all(np.array_equal(mask, seen > 0.5) for mask, seen in zip(drops, maps, strict=True))
    assert told["mode"] == "per-image" and told["why"] == "the maps agree to -0.27 < 0.3 per pixel"
    # Told to, the mean rules nevertheless: row 2 is a drop in the third view as well.
    assert _made(tmp_path, maps, threshold=0.5, temporal_mean="on")[0][2][2].all()


@pytest.mark.parametrize("decision", ["auto", "on"])
def test_the_mean_alone_forgets_the_errors_of_single_views(
    tmp_path: Path, decision: Literal["auto", "on"]
) -> None:
    made = {"threshold": 0.5, "temporal_mean": decision, "mean_alone": True}
    drops, told = _made(tmp_path, _on_the_lens(), **made)
    assert all(mask[DROP].all() and mask.sum() == 24 for mask in drops)
    assert told["mean_alone"]
    if decision == "auto":  # where equation 5 does not hold there is no mean that could rule alone
        drops, told = _made(tmp_path, _in_the_scene(), **made)
        assert [int(mask.sum()) for mask in drops] == [24] * 3 and not told["mean_alone"]


def test_the_threshold_is_chosen_from_all_maps(tmp_path: Path) -> None:
    maps = _on_the_lens()
    drops, told = _made(tmp_path, maps, threshold="auto", temporal_mean="off")
    assert told["threshold_why"].startswith("auto") and told["threshold"] == 0.45  # 0 and 0.9
    assert np.array_equal(drops[1], maps[1] > 0)


def test_a_map_of_another_size_is_refused(tmp_path: Path) -> None:
    for decision in ("auto", "on", "off"):
        job = _scene(tmp_path, _on_the_lens())
        write_map(job.paths.attention / "b.exr", np.zeros((5, 8), np.float32))
        with pytest.raises(UserError, match=r"b\.exr is 8x5, its image 8x10"):
            main(job, PARAMS.model_copy(update={"temporal_mean": decision}))
        assert not job.paths.masks.exists()


def _masked(root: Path, wet_rows: int) -> str:
    """What the stage says of two images of ten rows, so many of them under water."""
    attention = np.zeros((10, 8))
    attention[:wet_rows] = 1.0
    return main(_scene(root, [attention] * 2), PARAMS)


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


def _given(root: Path, wet_rows: Sequence[int]) -> tuple[Job, str]:
    """What the stage says of images whose masks came along, with so many rows dropped."""
    job = _scene(root, [np.zeros((10, 8))] * len(wet_rows))
    for name, rows in zip("abcdef", wet_rows, strict=False):
        keep_mask = np.ones((10, 8), bool)
        keep_mask[:rows] = False
        (job.paths.images / GIVEN_MASKS).mkdir(exist_ok=True)
        write_keep_mask(job.paths.images / GIVEN_MASKS / f"{name}.png", keep_mask)
    return job, main(job, PARAMS)


def test_masks_that_came_along_are_told_of_as_those_that_are_made(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    job, said = _given(tmp_path, [2, 10, 0])
    assert said == "40.0 % of the pixels masked, by the masks that came with the photos"
    assert [record.getMessage() for record in caplog.records] == [
        "b.png is masked entirely and will teach the scene nothing"
    ]
    told = json.loads((job.paths.masks / "masks.json").read_text())
    assert told["mode"] == "given" and told["why"] == "they came with the photos (mask pictures)"
    assert told["coverage"] == {"a.png": 0.2, "b.png": 1.0, "c.png": 0.0}
    assert told["mean_coverage"] == 0.4 and told["fully_masked"] == ["b.png"]
    assert not read_keep_mask(job.paths.masks / "a.png")[:2].any()
    caplog.clear()
    _given(tmp_path, [0, 0])
    assert "masks.use_given" in caplog.text
    with pytest.raises(UserError, match="every pixel of every image") as error:
        _given(tmp_path, [10, 10])
    assert "masks.use_given" in error.value.hint
    # What was there before stays.
    assert json.loads((job.paths.masks / "masks.json").read_text())["mean_coverage"] == 0
