"""Rays per second and PSNR over time: the fast field and the paper's NeRF, on one core and two.

    python -m benchmarks.field                     # about four minutes
    python -m benchmarks.field --width 100 --seconds 5 --paper-seconds 300 --paper-views 1

The scene is cast here: textured boxes, 24 views, exact poses, every eighth view held out. Times are
wall times of the fit alone, beside the processor's time per step; the machine should be idle.
"""

from __future__ import annotations

import argparse
import copy
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "field"))

from scene import camera, photograph  # type: ignore[import-not-found]  # noqa: E402

from pipeline.field.buffer import PosedPhoto, RayBuffer  # noqa: E402
from pipeline.field.fit import fit  # noqa: E402
from pipeline.field.grid_field import GridField  # noqa: E402
from pipeline.field.model import build, grid_sizes, half_is_fast, scene_space  # noqa: E402
from pipeline.field.paper_field import PaperField  # noqa: E402
from pipeline.field.render import render_view  # noqa: E402

VIEWS, SIZE, FOCAL, NEAR, FAR = 24, (400, 300), 380.0, 2.2, 25.0


class OutOfTime(Exception):
    """The time given to one row of the table is used up."""


class Row(NamedTuple):
    """One row of the table."""

    model: str
    threads: int
    steps: int
    seconds: float
    cpu_ms: float
    rays_per_second: float
    psnr: float
    render_seconds: float


def photos_and_field(
    model: str,
    settings: dict[str, Any],
    views: int = VIEWS,
    size: tuple[int, int] = SIZE,
    device: str = "cpu",
    half: bool | None = None,
) -> tuple[list[PosedPhoto], list[PosedPhoto], GridField | PaperField]:
    """Photos to fit, photos held out, and a fresh field with params.yaml's settings on ``device``.

    ``half``: products in bfloat16; None where that is faster.
    """
    focal = FOCAL * size[0] / SIZE[0]
    camera_numbers = (focal, focal, size[0] / 2, size[1] / 2, 0.0)
    photos = []
    for index in range(views):
        pose = camera(index, views)
        image, _ = photograph(pose, *size, focal)
        keep = np.ones(image.shape[:2], bool)
        photos.append(PosedPhoto(str(index), image, keep, pose, camera_numbers, NEAR, FAR))
    cams = np.stack([photo.cam_from_world for photo in photos])
    numbers, sizes = np.tile(camera_numbers, (views, 1)), np.tile(size, (views, 1))
    space = scene_space("ndc", cams, numbers, sizes, NEAR, FAR)
    config: dict[str, Any] = {}
    if model == "fast":
        same = ("samples", "levels", "features", "table_log2", "distortion", "decay")
        config = {k: settings[k] for k in same} | grid_sizes(space, settings["resolution"])
    config["half"] = half_is_fast(model, device) if half is None else half
    field = build(model, config, space, settings["seed"]).to(device)
    return [p for i, p in enumerate(photos) if i % 8], photos[::8], field


def measure(
    model_name: str,
    threads: int,
    seconds: float,
    steps: int,
    batch: int,
    held_out_views: int,
    size: tuple[int, int],
) -> Row:
    """Fit for ``seconds`` of wall time on a schedule of ``steps``, then render and compare."""
    settings = yaml.safe_load((ROOT / "params.yaml").read_text())["nerf"]
    train, test, model = photos_and_field(model_name, settings, size=size)
    buffer = RayBuffer(train, 0)
    # The first epoch is shuffled, and all is compiled, before the clock starts.
    fit(copy.deepcopy(model), buffer, steps=2, batch_rays=64, seed=0, threads=threads)
    buffer.batch(0, batch)
    begin, cpu, done = time.perf_counter(), time.process_time(), 0

    def progress(step: int, loss: float, psnr: float) -> None:
        nonlocal done
        done = step
        if time.perf_counter() - begin > seconds:
            raise OutOfTime

    try:
        every = 25 if model_name == "fast" else 1
        fit(model, buffer, steps=steps, batch_rays=batch, seed=0, threads=threads,
            log_every=every, progress=progress)  # fmt: skip
    except OutOfTime:
        pass
    wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
    torch.set_num_threads(threads)
    begin, errors = time.perf_counter(), []
    for photo in test[:held_out_views]:
        view = render_view(model, photo.cam_from_world, photo.intrinsics, size, NEAR, FAR)
        errors.append(-10 * np.log10(float(((view.rgb - photo.image) ** 2).mean())))
    each = (time.perf_counter() - begin) / max(1, len(errors))
    psnr = float(np.mean(errors)) if errors else float("nan")
    return Row(model_name, threads, done, wall, 1e3 * cpu / done, done * batch / wall, psnr, each)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[5.0, 10.0, 20.0, 40.0])
    parser.add_argument("--paper-seconds", type=float, default=30.0)
    parser.add_argument("--paper-views", type=int, default=0, help="held-out views it renders")
    parser.add_argument("--steps-per-second", type=float, default=20.0, help="of one thread")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--width", type=int, default=SIZE[0], help="of the photos, in pixels")
    flags = parser.parse_args()
    size = (flags.width, flags.width * 3 // 4)
    print(f"{'model':6} {'threads':>7} {'steps':>6} {'fit s':>7} {'cpu ms/step':>11} "
          f"{'rays/s':>9} {'PSNR dB':>8} {'s/view':>7}")  # fmt: skip
    jobs = [
        (
            "fast",
            threads,
            seconds,
            max(50, int(seconds * flags.steps_per_second * (1 if threads == 1 else 1.7))),
            4096,
            3,
            size,
        )
        for seconds in flags.seconds
        for threads in flags.threads
    ]
    jobs += [
        ("paper", threads, flags.paper_seconds, 200_000, 1024, flags.paper_views, size)
        for threads in flags.threads
    ]
    for job in jobs:
        row = measure(*job)
        psnr = f"{row.psnr:8.2f}" if np.isfinite(row.psnr) else "       -"
        print(f"{row.model:6} {row.threads:7d} {row.steps:6d} {row.seconds:7.1f} "
              f"{row.cpu_ms:11.1f} {row.rays_per_second:9,.0f} {psnr} "
              f"{row.render_seconds:7.2f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
