"""The field on a GPU: time per step, per view and per fit, and what the paper's NeRF reaches there.

    python -m benchmarks.gpu data/demo              # about a minute; after `make demo`
    python -m benchmarks.gpu --parts steps,views    # no scene is needed
    python -m benchmarks.gpu data/demo --device cpu --tiny   # whether it runs at all

Steps, views and the paper's NeRF are measured on the textured boxes of `benchmarks.field`, fits on scenes as
`benchmarks.quality` takes them: every eighth view held out. Steps are recorded unless the line says that they
are not. Times are wall times with the GPU waited for; settings are those of params.yaml.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from benchmarks.field import ROOT, SIZE, OutOfTime, photos_and_field
from benchmarks.quality import load, measure, shrunk
from pipeline.field.buffer import PosedPhoto, RayBuffer
from pipeline.field.cuda_steps import CudaSteps
from pipeline.field.fit import fit
from pipeline.field.render import render_view, scaled_camera
from pipeline.field.steppers import steppers_of

SMALL = (100, 75)  # pixels of the race between the two fields, as in `benchmarks.race`
HOURS = (470, 940)  # steps of the paper's NeRF in an hour of one CPU core, and of two
TINY = {"levels": 2, "table_log2": 10, "samples": 6, "resolution": 48, "batch_rays": 64,
        "paper_batch_rays": 8, "steps": 12}  # fmt: skip


def steps_part(flags: argparse.Namespace, settings: dict[str, Any]) -> Iterator[str]:
    """Milliseconds of a step of the fast field, in batches of several sizes."""
    size = SMALL if flags.tiny else SIZE
    photos, _, _ = photos_and_field("fast", settings, size=size)
    buffer = RayBuffer(photos, 0, flags.device)
    ways = [(1, False, False), (1, True, False), (1, True, True), (4, True, False),
            (4, True, True), (16, True, False), (16, True, True)]  # fmt: skip
    for times, record, half in ways:
        yield step_line("fast", settings, buffer, times * settings["batch_rays"], record, half)


def step_line(
    model: str, settings: dict[str, Any], buffer: RayBuffer, rays: int, record: bool, half: bool
) -> str:
    """Model, precision, rays of a step, milliseconds, rays per second, memory."""
    device = str(buffer.device)
    _, _, field = photos_and_field(model, settings, size=SMALL, device=device, half=half)
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
    ms = step_ms(field, buffer, rays, record)
    memory = torch.cuda.max_memory_allocated() / 2**30 if device != "cpu" else float("nan")
    kind = ("bfloat16" if half else "float32") + ("" if record else ", not recorded")
    return (f"{model:5} {kind:22} {rays:6d} rays {ms:8.2f} ms/step "
            f"{1e3 * rays / ms:11,.0f} rays/s {memory:5.1f} GB")  # fmt: skip


def step_ms(field: Any, buffer: RayBuffer, rays: int, record: bool, count: int = 60) -> float:
    """Milliseconds of each of ``count`` steps, every kind of which was taken before."""
    take = CudaSteps(field, None, steppers_of(field, 10_000, 1.0), buffer, rays, 0, record)
    before, count = (2, 2) if buffer.device == "cpu" else (12, count)
    for step in range(200, 200 + before):
        take(step)
    begin = waited(buffer.device)
    for step in range(212, 212 + count):
        losses = take(step)
    took = waited(buffer.device) - begin
    if not torch.isfinite(losses).all():
        raise ValueError(f"the loss is {losses.tolist()}")
    return 1e3 * took / count


def views_part(flags: argparse.Namespace, settings: dict[str, Any]) -> Iterator[str]:
    """Milliseconds of a view of the fast field."""
    _, photos, field = photos_and_field("fast", settings, size=SMALL, device=flags.device)
    for scale in (0.2, 0.4) if flags.tiny else (4.0, 8.0):
        view(field, photos[0], flags.device, scale)
        begin, count = waited(flags.device), 5
        for _ in range(count):
            width, height = view(field, photos[0], flags.device, scale).shape[1::-1]
        yield f"view {width}x{height} {1e3 * (waited(flags.device) - begin) / count:8.1f} ms"


def fits_part(flags: argparse.Namespace, settings: dict[str, Any]) -> Iterator[str]:
    """Seconds and held-out PSNR of whole fits: clean photos, and wet ones behind true masks."""
    for folder in flags.scenes:
        scene = shrunk(load(folder, flags.artifacts / folder.name), 4 if flags.tiny else 1)
        for row in ("clean", "true"):
            result = measure(scene, row, settings, 2, {}, flags.device)
            yield (f"fit {folder.name:13} {row:5} {settings['steps']} steps "
                   f"{result.seconds:6.2f} s {result.psnr:6.2f} dB")  # fmt: skip


def paper_part(flags: argparse.Namespace, settings: dict[str, Any]) -> Iterator[str]:
    """The paper's NeRF where an hour of one core and of two would have stopped; the fast field beside it."""
    photos, _, _ = photos_and_field("paper", settings, size=SMALL)
    buffer, rays = RayBuffer(photos, 0, flags.device), settings["paper_batch_rays"]
    for record, half in ((False, True), (True, False), (True, True)):
        half = half and flags.device != "cpu"
        yield step_line("paper", settings, buffer, rays, record, half)
    marks = (1, 2) if flags.tiny else HOURS
    yield from course("paper", settings, flags.device, settings["paper_steps"], rays, marks)
    for steps in (6, 12) if flags.tiny else (60, 300):
        rays = settings["batch_rays"]
        yield from course("fast", settings, flags.device, steps, rays, (steps,))


