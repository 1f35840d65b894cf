"""What benchmarks measure: a scene of smaller photos is the same scene, compiling is no part of a fit, and
what the command line asks for is what is fitted.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from benchmarks import budget, field, quality
from benchmarks.flags import rows_of, settings_of
from benchmarks.quality import Scene, seen_pixels, shrunk
from pipeline.geometry.rays import pixel_rays
from pipeline.io.transforms import View


def scene() -> Scene:
    colours = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)
    wet = np.zeros((4, 6), np.float32)
    wet[1, 3] = 0.5
    view = View("a", np.eye(4), 5.0, 6.0, 2.5, 1.75, 0.0, 6, 4, 1.0, 9.0)
    drawn = {"masks": {"a": wet == 0}, "refine": {}}
    return Scene({"a": colours}, {"a": 1 - colours}, {"a": wet}, drawn, {"true": {"a": view}})


def test_a_pixel_is_the_mean_of_its_parts_and_wet_if_one_is() -> None:
    big, small = scene(), shrunk(scene(), 2)
    assert small.rainy["a"].shape == (2, 3, 3)
    assert small.rainy["a"][1, 2] == pytest.approx(big.rainy["a"][2:, 4:].mean((0, 1)))
    assert small.clean["a"][0, 0] == pytest.approx(big.clean["a"][:2, :2].mean((0, 1)))
    assert np.argwhere(small.coverage["a"]).tolist() == [[0, 1]]
    assert np.argwhere(~small.drawn["masks"]["a"]).tolist() == [[0, 1]]


def test_a_pixel_looks_along_the_mean_of_its_parts_rays() -> None:
    big, small = scene().views["true"]["a"], shrunk(scene(), 2).views["true"]["a"]
    assert (small.width, small.height) == (3, 2)
    pose = torch.eye(4)[:3]
    columns, rows = torch.tensor([4, 5, 4, 5]), torch.tensor([2, 2, 3, 3])
    _, parts = pixel_rays(columns, rows, torch.tensor(big.intrinsics), pose)
    _, whole = pixel_rays(
        torch.tensor([2]), torch.tensor([1]), torch.tensor(small.intrinsics), pose
    )
    torch.testing.assert_close(whole[:, 0], parts.mean(1))


def test_one_part_is_the_scene_itself() -> None:
    assert np.array_equal(shrunk(scene(), 1).rainy["a"], scene().rainy["a"])
    assert shrunk(scene(), 1).views["true"]["a"].intrinsics == scene().views["true"]["a"].intrinsics


class Compiles:
    """A fit that takes 0.3 s of the processor when it is first called, and none after that."""

    def __init__(self) -> None:
        self.steps: list[int] = []

    def __call__(self, model: Any, buffer: Any, *, steps: int, **how: Any) -> None:
        begin = time.process_time()
        while not self.steps and time.process_time() < begin + 0.3:
            pass
        self.steps.append(steps)
        how.get("progress", lambda *told: None)(steps, 0.0, 0.0)


def test_compiling_is_no_part_of_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field, "fit", first := Compiles())
    row = field.measure("fast", 1, 5.0, 50, 64, 0, (24, 18))
    assert row.seconds < 0.2 and first.steps[-1] == row.steps == 50
    monkeypatch.setattr(quality, "fit", second := Compiles())
    monkeypatch.setattr(torch, "set_num_threads", lambda count: None)
    one = scene()
    views = one.views["true"] | {"b": replace(one.views["true"]["a"], name="b")}
    rainy, clean = ({"a": p["a"], "b": p["a"]} for p in (one.rainy, one.clean))
    two = Scene(rainy, clean, one.coverage | {"b": one.coverage["a"]}, {}, {"true": views})
    settings = yaml.safe_load((quality.ROOT / "params.yaml").read_text())["nerf"]
    settings |= {"levels": 1, "table_log2": 10, "resolution": 32, "steps": 50}
    assert quality.measure(two, "clean", settings, 1, {}).seconds < 0.2
    assert second.steps[-1] == 50


def nine(wet: dict[str, np.ndarray], depth: np.ndarray) -> Scene:
    """Nine photos from one place, the first and the last held out, of a wall at ``depth`` ``(4, 6)``."""
    view = scene().views["true"]["a"]
    stems = [f"{number}" for number in range(9)]
    grey = {stem: np.full((4, 6, 3), 0.5, np.float32) for stem in stems}
    coverage = {stem: wet.get(stem, np.zeros((4, 6), np.float32)) for stem in stems}
    views = {"true": {stem: replace(view, name=stem) for stem in stems}}
    return Scene(grey, grey, coverage, {}, views, {stem: depth for stem in stems})


@pytest.mark.parametrize("depth", [3.0, 0.0])
def test_seen_is_what_three_fitted_photos_show_dry_where_the_truth_puts_it(depth: float) -> None:
    wet = np.zeros((4, 6), np.float32)
    wet[:2, :2] = 1.0
    for number, expected in ((4, True), (5, False)):  # of seven that are fitted
        covered = {f"{n + 1}": wet for n in range(number)}
        seen = seen_pixels(nine(covered, np.full((4, 6), depth, np.float32)), {})
        assert list(seen) == ["0", "8"]
        assert seen["8"][0, 0] == expected and seen["8"][2:, 2:].all()


def test_a_fit_is_as_long_as_its_seconds_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]

    def costs(model: Any, buffer: Any, *, steps: int, **how: Any) -> None:
        clock[0] += 0.25 * steps

    monkeypatch.setattr(quality, "fit", costs)
    monkeypatch.setattr(budget.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(torch, "set_num_threads", lambda count: None)
    settings = yaml.safe_load((quality.ROOT / "params.yaml").read_text())["nerf"]
    settings |= {"levels": 1, "table_log2": 10, "resolution": 32}
    wall = nine({}, np.full((4, 6), 3.0, np.float32))
    row = budget.measure(wall, "clean", 60.0, 1, settings, seen_pixels(wall, {}))
    assert (row.steps, row.seconds) == (240, 60.0)
    assert row.psnr == pytest.approx(row.seen) and np.isfinite(row.psnr)


def test_what_is_set_reaches_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}
    monkeypatch.setattr(quality, "fit", lambda model, buffer, **how: asked.update(how))
    pairs = ["shards=1", "exposure=true", "rate=3e-1"]
    settings = settings_of(argparse.ArgumentParser(), pairs, quality.USED)
    quality.fit_with(settings, None, None, 7, 2)  # type: ignore[arg-type]
    assert asked["steps"] == 7 and asked["rate"] == 0.3
    assert (asked["shards"], asked["exposure"]) == (1, True)
    used = {*quality.FIELD, *asked, "near_factor", "far_factor"} - {"steps", "threads"}
    assert used == set(quality.USED)


@pytest.mark.parametrize(
    "pair, told",
    [
        ("sampels=12", "has no sampels"),
        ("paper_steps=12", "paper_steps has no effect here"),
        ("samples", "write KEY=VALUE"),
        ("samples=many", "nerf.samples: Input should be"),
        ("samples=[", "is no value"),
    ],
)
def test_what_cannot_be_set_is_refused(
    pair: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        settings_of(argparse.ArgumentParser(), [pair], quality.USED)
    assert end.value.code == 2 and told in capsys.readouterr().err


def test_rows_that_there_are_not_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert rows_of(argparse.ArgumentParser(), "true,clean", quality.ROWS) == ["true", "clean"]
    with pytest.raises(SystemExit):
        rows_of(argparse.ArgumentParser(), "true,cleen", quality.ROWS)
    assert "there is no row 'cleen'; there are clean, clean-masked" in capsys.readouterr().err
