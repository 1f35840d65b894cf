"""Where an iteration's time goes, and what images and resolution cost in time and memory.

    python -m benchmarks.scaling            # about two minutes

All times are the processor's, on one thread, so that other work on the machine counts little.
Stages: each part of a step of the fast field timed by itself, beside the floor that
the machine sets for it: floating-point operations over the rate of a large matrix product measured
here, or bytes moved over the bandwidth of a large copy measured here, whichever takes longer.
Random reads of table rows count with whole cache lines; tables that fit a cache can beat this floor.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml

from benchmarks.field import FAR, NEAR, photos_and_field
from pipeline.field import fused
from pipeline.field.adam import Settings, advance, advance_and_clear, at_rest
from pipeline.field.buffer import RayBuffer
from pipeline.field.fit import fit
from pipeline.field.grid_field import GridField
from pipeline.field.render import render_view
from pipeline.field.sampling import stratified

ROOT = Path(__file__).resolve().parents[1]
LINE = 64


def best(work: Callable[[], Any], repeats: int = 7) -> float:
    """Processor seconds of the fastest of a few runs."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


def machine(kind: torch.dtype) -> tuple[float, float]:
    """Measured floating-point operations of this kind and bytes per second of one thread."""
    a = torch.randn(32768, 64).to(kind)
    b = torch.randn(64, 64).to(kind)
    flops = 2 * a.shape[0] * 64 * 64 / best(lambda: a @ b)
    big = torch.zeros(16_000_000)
    target = torch.empty_like(big)
    bandwidth = 2 * big.numel() * 4 / best(lambda: target.copy_(big))
    return flops, bandwidth


def stages(settings: dict[str, Any]) -> None:
    """Milliseconds of each part of one step, beside its floor."""
    train, _, model = photos_and_field("fast", settings, views=4)
    assert isinstance(model, GridField)
    half = model.config.half
    flops, bandwidth = machine(torch.bfloat16 if half else torch.float32)
    print(f"one thread: {flops / 1e9:.0f} GFLOP/s (32768x64 by 64x64, "
          f"{'bfloat16' if half else 'float32'}), {bandwidth / 1e9:.1f} GB/s (copy)")  # fmt: skip
    buffer = RayBuffer(train, 0)
    rays_per_step, samples = settings["batch_rays"], model.config.samples
    count, levels = rays_per_step * samples, model.config.levels
    rays = buffer.batch(0, rays_per_step).rays
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(3, count, generator=generator)
    grid, hidden = model.grid, model.config.hidden
    names, tables = [str(level) for level in range(levels)], list(grid.tables)
    totals = [torch.zeros_like(table) for table in tables]
    features = torch.randn(count, levels * model.config.features)
    gradient = torch.randn(count, levels * model.config.features)
    row_bytes = max(LINE, 4 * model.config.features)

    network = [model.shape_in.weight, model.shape_in.bias, model.shape_out.weight,
               model.shape_out.bias, model.shape_skip.weight]  # fmt: skip
    upstream = torch.randn(count, 16)

    def head() -> None:
        shape = fused.shape_network(leaf, half, *network)
        torch.autograd.grad(shape, [leaf, *network], upstream)

    proposed = torch.rand(rays_per_step, model.config.bins, generator=generator)

    def sample() -> None:
        u = stratified(rays_per_step, samples, None, rays.near)
        edges = fused.drawn_edges(proposed, u)
        fused.middles(fused.walk(model.space, *rays, edges))

    def guide() -> None:
        with torch.no_grad():
            model._propose(rays, model._bins(rays), None, None)

    walls = model._bins(rays)

    def teach() -> None:
        model._propose(rays, walls, model._noise(rays, generator), [])

    shaped = torch.randn(rays_per_step, samples, 16).requires_grad_()
    lengths = torch.rand(rays_per_step, samples)

    def along() -> None:
        weights, seen = fused.along_rays(shaped, lengths, 12.0)
        torch.autograd.grad((weights.sum(), seen.sum()), shaped)

    leaf = features.requires_grad_()
    table = sum(t.numel() for t in grid.tables)
    moments, pace = [at_rest(one) for one in tables], Settings(1e-3, (0.9, 0.99), 1e-15, 0.0)

    def step_alone() -> None:
        for total in totals:
            total.zero_()
        advance(list(zip(tables, totals, moments, strict=True)), pace)

    def step_and_clear() -> None:
        for one, total, known in zip(tables, totals, moments, strict=True):
            advance_and_clear(one, total, known, pace)

    def read() -> None:
        fused.grid_features(x, names, grid.resolutions, tables, None)

    def add() -> None:
        first = 0
        for resolution, total in zip(grid.resolutions, totals, strict=True):
            fused.CellGradient("", x, resolution, first, gradient).add_to(total)
            first += total.shape[1]

    bins = model.config.bins
    lookups = count * 8 * levels
    work = [
        ("batch of rays", lambda: buffer.batch(1, rays_per_step), 0, rays_per_step * 60),
        ("proposal, to sample by", guide, 0, rays_per_step * bins * (LINE + 16)),
        ("proposal, to teach", teach, 0, rays_per_step * bins * (LINE + 32)),
        ("samples along rays", sample, 0, count * 6 * 4),
        ("read rows", read, 0, lookups * row_bytes),
        ("add rows", add, 0, lookups * 2 * row_bytes),
        ("shape network, both ways", head,
         3 * 2 * count * (hidden * (levels * model.config.features + 16)
                          + levels * model.config.features * 16), 0),
        ("weights, features to rays", along, 0, count * 16 * 4 * 3),
        ("clear, torch's Adam", step_alone, 0, table * 4 * 8),
        ("Adam that clears, tables", step_and_clear, 0, table * 4 * 8),
    ]  # fmt: skip
    print(f"{'stage':26} {'ms':>7} {'floor ms':>9} {'times':>6}")
    for name, run, operations, moved in work:
        taken = best(run)
        floor = max(operations / flops, moved / bandwidth)
        print(f"{name:26} {1e3 * taken:7.2f} {1e3 * floor:9.2f} {taken / floor:6.1f}")


