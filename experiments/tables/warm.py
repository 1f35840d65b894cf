"""Stages run in copies of a process that has their libraries loaded: some seconds each time otherwise.

Where the environment says so, `python -m experiments.tables.steps` asks for one.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path

from experiments.tables.steps import ADDRESS, run_stages

# Those of the rows, of which there are many; what is done once per scene loads what it needs besides.
LOADED = ["stages.refine", "stages.nerf", "stages.render", "stages.evaluate"]


@contextmanager
def serving() -> Iterator[dict[str, str]]:
    """What the environment of `steps` needs so that its stages run in copies, while this lasts.

    The process that is copied has the environment of this one, and ends with it.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload(LOADED)
    with tempfile.TemporaryDirectory() as folder, Listener(str(Path(folder) / "steps")) as door:
        guard = threading.Thread(target=_let_in, args=(door,), daemon=True)
        guard.start()
        try:
            yield {ADDRESS: str(door.address)}
        finally:
            for copy in multiprocessing.active_children():
                copy.terminate()
            with suppress(OSError), Client(door.address) as last:  # the guard waits for somebody
                last.send(None)
            guard.join()


def _let_in(door: Listener) -> None:
    while (asked := (line := door.accept()).recv()) is not None:
        threading.Thread(target=_answer, args=(line, asked), daemon=True).start()


def _answer(line: Connection, asked: tuple[Sequence[str], Path, set[int]]) -> None:
    with line:
        copy = multiprocessing.get_context("forkserver").Process(target=_as_asked, args=asked)
        copy.start()
        copy.join()
        line.send(copy.exitcode)


def _as_asked(words: Sequence[str], folder: Path, usable: set[int]) -> None:
    """In the copy: where and on which cores the asking process would run them itself."""
    gc.freeze()  # what was loaded stays: nothing of it need be looked through
    os.chdir(folder)
    if usable:
        os.sched_setaffinity(0, usable)
    sys.exit(run_stages(words))
