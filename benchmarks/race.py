"""What the paper's NeRF reaches in an hour of processor time, and how soon the fast field holds it.

    nice -n 19 python -m benchmarks.race                # an hour of one core; two threads
    python -m benchmarks.race --paper-seconds 600 --marks 4

The scene of `benchmarks.field` (textured boxes, 24 views, exact poses) at 100x75 pixels; one held-out
view, rendered now and then by both. Time is the processor's, over all threads, for the fit alone: it
can run beside other work, be stopped and go on. An hour of one core is 3,600 of these seconds, an hour
of two is 7,200. Every line stands by itself: what is cut off has said something already.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml

from benchmarks.field import FAR, NEAR, ROOT, OutOfTime, photos_and_field
from pipeline.field.buffer import RayBuffer
from pipeline.field.fit import fit
from pipeline.field.render import render_view

FAST_STEPS, FAST_EVERY = 300, 5


class Row(NamedTuple):
    """The held-out view's PSNR in dB after so many steps and processor seconds."""

    steps: int
    seconds: float
    psnr: float


def course(
    model: Any, photo: Any, due: Callable[[float], bool], told: Callable[[Row], None]
) -> Any:
    """What `fit` calls with each step: a look at ``photo`` where it is ``due``, left out of the time."""
    begin, looking = time.process_time(), 0.0

    def progress(step: int, loss: float, psnr: float) -> None:
        nonlocal looking
        now = time.process_time()
        if due(now - begin - looking):
            row = Row(step, now - begin - looking, held_out(model, photo))
            looking += time.process_time() - now
            told(row)

    return progress


def held_out(model: Any, photo: Any) -> float:
    """PSNR of one view in dB."""
    height, width = photo.image.shape[:2]
    pose, camera = photo.cam_from_world, photo.intrinsics
    view = render_view(model, pose, camera, (width, height), NEAR, FAR, chunk=256)
    return float(-10 * np.log10(((view.rgb - photo.image) ** 2).mean()))


def fast_course(settings: dict[str, Any], size: tuple[int, int]) -> list[Row]:
    """The fast field every few steps of a short schedule."""
    train, test, model = photos_and_field("fast", settings, size=size)
    warm = photos_and_field("fast", settings, size=size)[2]
    buffer, batch = RayBuffer(train, 0), settings["batch_rays"]
    fit(warm, buffer, steps=3, batch_rays=batch, seed=0, threads=2)  # compiles
    held_out(warm, test[0])
    rows: list[Row] = []
    look = course(model, test[0], lambda seconds: True, rows.append)
    fit(model, buffer, steps=FAST_STEPS, batch_rays=batch, seed=0, threads=2,
        log_every=FAST_EVERY, progress=look)  # fmt: skip
    return rows


def paper_course(
    settings: dict[str, Any], size: tuple[int, int], marks: list[float], told: Callable[[Row], None]
) -> None:
    """The paper's NeRF, looked at whenever one of ``marks``, processor seconds, is passed."""
    train, test, model = photos_and_field("paper", settings, size=size)

    def due(seconds: float) -> bool:
        passed = marks[0] <= seconds
        marks[:] = [mark for mark in marks if mark > seconds]
        return passed

    def tell(row: Row) -> None:
        told(row)
        if not marks:
            raise OutOfTime

    look = course(model, test[0], due, tell)
    with contextlib.suppress(OutOfTime):
        # Eight shards: less memory than two, and faster. The batch is the paper's.
        fit(model, RayBuffer(train, 0), steps=settings["paper_steps"],
            batch_rays=settings["paper_batch_rays"], seed=0, shards=8, threads=2, log_every=1,
            progress=look)  # fmt: skip


def main() -> None:
    """Print the paper's course, and beside each line when the fast field held the same PSNR."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--paper-seconds", type=float, default=3600.0, help="of the processor")
    parser.add_argument("--marks", type=int, default=12, help="looks at the held-out view")
    parser.add_argument("--width", type=int, default=100, help="of the photos, in pixels")
    flags = parser.parse_args()
    size = (flags.width, flags.width * 3 // 4)
    settings = yaml.safe_load((ROOT / "params.yaml").read_text())["nerf"]
    torch.set_num_threads(1)
    fast = fast_course(settings, size)
    for row in fast[:: len(fast) // 6]:
        print(f"fast  {row.steps:6d} steps {row.seconds:8.1f} cpu s {row.psnr:6.2f} dB", flush=True)

    def tell(row: Row) -> None:
        first = next((other for other in fast if other.psnr >= row.psnr), None)
        same = f"{first.steps} steps, {first.seconds:.1f} cpu s" if first else "never"
        rays = row.steps * settings["paper_batch_rays"] / row.seconds
        print(f"paper {row.steps:6d} steps {row.seconds:8.1f} cpu s {row.psnr:6.2f} dB; "
              f"{rays:.0f} rays/s; fast field: {same}", flush=True)  # fmt: skip

    marks = [flags.paper_seconds * (n + 1) / flags.marks for n in range(flags.marks)]
    paper_course(settings, size, [flags.paper_seconds / 100, *marks], tell)


if __name__ == "__main__":
    main()
