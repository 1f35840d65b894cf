"""The runner that every stage shares: flags, parameters, logs, locks and exit codes."""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeVar

import filelock
from tqdm import tqdm

from pipeline.errors import UserError
from pipeline.io.atomic import disk_fault, disk_faults, place_fault
from pipeline.io.memory import memory_fault
from pipeline.io.paths import SHARED, ScenePaths
from pipeline.params import Section, read_folders, read_section

__all__ = ["Job", "Section", "run"]

USER_FAULT = 2
INTERRUPTED = 130
TERMINATED = 143
PATIENCE = 10.0  # seconds for a stage that was told to end
CHECKOUT = Path(__file__).resolve().parents[1]

P = TypeVar("P", bound=Section)
log = logging.getLogger("derainnerf")


@dataclass(frozen=True)
class Job:
    """One run of one stage: where it works and on what it computes.

    Nothing in here may change a result; what does lies in the stage's parameters.
    """

    root: Path
    scene: str
    variant: str | None
    device_wish: str
    scheduler: str | None
    verbose: bool
    folders: Mapping[str, str] = field(default_factory=dict)

    @property
    def paths(self) -> ScenePaths:
        return ScenePaths(self.root, self.scene, self.variant, self.folders)

    @cached_property
    def device(self) -> str:
        """ "cuda" or "cpu"; UserError when CUDA was asked for and there is none."""
        import torch  # late: half of the stages need no torch, and it takes seconds to load

        available = torch.cuda.is_available()
        if self.device_wish == "cuda" and not available:
            raise UserError("--device cuda: no usable CUDA device was found.", "Use --device auto.")
        device = "cuda" if available and self.device_wish != "cpu" else "cpu"
        log.info("computing on %s", device)
        return device

    def resolve(self, path: str) -> Path:
        """`path` from params.yaml: absolute, or relative to the folder of params.yaml."""
        try:
            return self.root / Path(path).expanduser()
        except RuntimeError:
            raise UserError(f"{path}: there is no such home folder.", "Write it out.") from None


class _AboveProgressBars(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        tqdm.write(self.format(record), file=sys.stderr)


def run(
    name: str,
    params_type: type[P],
    main: Callable[[Job, P], str | None],
    *,
    add_flags: Callable[[argparse.ArgumentParser], None] | None = None,
    before: Callable[[Path, argparse.Namespace], None] | None = None,
) -> NoReturn:
    """Runs stage `name` and leaves the process.

    Exit codes: 0 done; 2 a fault the user can mend, told in one sentence; 1 a bug, with its traceback;
    130 interrupted; 143 terminated. `main` returns the closing sentence, or None. `add_flags` and
    `before` (which gets the path of params.yaml) serve what comes before the parameters are read.
    """
    signal.signal(signal.SIGTERM, _terminate)
    _die_with_dvc()
    stage = _by_its_name(main)
    if stage is not None:
        params_type, main = stage.Params, stage.main
    try:
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.default_int_handler)  # `stages` left at once so far
        parser = _parser(name, sys.modules["__main__"].__doc__ or "")
        if add_flags is not None:
            add_flags(parser)
        flags = parser.parse_args(sys.argv[1:])
        params_file = _params_file(flags.params)
        if before is not None:
            _beforehand(before, params_file, flags)
        sys.exit(_run(name, params_type, main, params_file, flags))
    except UserError as error:
        print(f"{name}: {error.what}", file=sys.stderr)
        if error.hint:
            print(f"  {error.hint}", file=sys.stderr)
        sys.exit(USER_FAULT)
    except KeyboardInterrupt:
        print(f"{name}: interrupted; nothing half-written is left.", file=sys.stderr)
        sys.exit(INTERRUPTED)
    finally:
        _ask_again_after(0.0)  # not while Python itself ends, which no longer listens


def _by_its_name(main: Callable[..., Any]) -> Any:
    """The module that runs as `__main__`, imported by its own name; None when it runs by that.

    What a stage sends to a cluster is then found there by name: `__main__` is another one there.
    """
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    if main.__module__ != "__main__" or spec is None:
        return None
    return importlib.import_module(spec.name)


def _beforehand(
    before: Callable[[Path, argparse.Namespace], None], params_file: Path, flags: argparse.Namespace
) -> None:
    """Runs `before`; a folder that may not be read is a fault of the user's, as it is within a stage."""
    try:
        before(params_file, flags)
    except OSError as error:
        fault = place_fault(error, params_file.parent / "data" / flags.scene)
        if fault is None:
            raise
        raise fault from error


