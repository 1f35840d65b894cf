"""The whole chain on nine small photos, as DVC runs it and by hand: no compiler, network or GPU."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
import pytest

from tests.chain import project
from tests.chain.project import SCENE, VIEWS

KEYS = (
    "test.psnr", "test.ssim", "test.lpips", "covered.psnr", "composite.psnr", "composite.ssim",
    "masks.iou", "masks.precision", "masks.recall", "poses.registered", "poses.total",
    "poses.rotation_deg",
)  # fmt: skip


class Clone:
    """A clone after its first `dvc repro`."""

    def __init__(self, root: Path) -> None:
        project.copy_project(root)
        (root / ".git").mkdir()
        subprocess.run(["git", "init", "-q"], cwd=root, check=True)
        self.root = root
        self.first = project.ran(project.dvc(root, "repro"))
        self.graph = project.Graph(root)
        self.files = project.fingerprints(root)

    def json(self, name: str) -> Any:
        return json.loads((self.root / "artifacts" / SCENE / name).read_text())


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Clone:
    return Clone(tmp_path_factory.mktemp("chain") / "clone")


def _numbers(metrics: dict[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in metrics.items():
        if isinstance(value, dict):
            yield from _numbers(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def test_every_stage_runs_after_what_it_needs(clone: Clone) -> None:
    assert set(clone.first) == set(clone.graph.commands)
    place = {name: index for index, name in enumerate(clone.first)}
    for name, needed in clone.graph.needs.items():
        assert all(place[other] < place[name] for other in needed)
    assert clone.graph.needs[f"attention@{SCENE}"] == {f"ingest@{SCENE}"}
    assert f"masks@{SCENE}" in clone.graph.needs[f"poses@{SCENE}"]


@pytest.mark.parametrize("name", ["metrics.json", "unmasked/metrics.json"])
def test_the_metrics_are_whole_and_true(clone: Clone, name: str) -> None:
    numbers = dict(_numbers(clone.json(name)))
    assert set(KEYS) <= set(numbers)
    missing = {key for key, value in numbers.items() if value is None}
    assert missing == {"test.lpips"}, "everything is known here but the backbone of LPIPS"
    assert numbers["test.lpips_reason"]
    assert numbers["poses.registered"] == numbers["poses.total"] == VIEWS
    assert numbers["poses.rotation_deg"] < 1
    assert 10 < numbers["test.psnr"] < 40
    found, true = numbers["masks.coverage"], numbers["masks.true_coverage"]
    by_chance = found * true / (found + true - found * true)
    assert numbers["masks.iou"] > 1.5 * by_chance
    assert not [value for value in numbers.values() if isinstance(value, str) and "/tmp" in value]


def test_the_composite_keeps_what_the_photo_shows(clone: Clone) -> None:
    metrics = clone.json("metrics.json")
    assert metrics["composite"]["psnr"] > metrics["test"]["psnr"] + 1
    assert metrics["composite"]["ssim"] > metrics["test"]["ssim"] + 0.1


def test_the_second_row_is_fitted_without_masks(clone: Clone) -> None:
    masked, unmasked = clone.json("nerf/field.json"), clone.json("unmasked/nerf/field.json")
    assert masked["use_masks"] and not unmasked["use_masks"]
    assert unmasked["rays"] == len(unmasked["photos"]) * 240 * 180
    assert masked["rays"] < unmasked["rays"]


def test_the_page_stands_alone_and_shows_the_numbers(clone: Clone) -> None:
    folder = clone.root / "artifacts" / SCENE / "report"
    assert [path.name for path in folder.iterdir()] == ["index.html"]
    page = (folder / "index.html").read_text(encoding="utf-8")
    addresses = re.findall(r"""(?:src|href|poster|data)=["']([^"']*)""", page)
    addresses += re.findall(r"url\(([^)]*)\)", page)
    assert [one for one in addresses if not one.startswith(("data:", "#"))] == []
    without_names = page.replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?://", without_names)
    for name in ("metrics.json", "unmasked/metrics.json"):
        assert f"{clone.json(name)['test']['psnr']:.2f}" in page


def test_nothing_half_written_is_left(clone: Clone) -> None:
    assert not list((clone.root / "artifacts").rglob(".*.tmp-*"))
    assert not list((clone.root / "artifacts").rglob("checkpoint*"))


def test_a_second_repro_runs_nothing(clone: Clone) -> None:
    said = project.dvc(clone.root, "repro")
    assert project.ran(said) == []
    assert "up to date" in said
    assert project.fingerprints(clone.root) == clone.files


def test_a_changed_threshold_reruns_masks_and_what_follows_and_back_runs_nothing(
    clone: Clone,
) -> None:
    graph, masks, poses = clone.graph, f"masks@{SCENE}", f"poses@{SCENE}"
    before = json.loads((clone.root / f"artifacts/{SCENE}/masks/masks.json").read_text())
    project.set_param(clone.root, "masks", "threshold", before["threshold"] + 0.2)
    assert project.ran(project.dvc(clone.root, "repro", poses)) == [masks, poses]
    changed = json.loads(project.dvc(clone.root, "status", "--json"))
    assert set(changed) == {name for name in graph.needs if graph.needs[name] & {masks, poses}} - {
        poses
    }
    assert graph.after(masks) == set(graph.needs) - {f"ingest@{SCENE}", f"attention@{SCENE}"}
    assert project.fingerprints(clone.root) != clone.files
    project.set_param(clone.root, "masks", "threshold", before["threshold"])
    assert project.ran(project.dvc(clone.root, "repro")) == []
    assert project.fingerprints(clone.root) == clone.files


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the kernel's help is Linux's")
def test_a_killed_repro_takes_its_stage_along(clone: Clone) -> None:
    """The fit has hours to go when DVC is killed: a stage that is all but done may end by itself."""
    params = clone.root / "params.yaml"
    before = params.read_text()
    project.set_scene_param(clone.root, "nerf", "steps", 1_000_000)
    work = clone.root / f"artifacts/.work/{SCENE}/nerf"
    (work / "log.txt").unlink()  # begun anew by the stage that holds the lock
    process = project.start_dvc(clone.root, "repro", "--force", "--single-item", f"nerf@{SCENE}")
    for _ in range(6000):
        if (work / "log.txt").exists():
            break
        time.sleep(0.01)
    process.kill()
    params.write_text(before)
    assert process.wait() == -signal.SIGKILL and (work / "log.txt").exists()
    with filelock.FileLock(work / "lock", timeout=60):  # a minute for the stage to notice
        pass
    assert not (clone.root / f"artifacts/{SCENE}/nerf").exists()
    assert project.ran(project.dvc(clone.root, "repro")) == []
    assert project.fingerprints(clone.root) == clone.files


def test_a_tarball_by_hand_on_one_core_makes_the_same_bytes(clone: Clone, tmp_path: Path) -> None:
    """Without .git DVC needs core.no_scm; a stage by hand is the same stage; bytes know no threads."""
    root, core = tmp_path / "tarball", set(list(os.sched_getaffinity(0))[:1])
    project.copy_project(root)
    (root / ".venv").symlink_to(sys.prefix)
    project.dvc(root, "config", "--local", "core.no_scm", "true", cores=core)
    masks = f"masks@{SCENE}"
    by_dvc = project.ran(project.dvc(root, "repro", masks, cores=core))
    assert by_dvc[-1] == masks
    for name in clone.graph.order:
        if name not in by_dvc:
            project.by_hand(root, clone.graph.commands[name], cores=core)
    assert project.fingerprints(root) == clone.files
