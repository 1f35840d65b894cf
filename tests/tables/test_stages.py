"""From a scene with truth to the tables: the size of the fits, metrics of made-up rows, the table."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.io.images import read_image, write_image
from pipeline.io.masks import read_keep_mask
from pipeline.io.paths import ScenePaths
from pipeline.io.scene import read_images_json
from pipeline.io.transforms import read_transforms
from pipeline.stage import Job
from stages import evaluate, shrink, table
from tests.evaluation.fabricated import fabricate

FOLDERS = {"images": "small/images", "poses": "small/poses", "refine": "small/true"}
PARAMS = table.Params(title="Made", scenes=["made"], lens=["made"], seeds=[0, 1], notes=["Noted."])


def job(root: Path, variant: str | None = None) -> Job:
    return Job(root, "made", variant, "cpu", None, False, FOLDERS if variant else {})


@pytest.fixture
def paths(tmp_path: Path) -> ScenePaths:
    """A scene at half its size."""
    made = fabricate(tmp_path, variant=None, video=False, lost=0)
    for name in ("masks", "unaveraged"):
        for file in made.refine.glob("*.png"):
            (made.artifacts / name).mkdir(exist_ok=True)
            shutil.copy(file, made.artifacts / name)
    shrink.main(job(tmp_path), shrink.Params(factor=2, covered_from=0.02))
    return made


def row(root: Path, variant: str, step: int) -> None:
    """The metrics of views that are `step` 8-bit steps off their clean references everywhere."""
    paths = job(root, variant).paths
    for record in read_images_json(paths.images):
        if record.split == "test":
            clean = np.rint(read_image(paths.small / "clean" / record.name) * 255)
            off = np.where(clean > 127, clean - step, clean + step).astype(np.uint8)
            write_image(paths.views / "test" / record.name, off)
    evaluate.main(job(root, variant), evaluate.Params(lpips_backbone=None, coverage_threshold=0.05))


def test_the_small_scene_is_complete(paths: ScenePaths) -> None:
    records = read_images_json(paths.small / "images")
    assert {record.size for record in records} == {(32, 24)}
    whole = read_transforms(paths.poses / "transforms.json")
    for name, view in read_transforms(paths.small / "poses/transforms.json").items():
        assert np.allclose(view.cam_from_world, whole[name].cam_from_world)
        assert view.fx == pytest.approx(whole[name].fx / 2)
    for record in records:
        clean = read_image(paths.truth / "clean" / record.name)
        averaged = clean.reshape(24, 2, 32, 2, 3).mean((1, 3))
        small = read_image(paths.small / "clean" / record.name)
        assert np.abs(averaged - small).max() < 0.6 / 255
        kept = read_keep_mask(paths.refine / record.name).reshape(24, 2, 32, 2).all((1, 3))
        assert np.array_equal(read_keep_mask(paths.small / "masks" / record.name), kept)
        true = read_keep_mask(paths.small / "true" / record.name)
        assert not (true & ~kept).any() and true.any() and not true.all()


def test_tables_of_what_there_is(paths: ScenePaths, tmp_path: Path) -> None:
    """Off by 8 and 10 steps: 20 log10(255 / 8) = 30.07 dB and 28.13 dB, mean 29.10, spread 1.37.

    But for half an 8-bit step, by which an average of four whole steps may be rounded either way.
    """
    row(tmp_path, "loop-0", 8)
    row(tmp_path, "loop-1", 10)
    row(tmp_path, "nerf-0", 40)
    row(tmp_path, "nerf-1", 40)
    told = table.main(job(tmp_path), PARAMS)
    text = (tmp_path / "tables/tables.md").read_text()
    assert told.startswith("4 scores")
    best = re.search(
        r"\| DerainNeRF with the loop \(ours\) \| \*\*([\d.]+) ± 1\.37\*\*\\\* \|", text
    )
    assert best and float(best[1]) == pytest.approx(29.10, abs=0.04)
    assert "| NeRF | 16.09 ± 0.00 |" in text
    assert "| AttGAN | – |" in text and "Noted." in text and "LPIPS (AlexNet" in text
    with (tmp_path / "tables/gains.csv").open() as file:
        gains = {(r["row"], r["number"]): r for r in csv.DictReader(file)}
    gain = gains["DerainNeRF with the loop over NeRF", "made"]
    assert float(gain["mean"]) == pytest.approx(29.10 - 16.09, abs=0.04)
    assert gain["beyond_spread"] == "1"
    strip = read_image(tmp_path / "tables/made.png")
    assert (
        strip.shape[1] == 4 * 32 + 3 * 4
    )  # wet, NeRF, ours, clean: half the width, twice enlarged


def test_without_any_metrics_a_sentence(paths: ScenePaths, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="No row of the comparison has metrics yet"):
        table.main(job(tmp_path), PARAMS)


def test_without_truth_a_sentence(paths: ScenePaths, tmp_path: Path) -> None:
    shutil.rmtree(paths.truth / "coverage")
    with pytest.raises(UserError, match="coverage does not exist"):
        shrink.main(job(tmp_path), shrink.Params(factor=2, covered_from=0.02))