def cost(settings: dict[str, Any], views: int, width: int) -> None:
    """One row: milliseconds per step, seconds per view and peak memory of this process."""
    height = width * 3 // 4
    train, test, model = photos_and_field("fast", settings, views, (width, height))
    buffer = RayBuffer(train, 0)
    fit(model, buffer, steps=5, batch_rays=settings["batch_rays"], seed=0, threads=1)
    begin = time.process_time()
    fit(model, buffer, steps=30, batch_rays=settings["batch_rays"], seed=0, threads=1)
    step = (time.process_time() - begin) / 30
    photo, begin = test[0], time.process_time()
    size = (width, height)
    render_view(model, photo.cam_from_world, photo.intrinsics, size, NEAR, FAR)
    view = time.process_time() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{views:6d} {width:5d}x{height:<5d} {1e3 * step:8.1f} {view:7.2f} {peak:8.0f}", flush=True
    )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", action="store_true", help="the first table only")
    parser.add_argument("--row", type=int, nargs=2, metavar=("VIEWS", "WIDTH"), help="one row only")
    flags = parser.parse_args()
    settings = yaml.safe_load((ROOT / "params.yaml").read_text())["nerf"]
    torch.set_num_threads(1)
    if flags.row:
        cost(settings, *flags.row)
        return
    stages(settings)
    if flags.stages:
        return
    print(f"\n{'images':>6} {'size':11} {'ms/step':>8} {'s/view':>7} {'peak MB':>8}")
    for views, width in ((12, 400), (24, 400), (48, 400), (24, 200), (24, 800)):
        # A process of its own for every row: peak memory never falls within one.
        command = [sys.executable, "-m", "benchmarks.scaling", "--row", str(views), str(width)]
        subprocess.run(command, check=True, cwd=ROOT)


if __name__ == "__main__":
    main()
