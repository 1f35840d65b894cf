"""A small scene with every artifact, to break one thing at a time, and the runner to do it with."""

from __future__ import annotations

import hashlib
import importlib
import io
import logging
import shutil
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from ruamel.yaml import YAML

from pipeline.stage import run
from tests.chain import project

SCENE = project.SCENE
CHAIN = [
    entry["do"]["cmd"].split("stages.")[1].split()[0]
    for entry in yaml.safe_load((project.ROOT / "dvc.yaml").read_text())["stages"].values()
    if entry["foreach"] == "${scenes}"
]


@dataclass(frozen=True)
class Outcome:
    """How a stage ended: its exit code and what it said."""

    code: int
    said: str


class Workshop:
    """A folder with params.yaml, weights, photos and, where copied from a full one, artifacts."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.data = root / "data" / SCENE
        self.artifacts = root / "artifacts" / SCENE

    def set(self, section: str, **values: Any) -> None:
        """Changes parameters in params.yaml."""
        text = YAML()
        params = text.load(self.root / "params.yaml")
        params[section] |= values
        text.dump(params, self.root / "params.yaml")

    def run(self, stage: str, *flags: str) -> Outcome:
        """Runs a stage through the runner, in this process."""
        module = importlib.import_module(f"stages.{stage}")
        argv = [stage, "--scene", SCENE, "--params", str(self.root / "params.yaml"), *flags]
        with _set_aside(argv) as said, pytest.raises(SystemExit) as left:
            run(stage, module.Params, module.main)
        return Outcome(int(left.value.code or 0), said())

    def files(self) -> dict[str, str]:
        """SHA-256 of every file by its path; scratch is left out."""
        return {
            path.relative_to(self.root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(self.root.rglob("*"))
            if path.is_file() and self.root / "artifacts" / ".work" not in path.parents
        }

    def refuses(self, stage: str, *sentence: str, flags: tuple[str, ...] = ()) -> Outcome:
        """Runs a stage that must refuse: exit code 2, a sentence with these words, nothing changed."""
        before, folders = self.files(), self._folders()
        outcome = self.run(stage, *flags)
        told = outcome.said
        assert outcome.code == 2, told
        assert "Traceback" not in told
        lines = [line.split("\r")[-1] for line in told.splitlines()]  # a bar ends with a return
        start = max(i for i, line in enumerate(lines) if line.startswith(f"{stage}: "))
        assert lines[start].endswith((".", "?")), told
        hints = lines[start + 1 :]
        assert hints and all(line.startswith("  ") and line.endswith(".") for line in hints), told
        for words in sentence:
            assert words in told, told
        assert self.files() == before
        assert self._folders() == folders
        return outcome

    def _folders(self) -> list[str]:
        scratch = self.root / "artifacts" / ".work"
        return sorted(
            str(path)
            for path in self.root.rglob("*")
            if path.is_dir()
            and scratch not in path.parents
            and path not in (scratch, scratch.parent, self.artifacts)
        )


class _set_aside:
    """argv, signal handlers, log handlers and stderr as a stage finds them, and back."""

    def __init__(self, argv: list[str]) -> None:
        self.argv = argv

    def __enter__(self) -> Any:
        self.before = sys.argv, sys.stderr, signal.getsignal(signal.SIGTERM)
        self.logs = logging.getLogger().handlers, logging.getLogger().level
        sys.argv, sys.stderr = self.argv, io.StringIO()
        return sys.stderr.getvalue

    def __exit__(self, *_: object) -> None:
        sys.argv, sys.stderr, terminate = self.before
        signal.signal(signal.SIGTERM, terminate)
        root = logging.getLogger()
        for handler in root.handlers:
            handler.close()
        root.handlers, level = self.logs
        root.setLevel(level)


def bare(root: Path) -> Workshop:
    """Photos, parameters and weights; no artifacts."""
    root.mkdir(parents=True)
    for name in ("params.yaml", "weights"):
        source = project.ROOT / name
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, root / name)
    project.photograph(root / "data" / SCENE)
    project.write_small_params(root)
    return Workshop(root)
