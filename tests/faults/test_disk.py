"""A disk that is full or read-only, for real: a small file system of the stage's own."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.chain import project
from tests.faults.workshop import SCENE, Workshop

APART = ("unshare", "--map-root-user", "--mount", "sh", "-ec")


def _may_mount() -> bool:
    if not shutil.which("unshare"):
        return False
    return not subprocess.run([*APART, "mount -t tmpfs tmpfs /mnt"], capture_output=True).returncode


pytestmark = pytest.mark.skipif(
    not _may_mount(), reason="mounting a file system is not allowed here"
)


def _run(
    workshop: Workshop, stage: str, prepare: str
) -> tuple[subprocess.CompletedProcess[str], str]:
    """Runs a stage with artifacts/ prepared by shell commands; also tells what is in there afterwards."""
    command = (
        f"{sys.executable} -m stages.{stage} --scene {SCENE} --params {workshop.root}/params.yaml"
    )
    look = f"find {workshop.root}/artifacts -not -path '*/.work*' | sort >&3"
    found = workshop.root / "found.txt"
    script = f"{prepare}\n{command} && code=0 || code=$?\n{look}\nexit $code"
    done = subprocess.run(
        [*APART, f"exec 3>{found}\n{script}"], cwd=project.ROOT, capture_output=True, text=True
    )
    return done, found.read_text()


def _refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr


@pytest.mark.parametrize(
    ("stage", "makes", "room_kb"),
    [
        ("attention", "attention", 100),
        ("poses", "poses", 600),
        ("render", "views", 1800),
        ("evaluate", "metrics.json", 0),
    ],
)
def test_a_full_disk(whole: Workshop, stage: str, makes: str, room_kb: int) -> None:
    made = whole.artifacts / makes
    shutil.rmtree(made) if made.is_dir() else made.unlink()
    shutil.rmtree(whole.root / "artifacts/.work")
    kept = Path(shutil.move(whole.root / "artifacts", whole.root / "kept"))
    (whole.root / "artifacts").mkdir()
    prepare = (
        f"cd {whole.root}\n"
        "mount -t tmpfs -o size=64m tmpfs artifacts\n"
        f"cp -r {kept}/. artifacts\n"
        "dd if=/dev/zero of=artifacts/filler bs=64k 2>&3 || true\n"
        f"truncate -s -{room_kb}k artifacts/filler\n"
        f"cd {project.ROOT}\n"
    )
    done, left = _run(whole, stage, prepare)
    _refused(done, "disk is full", "Free some space")
    assert ".tmp-" not in left
    assert f"artifacts/{SCENE}/{makes}\n" not in left


def test_a_read_only_disk(whole: Workshop) -> None:
    prepare = (
        f"mount --bind {whole.root}/artifacts {whole.root}/artifacts\n"
        f"mount -o remount,ro,bind {whole.root}/artifacts\n"
    )
    before = whole.files()
    done, _ = _run(whole, "masks", prepare)
    _refused(done, "cannot be written", "Check its permissions")
    assert whole.files() | {"found.txt": ""} == before | {"found.txt": ""}
