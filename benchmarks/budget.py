"""What a fit of so many seconds reaches on a scene of known truth: rays per second, held-out PSNR, oracle gap.

    python -m benchmarks.budget experiments/scenes/data/diorama                       # about five minutes
    python -m benchmarks.budget experiments/scenes/data/diorama-move --rows clean,true --set levels=4

Scenes and rows are those of `benchmarks.quality`. Each fit is a whole one: forty steps are timed first, and
its schedule is made as long as the seconds allow; they are wall time on an otherwise idle machine. Every
view that is held out is then rendered, on all threads.
"""

from __future__ import annotations

import argparse
import copy
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.flags import rows_of, settings_of
from benchmarks.quality import (
    FIELD,
    ROOT,
    ROWS,
    USED,
    Scene,
    fit_with,
    load,
    photos_of,
    psnr,
    seen_pixels,
)
from pipeline.field.buffer import RayBuffer
from pipeline.field.model import build_around
from pipeline.field.render import RenderedView, render_view

PILOT = 40


class Budget(NamedTuple):
    """One fit: its steps, what they took, held-out PSNR (whole image, seen pixels), seconds per view."""

    steps: int
    seconds: float
    psnr: float
    seen: float
    view_seconds: float


def measure(
    scene: Scene,
    row: str,
    seconds: float,
    threads: int,
    settings: dict[str, Any],
    seen: dict[str, np.ndarray],
    steps: int = 0,
) -> Budget:
    """Fits one row's photos for about ``seconds``, or for ``steps``, and compares the held-out views.

    ``seen`` masks by stem, may be empty.
    """
    photos, held_out, near, far = photos_of(scene, row, settings)
    views = scene.views[ROWS[row][2]]
    config = {key: settings[key] for key in FIELD}
    model = build_around("fast", list(views.values()), near, far, **config)
    buffer = RayBuffer(photos, settings["seed"])

    def timed(model: Any, steps: int) -> float:
        begin = time.perf_counter()
        fit_with(settings, model, buffer, steps, threads)
        return time.perf_counter() - begin

    timed(copy.deepcopy(model), 2)  # compiles, or reads what was compiled
    steps = steps or max(PILOT, int(seconds / timed(copy.deepcopy(model), PILOT) * PILOT))
    taken = timed(model, steps)

    def render(stem: str) -> RenderedView:
        view = views[stem]
        size = (view.width, view.height)
        return render_view(model, view.cam_from_world, view.intrinsics, size, near, far)

    torch.set_num_threads(1)
    begin = time.perf_counter()
    stems = held_out + held_out[: -len(held_out) % threads]  # so that no thread stands idle
    with ThreadPoolExecutor(threads) as pool:
        renders = dict(zip(stems, pool.map(render, stems), strict=True))
    each = (time.perf_counter() - begin) / len(stems)
    errors = {stem: (renders[stem].rgb - scene.clean[stem]) ** 2 for stem in held_out}
    inside = [psnr(errors[stem][seen[stem]]) for stem in held_out] if seen else [np.nan]
    whole = np.mean([psnr(error) for error in errors.values()])
    return Budget(steps, taken, float(whole), float(np.mean(inside)), each)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "scenes", type=Path, nargs="+", help="folders like experiments/scenes/data/street"
    )
    parser.add_argument("--seconds", type=float, nargs="+", default=[60.0, 180.0])
    parser.add_argument("--rows", default="clean")
    parser.add_argument("--threads", type=int, nargs="+", default=[2])
    parser.add_argument("--set", nargs="*", default=[], help="parameters of params.yaml, key=value")
    flags = parser.parse_args()
    settings, rows = settings_of(parser, flags.set, USED), rows_of(parser, flags.rows, ROWS)
    print(f"{'scene':14} {'row':12} {'threads':>7} {'steps':>6} {'fit s':>7} {'rays/s':>9} "
          f"{'PSNR':>6} {'gap':>6} {'seen':>6} {'gap':>6} {'s/view':>7}", flush=True)  # fmt: skip
    for folder in flags.scenes:
        scene = load(folder, ROOT / "artifacts" / folder.name)
        seen = seen_pixels(scene, {}) if scene.depth else {}
        for threads in flags.threads:
            for seconds in flags.seconds:
                clean, steps = (np.nan, np.nan), 0
                for row in rows:
                    out = measure(scene, row, seconds, threads, settings, seen, steps)
                    steps = out.steps  # of the rows after it too: the gap is the drops'
                    clean = (out.psnr, out.seen) if row == "clean" else clean
                    rate = out.steps * settings["batch_rays"] / out.seconds
                    print(f"{folder.name:14} {row:12} {threads:7d} {out.steps:6d} "
                          f"{out.seconds:7.1f} {rate:9,.0f} {out.psnr:6.2f} {clean[0] - out.psnr:6.2f} "
                          f"{out.seen:6.2f} {clean[1] - out.seen:6.2f} {out.view_seconds:7.2f}",
                          flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
