"""The fit: rays of kept pixels in, parameters stepped; the same bytes for the same seed on a CPU.

A batch is cut into a fixed number of shards that run in threads, each on one core; then every
table's gradient is added up and stepped in a thread of its own. Nothing depends on how many
threads there are, only the time does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from torch import Tensor, nn

from pipeline.errors import UserError
from pipeline.field.base import Rays
from pipeline.field.buffer import Batch, RayBuffer
from pipeline.field.cuda_steps import CudaSteps
from pipeline.field.steppers import (
    Average,
    Exposure,
    Found,
    Stepper,
    found_in,
    named_in,
    steppers_of,
    totals,
)
from pipeline.io.memory import keep_memory, refuse_without_room

T = TypeVar("T")

Progress = Callable[[int, float, float], None]
Save = Callable[[int, dict[str, Tensor]], None]
Take = Callable[[int], Tensor]  # a step's number in, (loss, photometric loss) out


@dataclass
class Record:
    """The course of a fit: step, loss and training PSNR in dB, averaged since the row before."""

    rows: list[tuple[int, float, float]] = field(default_factory=list)
    gains: Tensor | None = None


def fit(
    model: nn.Module,
    buffer: RayBuffer,
    *,
    steps: int,
    batch_rays: int,
    seed: int,
    rate: float = 1.0,
    exposure: bool = False,
    average: float = 0.0,
    shards: int = 2,
    threads: int = 2,
    log_every: int = 50,
    save_every: int = 0,
    save: Save | None = None,
    resume: tuple[int, dict[str, Tensor]] | None = None,
    progress: Progress | None = None,
    record: bool = True,
) -> Record:
    """Fit ``model`` (a :class:`Field`) in place; the course of it comes out.

    ``shards`` pieces of each batch run side by side on up to ``threads`` cores: the shards decide
    the bytes, the threads do not. ``rate`` multiplies every learning rate. With
    ``exposure`` each photo has a brightness of its own (``gains`` of the record, ``(V, 3)``).
    ``average`` is the share of the steps, the last ones, over which the parameters' mean is taken
    for the field that comes out (0: as the last step left it).
    ``save(step, state)`` is called every ``save_every`` steps;
    ``resume`` takes such a pair and goes on, on a CPU to the same bytes. ``progress(step, loss, psnr)``.
    On a GPU shards and threads mean nothing, and steps are recorded unless ``record`` is False
    (:class:`pipeline.field.cuda_steps.CudaSteps`).
    Raises UserError when the loss is not finite.
    """
    light = Exposure(buffer.photos).to(buffer.device) if exposure else None
    learned = [model] if light is None else [model, light]
    steppers = [stepper for module in learned for stepper in steppers_of(module, steps, rate)]
    # The largest first: two threads then finish at about the same time.
    steppers.sort(key=lambda stepper: -sum(one.numel() for one in stepper.parameters))
    course, mean = Record(), Average(learned, steps, average)
    running: list[Tensor] = []
    first = 0
    if resume is not None:
        first = _restore(learned, steppers, mean, course, resume)
        running = list(resume[1]["running"])
    with _pool(threads if buffer.device == "cpu" else 1) as pool:
        if buffer.device != "cpu":
            take: Take = CudaSteps(model, light, steppers, buffer, batch_rays, seed, record)
        else:
            take = _on_cpu(model, light, steppers, buffer, batch_rays, seed, shards, pool)
        for step in range(first, steps):
            running.append(take(step))
            done = step + 1
            mean.add(done)
            if done % log_every == 0 or done == steps:
                course.rows.append(_row(done, running))
                running.clear()
                if progress is not None:
                    progress(*course.rows[-1])
            if save is not None and save_every and done % save_every == 0 and done < steps:
                save(done, _state(learned, steppers, mean, course, running))
    mean.finish()
    if light is not None:
        course.gains = light.gains().detach().cpu()
    return course


def refuse_large(model: nn.Module, device: str) -> None:
    """UserError when the memory that is free cannot hold what a fit keeps beside ``model``'s parameters.

    Gradients, Adam's two moments and the mean, each as large. A GPU tells by itself.
    """
    held = sum(parameter.numel() * parameter.element_size() for parameter in model.parameters())
    if device == "cpu":
        refuse_without_room(
            4 * held,
            "the field's tables",
            "Lower nerf.table_log2, nerf.levels or nerf.features, or end other programs.",
        )


def _row(done: int, losses: list[Tensor]) -> tuple[int, float, float]:
    """Step, mean loss and PSNR of the steps since the last row; UserError when they are not finite."""
    loss, photometric = torch.stack(losses).mean(0).tolist()
    # Where rays are trimmed, errors that are no numbers leave the loss 0.
    _check_finite(loss + photometric, done - 1)
    return done, loss, -10.0 * math.log10(max(photometric, 1e-12))


def _on_cpu(
    model: nn.Module,
    light: Exposure | None,
    steppers: list[Stepper],
    buffer: RayBuffer,
    batch_rays: int,
    seed: int,
    shards: int,
    pool: Executor | None,
) -> Take:
    """What takes a step on a CPU."""
    keep_memory()

    def take(step: int) -> Tensor:
        batch = buffer.batch(step, batch_rays)
        return _one_step(model, light, steppers, batch, step, seed, shards, pool)

    return take


def _one_step(
    model: nn.Module,
    light: Exposure | None,
    steppers: list[Stepper],
    batch: Batch,
    step: int,
    seed: int,
    shards: int,
    pool: Executor | None,
) -> Tensor:
    """Gradients of every shard, then a step of every part; (loss, photometric loss) comes out."""
    pieces = _cut(batch, shards)
    weights = [_weight(piece) for piece in pieces]
    total = max(sum(weights), 1e-12)

    def shard(number: int) -> Found:
        piece = pieces[number]
        source = torch.Generator().manual_seed((seed * 1_000_003 + step) * 64 + number)
        return found_in(model, light, steppers, piece, step, source, weights[number] / total)

    done = _map(pool, shard, len(pieces))

    def advance(number: int) -> None:
        steppers[number].step(step, totals(steppers[number], done))

    _map(pool, advance, len(steppers))
    return torch.stack([piece.losses for piece in done]).sum(0)


def _weight(batch: Batch) -> float:
    """What the rays count together: each 1, or less under a soft mask (as eq. 4 is normalised)."""
    return float((1.0 - batch.drop_mask).square().sum())


def _cut(batch: Batch, shards: int) -> list[Batch]:
    """The batch in ``shards`` nearly equal pieces, none empty."""
    rays = zip(*(part.chunk(shards, dim=-1) for part in batch.rays), strict=True)
    rest = (part.chunk(shards, dim=0) for part in batch[1:])
    return [
        Batch(Rays(*(part.contiguous() for part in piece)), *others)
        for piece, *others in zip(rays, *rest, strict=True)
    ]


def _map(pool: Executor | None, function: Callable[[int], T], count: int) -> list[T]:
    if pool is None:
        return [function(i) for i in range(count)]
    return list(pool.map(function, range(count)))


@contextmanager
def _pool(threads: int) -> Iterator[Executor | None]:
    """Threads for the shards, one core each: torch's own threads lose on work this small.

    In them numbers too small to be normal are zero. What Adam knows of a row that no ray meets any more
    shrinks with every step and would stay there, where processors take many times as long for a number.
    """
    before, tiny = torch.get_num_threads(), _keeps_tiny()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    try:
        if threads <= 1:
            yield None
        else:
            with ThreadPoolExecutor(
                threads, initializer=torch.set_flush_denormal, initargs=(True,)
            ) as pool:
                yield pool
    finally:
        torch.set_num_threads(before)
        torch.set_flush_denormal(not tiny)


def _keeps_tiny() -> bool:
    """Whether this thread computes with numbers that are too small to be normal."""
    return bool(torch.full((1,), 1e-39).mul(1.0) > 0.0)


def _check_finite(loss: float, step: int) -> None:
    if not math.isfinite(loss):
        raise UserError(
            f"The fit broke down near step {step}: its loss is {loss}.",
            hint="Lower nerf.rate (0.5, say; in `refine` refine.rate), or change nerf.seed.",
        )


def _state(
    learned: list[nn.Module],
    steppers: list[Stepper],
    mean: Average,
    record: Record,
    running: list[Tensor],
) -> dict[str, Tensor]:
    state = {f"model:{name}": value.detach() for name, value in named_in(learned)} | mean.state()
    for stepper in steppers:
        state |= stepper.state()
    state["record"] = torch.tensor(record.rows, dtype=torch.float64).reshape(-1, 3)
    # Losses since the last row: the row that they go into must not depend on a restart.
    state["running"] = torch.stack(running) if running else torch.zeros(0, 2)
    return state


def _restore(
    learned: list[nn.Module],
    steppers: list[Stepper],
    mean: Average,
    record: Record,
    resume: tuple[int, dict[str, Tensor]],
) -> int:
    step, state = resume
    with torch.no_grad():
        for name, parameter in named_in(learned):
            parameter.copy_(state[f"model:{name}"])
    for stepper in steppers:
        stepper.restore(state)
    mean.restore(state)
    record.rows = [(int(a), b, c) for a, b, c in state["record"].tolist()]
    return step
