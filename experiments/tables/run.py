"""The comparison of methods: what is missing of a profile is computed, then the tables are written.

    python -m experiments.tables.run quick        # or tiny, full

The stages are those of every scene's dvc.yaml in the profile's folder. Here they run in an order of their own,
cheap rows and the first seed of everything first, with one process per core, each on one core. Stopped, it goes
on where it was. Now and then the tables are written from what there is; what is missing is said in them.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.command import sentences
from experiments.tables.warm import serving
from pipeline.parallel import cores
from pipeline.params import read_params

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
Process = subprocess.Popen[bytes]
PROFILES = ("tiny", "quick", "full")


class Share(NamedTuple):
    """Targets of a scene that are made one after the other on one core: its part of ``what``.

    Every part of ``needs`` that the scene has must be made before.
    """

    what: str
    scene: str
    targets: list[str]
    needs: tuple[str, ...] = ()


class Target(NamedTuple):
    """A stage as DVC names it, "street/dvc.yaml:fit@nerf-0": the scene's, of a stage, of a row and seed."""

    name: str
    scene: str
    stage: str
    seed: str


PHOTOS, REMOVERS = "photos, masks, poses", "removers"
SEEDED = ("fit", "loop", "cleaned")  # stages that are made once per seed


class _Kind(NamedTuple):
    what: str
    stages: tuple[str, ...]
    seed: str = ""
    needs: tuple[str, ...] = (PHOTOS,)


def _target(name: str) -> Target:
    folder, _, rest = name.partition("/dvc.yaml:")
    stage, _, row = rest.partition("@")
    return Target(name, folder, stage, row.rpartition("-")[2] if stage in SEEDED else "")


def _kinds(seeds: Sequence[str]) -> list[_Kind]:
    """What there is to do, the first seed of everything first."""
    fits = [_Kind(f"fits, seed {seed}", ("fit", "loop"), seed) for seed in seeds]
    cleaned = [
        _Kind(f"fits to cleaned photos, seed {seed}", ("cleaned",), seed, (PHOTOS, REMOVERS))
        for seed in seeds
    ]
    once = _Kind(PHOTOS, ("prepare",), needs=()), _Kind(REMOVERS, ("restore",))
    return [once[0], *fits[:1], once[1], *cleaned[:1], *fits[1:], *cleaned[1:]]


def shares(names: Sequence[str]) -> list[Share]:
    """All targets but the table, in the order in which they should be made."""
    targets = [_target(name) for name in names if "/" in name]
    scenes = sorted({target.scene for target in targets})
    seeds = sorted({target.seed for target in targets} - {""})
    made = []
    for what, stages, seed, needs in _kinds(seeds):
        for scene in scenes:
            chosen = [
                target.name
                for stage in stages
                for target in targets
                if (target.scene, target.stage, target.seed) == (scene, stage, seed)
            ]
            if chosen:
                made.append(Share(what, scene, chosen, needs))
    return made


def _environment() -> dict[str, str]:
    one = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    path = os.pathsep.join(filter(None, (str(Path(sys.executable).parent), os.environ.get("PATH"))))
    # Two progress bars in one terminal are none.
    return one | {"PATH": path, "PYTHONPATH": str(ROOT), "TQDM_DISABLE": "1"}


def _dvc(*words: str) -> list[str]:
    return [sys.executable, "-m", "dvc", *words]


def _next(waiting: list[Share], running: Iterable[Share], cores: int) -> Share | None:
    """Takes the first share that has what it needs out of those waiting.

    When few are left, half of it: at the end no core shall wait for another's long share.
    """
    ahead = {(share.scene, share.what) for share in (*waiting, *running)}
    for place, share in enumerate(waiting):
        if any((share.scene, need) in ahead for need in share.needs):
            continue
        if len(waiting) > 2 * cores or len(share.targets) == 1:
            return waiting.pop(place)
        half = (len(share.targets) + 1) // 2
        waiting[place] = share._replace(targets=share.targets[half:])
        return share._replace(targets=share.targets[:half])
    return None


def _start(folder: Path, share: Share, core: int, environment: dict[str, str]) -> Process:
    """DVC making a share on one core. It tells failures itself, and goes on with the rest."""
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []

    def pinned() -> None:
        if usable:
            os.sched_setaffinity(0, {usable[core % len(usable)]})

    # Two share one repository, whose lock is held while a result is written down. What a target needs was
    # made in a share before; to check it again DVC would lock it against the other worker.
    command = _dvc("--wait-for-lock", "repro", "--single-item", "--keep-going", "--quiet")
    return subprocess.Popen(command + share.targets, cwd=folder, env=environment, preexec_fn=pinned)


def _make(folder: Path, waiting: list[Share], table: Callable[[str, bool], None]) -> bool:
    """Makes the shares, one per core at a time; whether all were made.

    ``table`` is called with every kind of share when its last one is there, and whether more are to come.
    """
    waiting, running, made = list(waiting), dict[int, tuple[Share, Process]](), True
    left = Counter(share.what for share in waiting for _ in share.targets)
    with serving() as warm:
        environment = {**os.environ, **warm}
        try:
            while waiting or running:
                for core in set(range(cores())) - running.keys():
                    share = _next(waiting, [one for one, _ in running.values()], cores())
                    if share is not None:
                        running[core] = share, _start(folder, share, core, environment)
                time.sleep(0.2)
                for core, (share, process) in list(running.items()):
                    if process.poll() is not None:
                        made &= process.returncode == 0
                        del running[core]
                        left[share.what] -= len(share.targets)
                        if not left[share.what]:
                            table(share.what, bool(waiting or running))
        finally:
            for _, process in running.values():
                process.terminate()
    return made


def main() -> int:
    """Makes every row; 1 when anything could not be made, be it a row that the tables then miss, 2 when the
    parameters are at fault.
    """
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("profile", choices=PROFILES)
    folder = HERE / parser.parse_args().profile
    with sentences():
        read_params(folder / "params.yaml")
    command = _dvc("stage", "list", "--all", "--name-only")
    listed = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    if listed.returncode:
        return 1  # DVC has said why
    work = shares(listed.stdout.split())
    rendered = [f"scene@{scene}" for scene in sorted({share.scene for share in work})]
    scenes = subprocess.run(_dvc("repro", "--quiet", *rendered), cwd=HERE.parent / "scenes")
    if scenes.returncode:
        return 1
    os.environ.update(_environment())  # of all that follows, copies too
    start, tables = time.monotonic(), list[Process]()

    def table(what: str, more: bool) -> None:
        print(f"[{(time.monotonic() - start) / 60:5.1f} min] made: {what}", flush=True)
        # Beside the rows, which do not wait for it; before the first and after the last there is no need.
        busy = any(earlier.poll() is None for earlier in tables)
        if what != PHOTOS and more and not busy:
            command = [sys.executable, "-m", "stages.table", "--scene", "all"]
            tables[:] = [subprocess.Popen(command, cwd=folder)]

    made = _make(folder, work, table)
    for last in tables:
        last.wait()
    done = subprocess.run(_dvc("repro", "--quiet", "--single-item", "table"), cwd=folder)
    print(f"[{(time.monotonic() - start) / 60:5.1f} min] {folder / 'tables' / 'tables.md'}")
    return 0 if made and done.returncode == 0 else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("Stopped. What is finished stays; the same command goes on from there.")