def course(
    model: str, settings: dict[str, Any], device: str, steps: int, rays: int, marks: tuple[int, ...]
) -> list[str]:
    """The held-out view's PSNR after ``marks`` steps of a schedule of ``steps``, and the seconds until then."""
    photos, test, field = photos_and_field(model, settings, size=SMALL, device=device)
    buffer, told, looking, begin = RayBuffer(photos, 0, device), [], 0.0, waited(device)

    def look(step: int, loss: float, psnr: float) -> None:
        nonlocal looking
        if step not in marks:
            return
        now = waited(device)
        error = view(field, test[0], device) - test[0].image
        told.append(f"{model:5} on the boxes: {step} steps, {now - begin - looking:.2f} s, "
                    f"{-10 * np.log10((error**2).mean()):.2f} dB held out")  # fmt: skip
        looking += waited(device) - now
        if step == marks[-1]:
            raise OutOfTime

    with contextlib.suppress(OutOfTime):
        every = int(np.gcd.reduce(marks))
        fit(field, buffer, steps=steps, batch_rays=rays, seed=0, log_every=every, progress=look)
    return told


def view(field: Any, photo: PosedPhoto, device: str, scale: float = 1.0) -> np.ndarray:
    """The photo's view with ``scale`` times the pixels."""
    height, width = photo.image.shape[:2]
    camera, size = scaled_camera(photo.intrinsics, (width, height), scale)
    pose, bounds = photo.cam_from_world, (photo.near, photo.far)
    return render_view(field, pose, camera, size, *bounds, device=device).rgb


def waited(device: Any) -> float:
    """The time, once the GPU has nothing left to do."""
    if str(device) != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter()


PARTS: dict[str, Callable[[argparse.Namespace, dict[str, Any]], Iterator[str]]] = {
    "steps": steps_part,
    "views": views_part,
    "fits": fits_part,
    "paper": paper_part,
}


def main() -> None:
    """Print the parts' lines as they come."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path, nargs="*", help="folders like data/demo")
    parser.add_argument("--artifacts", type=Path, default=ROOT / "artifacts")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--parts", default=",".join(PARTS), help="some of " + ",".join(PARTS))
    parser.add_argument("--tiny", action="store_true", help="sizes that only show that it runs")
    flags = parser.parse_args()
    settings = yaml.safe_load((ROOT / "params.yaml").read_text())["nerf"]
    if flags.tiny:
        settings |= TINY
        torch.set_num_threads(1)
    if flags.device != "cpu":
        print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}", flush=True)
    for name in flags.parts.split(","):
        for line in PARTS[name](flags, settings):
            print(line, flush=True)


if __name__ == "__main__":
    main()
