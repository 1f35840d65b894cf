"""The comparison of methods: what is missing of a profile is computed, then the tables are written.

    python -m experiments.tables.run quick        # or tiny, full

The stages are those of dvc.yaml in the profile's folder. Here they run in an order of their own, cheap rows
and the first seed of everything first, with one process per core, each on one core. Stopped, it goes on
where it was. After every phase the tables are written from what there is; what is missing is said in them.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from pipeline.parallel import cores

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PROFILES = ("tiny", "quick", "full")


def phases(targets: Sequence[str]) -> list[tuple[str, list[str]]]:
    """The targets of dvc.yaml in the order in which they should be made, as (what, targets)."""
    seeds = sorted({name.rsplit("-", 1)[1] for name in targets if name.startswith("fit@")})

    def of(kinds: tuple[str, ...], end: str = "") -> list[str]:
        return [
            t for kind in kinds for t in targets if t.startswith(f"{kind}@") and t.endswith(end)
        ]

    restore = of(("restore",))
    restore.sort(key=lambda name: name.endswith("-wen"))  # the dearest last
    kinds = ("fit", "unaveraged", "loop")
    fits = [(f"fits, seed {seed}", of(kinds, f"-{seed}")) for seed in seeds]
    cleaned = [
        (f"fits to cleaned photos, seed {seed}", of(("cleaned",), f"-{seed}")) for seed in seeds
    ]
    steps = [("photos, masks, poses", of(("prepare",))), *fits[:1], ("removers", restore)]
    steps += [*cleaned[:1], *fits[1:], *cleaned[1:]]
    return [step for step in steps if step[1]]


def _environment() -> dict[str, str]:
    one = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    path = os.pathsep.join(filter(None, (str(Path(sys.executable).parent), os.environ.get("PATH"))))
    # Two progress bars in one terminal are none.
    return {**os.environ, **one, "PATH": path, "PYTHONPATH": str(ROOT), "TQDM_DISABLE": "1"}


def _dvc(*words: str) -> list[str]:
    return [sys.executable, "-m", "dvc", *words]


def _repro(folder: Path, targets: Sequence[str]) -> bool:
    """Makes the targets, on one core each at a time; whether all were made.

    Failures are told by DVC and do not stop the rest.
    """
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    running = []
    for worker in range(min(cores(), len(targets))):
        # They share one repository, whose lock is held while a result is written down. What a target
        # needs was made in an earlier phase; to check it again DVC would lock it against the other worker.
        command = _dvc("--wait-for-lock", "repro", "--single-item", "--keep-going", "--quiet")
        command += targets[worker :: cores()]

        def pinned(core: int = worker) -> None:
            if usable:
                os.sched_setaffinity(0, {usable[core % len(usable)]})

        running.append(subprocess.Popen(command, cwd=folder, env=_environment(), preexec_fn=pinned))
    try:
        return not any([process.wait() for process in running])
    finally:
        for process in running:
            process.terminate()


def main() -> int:
    """Runs the phases; 1 when anything could not be made, be it a row that the tables then miss."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("profile", choices=PROFILES)
    folder = HERE / parser.parse_args().profile
    listed = subprocess.run(
        _dvc("stage", "list", "--name-only"), cwd=folder, capture_output=True, text=True, check=True
    )
    start = time.monotonic()
    table = [sys.executable, "-m", "stages.table", "--scene", "all"]
    scenes = sorted({name.split("@")[1] for name in listed.stdout.split() if "prepare@" in name})
    rendered = [f"scene@{scene}" for scene in scenes]
    subprocess.run(_dvc("repro", "--quiet", *rendered), cwd=HERE.parent / "scenes", check=True)
    made = True
    for what, targets in phases(listed.stdout.split()):
        print(f"[{(time.monotonic() - start) / 60:5.1f} min] {what}: {len(targets)}", flush=True)
        made &= _repro(folder, targets)
        subprocess.run(table, cwd=folder, env=_environment(), check=False)
    done = subprocess.run(
        _dvc("repro", "--quiet", "--single-item", "table"), cwd=folder, env=_environment()
    )
    print(f"[{(time.monotonic() - start) / 60:5.1f} min] {folder / 'tables' / 'tables.md'}")
    return 0 if made and done.returncode == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
