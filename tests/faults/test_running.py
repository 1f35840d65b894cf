"""Stages that are stopped, killed or run twice: nothing half-written, and the same bytes the next time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import filelock
import pytest
import torch

from tests.chain import project
from tests.faults.workshop import SCENE, Workshop


def _start(workshop: Workshop, stage: str) -> subprocess.Popen[str]:
    params = str(workshop.root / "params.yaml")
    command = [sys.executable, "-m", f"stages.{stage}", "--scene", SCENE, "--params", params]
    return subprocess.Popen(
        command, cwd=project.ROOT, stderr=subprocess.PIPE, text=True, preexec_fn=_hear_interrupts
    )


def _hear_interrupts() -> None:
    """What a shell starts in the background ignores SIGINT, the tests and their stages with it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _stop_when(
    process: subprocess.Popen[str], ready: Callable[[], object], how: signal.Signals
) -> tuple[int, str]:
    """Sends the signal as soon as `ready`; the exit code and what was said."""
    while not ready():
        assert process.poll() is None, "the stage ended before it could be stopped"
        time.sleep(0.002)
    process.send_signal(how)
    said = process.communicate(timeout=60)[1]
    return process.returncode, said


def _without(workshop: Workshop, name: str) -> dict[str, str]:
    """Takes an artifact away; the files that were in it."""
    files = workshop.files()
    folder = (workshop.artifacts / name).relative_to(workshop.root).as_posix()
    taken = {path: digest for path, digest in files.items() if path.startswith(f"{folder}/")}
    assert taken
    for path in taken:
        (workshop.root / path).unlink()
    for path in sorted((workshop.artifacts / name).rglob("*"), reverse=True):
        path.rmdir()
    (workshop.artifacts / name).rmdir()
    return taken


def _pieces(workshop: Workshop, name: str) -> list[Path]:
    return list(workshop.artifacts.glob(f".{name}.tmp-*/*"))


def test_a_stage_that_is_already_running(whole: Workshop) -> None:
    work = whole.root / f"artifacts/.work/{SCENE}/masks"
    (work / "log.txt").write_text("the log of the run that goes on")
    with filelock.FileLock(work / "lock"):
        whole.refuses("masks", "already running", "Wait for it")
    assert (work / "log.txt").read_text() == "the log of the run that goes on"
    assert whole.run("masks").code == 0


def test_killed_while_writing(whole: Workshop) -> None:
    taken = _without(whole, "attention")
    process = _start(whole, "attention")
    code, _ = _stop_when(process, lambda: _pieces(whole, "attention"), signal.SIGKILL)
    assert code == -signal.SIGKILL
    assert not (whole.artifacts / "attention").exists()
    whole.refuses("masks", "does not exist", "python -m stages.attention")
    assert whole.run("attention").code == 0
    assert taken.items() <= whole.files().items()
    assert not list(whole.artifacts.glob(".*tmp-*"))


def test_memory_that_runs_out(whole: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    """As torch tells it, for one view among many: a sentence, and the old views stay."""
    monkeypatch.setattr("stages.render.composite_photo", lambda *_, **__: torch.empty(2**50))
    whole.refuses("render", "There was not enough memory")


@pytest.mark.parametrize(
    ("how", "code", "told"),
    [(signal.SIGTERM, 143, ""), (signal.SIGINT, 130, "interrupted; nothing half-written is left")],
)
def test_stopped_while_writing(whole: Workshop, how: signal.Signals, code: int, told: str) -> None:
    _without(whole, "attention")
    before = whole.files()
    process = _start(whole, "attention")
    ended, said = _stop_when(process, lambda: _pieces(whole, "attention"), how)
    assert ended == code, said
    assert told in said and "Traceback" not in said
    assert whole.files() == before
    assert not list(whole.artifacts.glob(".*tmp-*"))


DEAF_ONCE = """
import ctypes, os, signal, time
import pipeline.stage
from stages.masks import Params

def main(job, params):
    kill = ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGTERM))
    try:
        kill()  # the exception that this makes ends within the callback, and is forgotten
        print("still here", flush=True)
        time.sleep(600)
    finally:
        print("cleaned up", flush=True)

pipeline.stage.PATIENCE = 1.0
pipeline.stage.run("masks", Params, main)
"""


@pytest.mark.parametrize("stage", ["masks", "nerf"])
def test_interrupted_while_it_loads(stage: str) -> None:
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", f"stages.{stage}", "--scene", SCENE],
        cwd=project.ROOT, stderr=subprocess.PIPE, text=True, preexec_fn=_hear_interrupts,
    )  # fmt: skip
    assert process.stderr is not None
    for line in process.stderr:
        if line.rstrip().endswith("numpy.version"):  # in the midst of it
            process.send_signal(signal.SIGINT)
            break
    said = process.communicate(timeout=60)[1].splitlines()
    assert process.returncode == 130
    assert [line for line in said if not line.startswith("import time")] == [
        "interrupted before anything was done"
    ]


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="there are no timers")
def test_a_stage_told_to_end_in_a_callback_from_c_is_told_again(whole: Workshop) -> None:
    params = ["--scene", SCENE, "--params", str(whole.root / "params.yaml")]
    done = subprocess.run(
        [sys.executable, "-c", DEAF_ONCE, *params],
        cwd=project.ROOT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert "ctypes callback" in done.stderr
    assert done.stdout.split("\n") == ["still here", "cleaned up", ""]
    assert done.returncode == 143


def test_a_killed_fit_goes_on_where_it_was_and_ends_with_the_same_bytes(whole: Workshop) -> None:
    taken = _without(whole, "nerf")
    # The fit has much to write when it is killed: it shall not end before.
    whole.set("nerf", save_every=1)
    checkpoint = whole.root / f"artifacts/.work/{SCENE}/nerf/checkpoint.safetensors"
    code, _ = _stop_when(_start(whole, "nerf"), checkpoint.exists, signal.SIGKILL)
    assert code == -signal.SIGKILL
    assert not (whole.artifacts / "nerf").exists()
    done = whole.run("nerf")
    assert done.code == 0
    assert taken.items() <= whole.files().items()
    assert not checkpoint.exists()


def test_a_bug_keeps_its_traceback(whole: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is no fault of the user's: raised as it is, and kept in the log."""
    monkeypatch.setattr("stages.masks.write_json", lambda *_: 1 / 0)
    before = whole.files()
    with pytest.raises(ZeroDivisionError):
        whole.run("masks")
    assert whole.files() == before
    log = (whole.root / f"artifacts/.work/{SCENE}/masks/log.txt").read_text()
    assert "ZeroDivisionError" in log and "Traceback" in log


def test_from_another_folder(whole: Workshop, tmp_path: Path) -> None:
    _without(whole, "masks")
    here = Path.cwd()
    os.chdir(tmp_path)
    try:
        assert whole.run("masks").code == 0
    finally:
        os.chdir(here)
    assert (whole.artifacts / "masks/masks.json").exists()
