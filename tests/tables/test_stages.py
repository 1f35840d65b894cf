"""From a scene with truth to the tables: the size of the fits, metrics of made-up rows, the table."""

from __future__ import annotations

import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from pipeline.errors import UserError
from pipeline.io.images import read_image, write_image
from pipeline.io.masks import read_keep_mask
from pipeline.io.paths import ScenePaths
from pipeline.io.scene import read_images_json, write_images_json
from pipeline.io.transforms import read_transforms
from pipeline.stage import Job
from pipeline.tables import settings
from pipeline.tables.settings import read_recorded, unlike
from stages import evaluate, shrink, table
from tests.evaluation.fabricated import fabricate

FOLDERS = {"images": "small/images", "poses": "small/poses", "refine": "small/true"}
PARAMS = table.Params(title="Made", scenes=["made"], lens=["made"], seeds=[0, 1], notes=["Noted."])

EVALUATE = evaluate.Params(lpips_backbone=None, coverage_threshold=0.05)


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
    evaluate.main(job(root, variant), EVALUATE)


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


def test_a_scene_that_could_not_be_prepared_is_told_and_hinders_no_other(
    paths: ScenePaths, tmp_path: Path
) -> None:
    """Neither one without anything nor one whose rows are there from before."""
    row(tmp_path, "nerf-0", 8)
    row(tmp_path, "nerf-1", 8)
    shutil.copytree(paths.artifacts, tmp_path / "artifacts/stale")
    shutil.rmtree(tmp_path / "artifacts/stale/small")
    table.main(job(tmp_path), PARAMS.model_copy(update={"scenes": ["made", "room", "stale"]}))
    made = tmp_path / "tables"
    assert {file.name for file in made.glob("*.png")} == {"made.png"}
    with (made / "comparison.csv").open() as file:
        why = {(r["row"], r["group"]): r["missing"] for r in csv.DictReader(file)}
    assert [why["NeRF", scene] for scene in ("made", "room", "stale")] == ["", "not computed", ""]


def test_rows_that_are_not_judged_on_every_view_say_so(paths: ScenePaths, tmp_path: Path) -> None:
    """A mean over other views than the other rows' would be none; the masks are known all the same."""
    for seed in (0, 1):
        row(tmp_path, f"derain-{seed}", 8)
    held_out = sorted((job(tmp_path, "derain-1").paths.views / "test").iterdir())
    held_out[0].unlink()
    evaluate.main(job(tmp_path, "derain-1"), EVALUATE)
    told = table.main(job(tmp_path), PARAMS)
    text = (tmp_path / "tables/tables.md").read_text()
    why = f"not all of its images could be judged (1 of {len(held_out)})"
    assert len(held_out) == 2 and told.startswith("1 scores")
    sections = {part.split("\n")[0]: part for part in text.split("\n## ")[1:]}
    assert f"DerainNeRF, as in the paper, made: {why}." in text
    masks = sections["Masks against the true coverage"]
    assert "as drawn" in masks and why not in masks


def test_without_held_out_views_no_strip(paths: ScenePaths, tmp_path: Path) -> None:
    row(tmp_path, "nerf-0", 8)
    for folder in (paths.images, paths.small / "images"):
        records = [replace(record, split="train") for record in read_images_json(folder)]
        write_images_json(folder, records)
    evaluate.main(job(tmp_path, "nerf-0"), EVALUATE)
    table.main(job(tmp_path), PARAMS)
    assert not (tmp_path / "tables/made.png").exists()
    assert "no held-out view was rendered" in (tmp_path / "tables/comparison.csv").read_text()


def _locked(root: Path, steps: dict[str, int], code: dict[str, str]) -> None:
    """What DVC writes down of the rows' fits, as far as the tables read it."""
    entries = {
        f"fit@made-{name}": {
            "cmd": "fit",
            "deps": [
                {"path": ".code/pipeline/field", "md5": code.get(name, "1.dir")},
                {"path": f"artifacts/made/{name}/own", "md5": name},
            ],
            "params": {
                "params.yaml": {"nerf": {"steps": count, "rate": 1e-05}},
                "../params.yaml": {
                    f"variants.{name}": {
                        "folders": {"refine": f"{name}/refine"},
                        "nerf": {"seed": int(name[-1])},
                    }
                },
            },
            "outs": [
                {"path": f"artifacts/made/{name}/{file}"} for file in ("views", "metrics.json")
            ],
        }
        for name, count in steps.items()
    }
    (root / "made").mkdir(exist_ok=True)
    with (root / "made/dvc.lock").open("w") as file:
        YAML().dump({"schema": "2.0", "stages": entries}, file)