def _run(
    name: str,
    params_type: type[P],
    main: Callable[[Job, P], str | None],
    params_file: Path,
    flags: argparse.Namespace,
) -> int:
    params = read_section(params_file, name, params_type, flags.scene, flags.variant)
    folders = read_folders(params_file, flags.variant)
    makes = "images" if name == "ingest" else name
    if flags.variant is not None and makes in SHARED and makes not in folders:
        raise UserError(
            f"--variant {flags.variant} shares {makes}/ with its scene; it would be overwritten.",
            "Leave --variant away, or give the variant a folder of its own: "
            f"variants.{flags.variant}.folders.{makes}.",
        )
    job = Job(
        params_file.parent,
        flags.scene,
        flags.variant,
        flags.device,
        flags.scheduler,
        flags.verbose,
        folders,
    )
    work = job.paths.work(name)
    try:
        with disk_faults(work):
            work.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(work / "lock", timeout=0).acquire()
    except filelock.Timeout:
        raise UserError(
            f"stage {name} of scene {job.scene} is already running.",
            "Wait for it, or end it first.",
        ) from None
    with lock:
        with disk_faults(work):
            _log_to(work / "log.txt", job.verbose)
        closing = _logged(name, lambda: main(job, params), work)
    if closing:
        log.info("%s: %s", name, closing)
    return 0


def _logged(name: str, stage: Callable[[], str | None], work: Path) -> str | None:
    """What the stage returns; its traceback goes into the log too: the terminal may be gone later."""
    try:
        return stage()
    except Exception as error:
        log.error("stage %s failed", name, exc_info=True)
        known = isinstance(error, UserError)
        fault = None if known else _fault(error, work)
        if fault is None:
            raise
        raise fault from error


def _fault(error: Exception, work: Path) -> UserError | None:
    """What the user can mend behind `error`: the disk, a place, the memory."""
    return disk_fault(work) or place_fault(error, work.parents[1]) or memory_fault(error)


def _parser(name: str, about: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m stages.{name}",
        description=about,
        epilog=f"Parameters are the section `{name}` of params.yaml, with the scene's own values under "
        f"scenes.<scene>.{name}. Exit codes: 0 done, 2 a fault that you can mend, 1 a defect.",
    )
    parser.add_argument("--scene", required=True, help="a scene named in params.yaml")
    parser.add_argument("--variant", help="a variant named in params.yaml, e.g. unmasked")
    parser.add_argument(
        "--params", type=Path, help="params.yaml (default: the one here, else the checkout's)"
    )
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="where torch computes; auto (the default): on a GPU if there is one",
    )
    parser.add_argument(
        "--scheduler",
        default=os.environ.get("DERAINNERF_SCHEDULER") or None,
        help="address of a running Dask cluster, tcp://host:port (default: $DERAINNERF_SCHEDULER, else "
        "threads on this machine)",
    )
    parser.add_argument("--verbose", action="store_true", help="log details to the terminal too")
    return parser


def _params_file(wish: Path | None) -> Path:
    if wish is None:
        here = Path.cwd() / "params.yaml"
        wish = here if here.is_file() else CHECKOUT / "params.yaml"
    if not wish.is_file():
        raise UserError(f"{wish} does not exist.", "Name the file with --params.")
    return wish.resolve()


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """Nothing: a full disk is told once, by what needs it more."""


def _log_to(path: Path, verbose: bool) -> None:
    root = logging.getLogger()
    root.setLevel(logging.DEBUG if verbose else logging.INFO)
    for noisy in ("PIL", "distributed", "asyncio", "filelock", "matplotlib", "torch"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    file = _LogFile(path, mode="w", encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    terminal = _AboveProgressBars(logging.DEBUG if verbose else logging.INFO)
    terminal.setFormatter(logging.Formatter("%(message)s"))
    terminal.addFilter(lambda record: not record.exc_info)  # the runner tells it itself
    root.handlers = [file, terminal]


def _terminate(signum: int, frame: FrameType | None) -> NoReturn:
    """Leaves through `finally`, so that temporary folders are removed.

    Asks again while the process lives: what is raised within a callback from C, as while numba loads a
    kernel's machine code, is printed there and forgotten.
    """
    _ask_again_after(PATIENCE)
    sys.exit(TERMINATED)


def _ask_again_after(seconds: float) -> None:
    """Sets the clock for the next :func:`_terminate`, where there is one; 0: for none."""
    if hasattr(signal, "setitimer"):
        if seconds:
            signal.signal(signal.SIGALRM, _terminate)
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _die_with_dvc() -> None:
    """Under DVC, sees to it that this process ends with it, where there is /proc.

    A killed `dvc repro` would otherwise leave the stage running, writing into the next run's outputs.
    """
    if "DVC_STAGE" not in os.environ or not Path("/proc/self/environ").exists():
        return
    child = os.getpid()  # DVC's: this process, or the shell that it was started by
    parent = _parent(child)
    while _knows_its_stage(parent):
        child, parent = parent, _parent(parent)
    threading.Thread(target=_end_without, args=(child, parent), daemon=True).start()


def _end_without(child: int, parent: int) -> None:
    while True:
        time.sleep(0.1)
        try:
            alive = _parent(child) == parent
        except OSError:
            alive = False
        if not alive:
            os.kill(os.getpid(), signal.SIGTERM)
            return


def _parent(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def _knows_its_stage(process: int) -> bool:
    try:
        return b"DVC_STAGE=" in Path(f"/proc/{process}/environ").read_bytes()
    except OSError:
        return False
