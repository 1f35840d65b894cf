"""Several stages of one scene in one process, so that their libraries are loaded once.

    python -m experiments.tables.steps nerf render evaluate --scene street --variant nerf-0

runs them one after the other, each as `python -m stages.NAME` would, and stops at the first that fails.
Where STEPS_ADDRESS is the address of :mod:`experiments.tables.warm`, it asks there for a process, unless code
was changed since that began: DVC writes down the code that lies there now, so that must be the one that runs.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from multiprocessing.connection import Client
from pathlib import Path

from pipeline.io.code import code_key

ADDRESS, CODE = "STEPS_ADDRESS", "STEPS_CODE"


def main(words: Sequence[str]) -> int:
    """Runs the stages named before the first flag, here or where they are loaded; the exit code."""
    if ADDRESS not in os.environ or os.environ.get(CODE) != code_of_stages():
        return run_stages(words)
    usable = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    try:
        with Client(os.environ[ADDRESS]) as line:
            line.send((words, Path.cwd(), usable))
            code: int = line.recv()
            return code
    except (EOFError, OSError):
        return 1  # whoever ordered the work has ended


def code_of_stages() -> str:
    """A digest of all code that stages can run."""
    return code_key(".", "../stages")


def run_stages(words: Sequence[str]) -> int:
    """Runs the stages named before the first flag; the exit code of the last one that ran."""
    from pipeline.stage import run  # only here: who asks another process need not load it

    first = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    for name in words[:first]:
        stage = importlib.import_module(f"stages.{name}")
        sys.argv = [f"stages.{name}", *words[first:]]
        try:
            run(name, stage.Params, stage.main)
        except SystemExit as end:
            if end.code:
                return int(end.code)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