def test_rows_that_were_not_made_alike_are_told(paths: ScenePaths, tmp_path: Path) -> None:
    """Between the phases of a run after a change, new seeds stand beside old ones."""
    names = ("nerf-0", "nerf-1", "loop-0", "loop-1")
    for name in names:
        row(tmp_path, name, 10)
    same = dict.fromkeys(names, 800)
    _locked(tmp_path, same, {})
    table.main(job(tmp_path), PARAMS)
    assert "alike" not in (tmp_path / "tables/tables.md").read_text(), "seeds may differ"
    told = r"Not made alike: NeRF \(seed 1\) had another nerf of params\.yaml than the rest\."
    _locked(tmp_path, same | {"nerf-1": 600}, {})
    table.main(job(tmp_path), PARAMS)
    text = (tmp_path / "tables/tables.md").read_text()
    sections = {part.split("\n")[0]: part for part in text.split("\n## ")[1:]}
    with_it = [name for name, part in sections.items() if re.search(told, part)]
    assert len(with_it) == 4 and not {"Poses", "The paper's own Table I"} & set(with_it)
    assert "Not made alike" in (tmp_path / "tables/comparison.tex").read_text()
    _locked(tmp_path, same, {"loop-0": "2.dir"})
    table.main(job(tmp_path), PARAMS)
    told = "DerainNeRF with the loop (ours) (seed 0) had another pipeline/field than the rest."
    assert told in (tmp_path / "tables/tables.md").read_text()


def test_scenes_are_named_where_they_were_not_made_alike() -> None:
    known = {(scene, "nerf", seed): {"a": "1"} for scene in "xyz" for seed in (0, 1)}
    assert unlike(known) == []
    known["x", "nerf", 1] = known["y", "nerf", 1] = {"a": "2", "other": "3"}
    known["z", "attgan", 0] = {"a": "2"}
    (told,) = unlike(known)
    assert told.startswith("Not made alike: NeRF (x, y; seed 1); AttGAN had another a than")
    known |= {("z", "nerf", 1): {"a": "2"}}
    assert unlike(known)[0].count("seed 0") == 1, "of two halves one is told"


def test_what_dvc_itself_writes_is_read(tmp_path: Path) -> None:
    lock = Path(__file__).resolve().parents[2] / "experiments/scenes/dvc.lock"
    made = read_recorded([lock])["data/street"]
    assert "synthesize of params.yaml" in made and made["pipeline/drops"].endswith(".dir")
    assert read_recorded([]) == {}


def test_a_lock_file_that_dvc_is_writing_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """DVC empties it, thinks, and writes it anew from the top while other rows are made."""
    _locked(tmp_path, {"nerf-0": 800, "nerf-1": 800}, {})
    lock = tmp_path / "made/dvc.lock"
    whole = lock.read_text()
    states = ["", "", whole[: len(whole) // 2], whole, whole]
    lock.write_text("")
    monkeypatch.setattr(settings.time, "sleep", lambda seconds: lock.write_text(states.pop(0)))
    made = read_recorded([lock])
    assert made["artifacts/made/nerf-1/metrics.json"]["nerf of params.yaml"]["steps"] == 800
    assert states == []


@pytest.mark.parametrize("text", ["stages: [1]", "stages: {a: {outs: [{}]}}", "a: [", "7"])
def test_a_damaged_lock_file_is_told(tmp_path: Path, text: str) -> None:
    (tmp_path / "dvc.lock").write_text(text)
    with pytest.raises(UserError, match=r"dvc\.lock is not a lock file of DVC"):
        read_recorded([tmp_path / "dvc.lock"])


def test_without_any_metrics_a_sentence(paths: ScenePaths, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="No row of the comparison has metrics yet"):
        table.main(job(tmp_path), PARAMS)


def test_without_truth_a_sentence(paths: ScenePaths, tmp_path: Path) -> None:
    shutil.rmtree(paths.truth / "coverage")
    with pytest.raises(UserError, match="coverage does not exist"):
        shrink.main(job(tmp_path), shrink.Params(factor=2, covered_from=0.02))
