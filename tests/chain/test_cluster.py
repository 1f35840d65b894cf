"""Per-image work on a Dask cluster of two processes: the same bytes, and faults that name their image."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import LocalCluster

from tests.chain import project
from tests.faults.workshop import SCENE, Workshop

PER_IMAGE = ("attention", "masks", "render", "evaluate")

FOLDERS = {"render": "views"}


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        yield cluster.scheduler_address


def _run(root: Path, stage: str, address: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", f"stages.{stage}", "--scene", SCENE]
    params = ["--params", str(root / "params.yaml")]
    return subprocess.run(
        [*command, *params], cwd=project.ROOT, capture_output=True, text=True,
        env={**os.environ, "DERAINNERF_SCHEDULER": address},
    )  # fmt: skip


def _bytes(workshop: Workshop) -> dict[str, str]:
    return {
        path.relative_to(workshop.artifacts).as_posix(): hashlib.sha256(
            path.read_bytes()
        ).hexdigest()
        for path in sorted(workshop.artifacts.rglob("*"))
        if path.is_file()
    }


def test_two_processes_make_the_same_bytes(
    whole_scene: Workshop, address: str, tmp_path: Path
) -> None:
    there = Workshop(shutil.copytree(whole_scene.root, tmp_path / "there"))
    for stage in PER_IMAGE:
        made = there.artifacts / FOLDERS.get(stage, stage)
        shutil.rmtree(made) if made.exists() else (there.artifacts / "metrics.json").unlink()
        done = _run(there.root, stage, address)
        assert done.returncode == 0, f"{stage}: {done.stderr}"
    assert _bytes(there) == _bytes(whole_scene)


def test_a_fault_on_the_cluster_names_its_image(
    whole_scene: Workshop, address: str, tmp_path: Path
) -> None:
    there = Workshop(shutil.copytree(whole_scene.root, tmp_path / "there"))
    (there.artifacts / "images/view_3.png").write_text("no picture")
    before = _bytes(there)
    done = _run(there.root, "attention", address)
    assert done.returncode == 2
    assert "view_3.png is not a readable image" in done.stderr
    assert "Traceback" not in done.stderr
    assert _bytes(there) == before
    assert not list(there.root.rglob(".*tmp-*"))


def test_no_scheduler_at_the_address(
    whole_scene: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.parallel.ANSWER_WITHIN", "1s")
    whole_scene.refuses(
        "attention", "no Dask scheduler answers", flags=("--scheduler", "tcp://127.0.0.1:9")
    )
