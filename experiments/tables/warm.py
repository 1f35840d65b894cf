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
from multiprocessing.connection import Client, Connection, Listener, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from experiments.tables.steps import ADDRESS, CODE, code_of_stages, run_stages

LOADED = ["experiments.tables.loaded"]
MOST = 64  # that may ask at the same moment
# An exit code can be read once. Starting a process reads those of all others that have ended, so that two
# threads would race for it, and the loser take a finished copy for a failed one.
_alone = threading.Lock()


@contextmanager
def serving() -> Iterator[dict[str, str]]:
    """What the environment of `steps` needs so that its stages run in copies, while this lasts.

    The process that is copied has the environment of this one, and ends with it; so do the copies.
    """
    code = code_of_stages()  # before it is loaded
    multiprocessing.get_context("forkserver").set_forkserver_preload(LOADED)
    with (
        tempfile.TemporaryDirectory() as folder,
        Listener(str(Path(folder) / "steps"), backlog=MOST) as door,
    ):
        guard = threading.Thread(target=_let_in, args=(door,), daemon=True)
        guard.start()
        try:
            yield {ADDRESS: str(door.address), CODE: code}
        finally:
            with suppress(OSError), Client(door.address) as last:  # the guard waits for somebody
                last.send(None)
            guard.join()
            for copy in multiprocessing.active_children():
                copy.terminate()


def _let_in(door: Listener) -> None:
    while True:
        line = door.accept()
        try:
            asked = line.recv()
        except (EOFError, OSError):  # it ended before it asked
            continue
        if asked is None:
            return
        threading.Thread(target=_answer, args=(line, asked), daemon=True).start()


def _answer(line: Connection, asked: tuple[Sequence[str], Path, set[int]]) -> None:
    with line:
        copy = multiprocessing.get_context("forkserver").Process(target=_as_asked, args=asked)
        with _alone:
            copy.start()
        wait([copy.sentinel])  # reads nothing
        with _alone:
            code = copy.exitcode
        with suppress(OSError):  # whoever asked has ended
            line.send(code)


def _as_asked(words: Sequence[str], folder: Path, usable: set[int]) -> None:
    """In the copy: where and on which cores the asking process would run them itself."""
    threading.Thread(
        target=_end_with, args=(multiprocessing.parent_process(),), daemon=True
    ).start()
    gc.freeze()  # what was loaded stays: nothing of it need be looked through
    os.chdir(folder)
    if usable:
        os.sched_setaffinity(0, usable)
    sys.exit(run_stages(words))


def _end_with(parent: BaseProcess | None) -> None:
    """A copy whose parent was killed would hold its row's lock against the next run."""
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
