"""The fit: rays of kept pixels in, parameters stepped; the same bytes for the same seed on a CPU.

A batch is cut into a fixed number of shards that run in threads, each on one core; then every
table's gradient is added up and stepped in a thread of its own. Nothing depends on how many
threads there are, only the time does.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from torch import Tensor, nn

from pipeline.errors import UserError
from pipeline.field.base import Field, Part, Rays
from pipeline.field.buffer import Batch, RayBuffer
from pipeline.field.encoding import RowGradient, add_rows, add_single

log = logging.getLogger(__name__)

T = TypeVar("T")

Progress = Callable[[int, float, float], None]
Save = Callable[[int, dict[str, Tensor]], None]


@dataclass
class Record:
    """The course of a fit: step, loss and training PSNR in dB, averaged since the row before."""

    rows: list[tuple[int, float, float]] = field(default_factory=list)
    gains: Tensor | None = None


class Exposure(nn.Module):
    """One factor per photo and channel between the scene and the photo; their mean is 1.

    The mean is taken of the logarithms: what all photos share is the scene's own brightness.
    """

    def __init__(self, photos: int) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(photos, 3))

    def gains(self) -> Tensor:
        """``(V, 3)`` factors."""
        return torch.exp(self.log_gain - self.log_gain.mean(0))

    def parts(self) -> list[Part]:
        """How it is stepped."""
        return [Part("log_gain", ("log_gain",), 1e-2, 0.1, warmup=50)]


class Stepper:
    """Adam for one part of a field, at a rate that depends on the step alone."""

    def __init__(
        self, part: Part, parameters: list[nn.Parameter], steps: int, rate: float = 1.0
    ) -> None:
        self.part, self.parameters, self.steps = part, parameters, steps
        self.rate = part.rate * rate
        self.adam = torch.optim.AdamW(
            parameters,
            lr=self.rate,
            betas=part.betas,
            eps=part.eps,
            weight_decay=part.decay,
            fused=True,
        )

    def step(self, step: int, gradients: Sequence[Tensor | None]) -> None:
        """One step with the given gradients; none at all leaves the part as it is."""
        if all(gradient is None for gradient in gradients):
            return
        rate = self.rate * self.part.final ** (step / self.steps)
        if self.part.warmup:
            rate *= min(1.0, (step + 1) / self.part.warmup)
        self.adam.param_groups[0]["lr"] = rate
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        self.adam.step()
        for parameter in self.parameters:
            parameter.grad = None

    def state(self) -> dict[str, Tensor]:
        """Adam's running moments by name; what :meth:`restore` takes back."""
        out = {}
        for name, parameter in zip(self.part.parameters, self.parameters, strict=True):
            for key, value in self.adam.state[parameter].items():
                out[f"{key}:{name}"] = value
        return out

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`state`."""
        for name, parameter in zip(self.part.parameters, self.parameters, strict=True):
            for key in ("step", "exp_avg", "exp_avg_sq"):
                if f"{key}:{name}" in state:
                    self.adam.state[parameter][key] = state[f"{key}:{name}"].clone()


class Average:
    """The mean of parameters over the last ``steps - start`` of ``steps`` steps, every tenth and the last.

    Rates of Adam's kind leave parameters wandering about where they have arrived; their mean is
    nearer to it than any of them (Polyak and Juditsky, doi:10.1137/0330046).
    """

    EVERY = 10

    def __init__(self, learned: list[nn.Module], steps: int, share: float) -> None:
        self.named, self.steps, self.span = _named(learned), steps, round(share * steps)
        self.means: dict[str, Tensor] = {}

    def add(self, done: int) -> None:
        """The parameters as they are after ``done`` steps, if these count."""
        left = self.steps - done
        if left >= self.span or left % self.EVERY:
            return
        number = (self.span - 1) // self.EVERY - left // self.EVERY + 1
        for name, parameter in self.named:
            if number == 1:
                self.means[name] = parameter.detach().clone()
            else:
                self.means[name].lerp_(parameter.detach(), 1.0 / number)

    def finish(self) -> None:
        """Gives every parameter its mean, if there is one."""
        with torch.no_grad():
            for name, parameter in self.named:
                if name in self.means:
                    parameter.copy_(self.means[name])

    def state(self) -> dict[str, Tensor]:
        """The means by name; what :meth:`restore` takes back."""
        return {f"mean:{name}": value for name, value in self.means.items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`state`."""
        names = [name for name, _ in self.named if f"mean:{name}" in state]
        self.means = {name: state[f"mean:{name}"].clone() for name in names}


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
) -> Record:
    """Fit ``model`` (a :class:`Field`) in place; the course of it comes out.

    ``shards`` pieces of each batch run side by side on up to ``threads`` cores: the shards decide
    the bytes, the threads do not. ``rate`` multiplies every learning rate. With
    ``exposure`` each photo has a brightness of its own (``gains`` of the record, ``(V, 3)``).
    ``average`` is the share of the steps, the last ones, over which the parameters' mean is taken
    for the field that comes out (0: as the last step left it).
    ``save(step, state)`` is called every ``save_every`` steps;
    ``resume`` takes such a pair and goes on to the same bytes. ``progress(step, loss, psnr)``.
    Raises UserError when the loss is not finite.
    """
    light = Exposure(buffer.photos).to(buffer.device) if exposure else None
    learned = [model] if light is None else [model, light]
    steppers = [stepper for module in learned for stepper in _steppers(module, steps, rate)]
    # The largest first: two threads then finish at about the same time.
    steppers.sort(key=lambda stepper: -sum(one.numel() for one in stepper.parameters))
    record, mean = Record(), Average(learned, steps, average)
    running: list[Tensor] = []
    first = 0
    if resume is not None:
        first = _restore(learned, steppers, mean, record, resume)
        running = list(resume[1]["running"])
    with _pool(threads, buffer.device) as pool:
        for step in range(first, steps):
            batch = buffer.batch(step, batch_rays)
            losses = _one_step(model, light, steppers, batch, step, seed, shards, pool)
            running.append(losses)
            done = step + 1
            mean.add(done)
            if done % log_every == 0 or done == steps:
                record.rows.append(_row(done, running))
                running.clear()
                if progress is not None:
                    progress(*record.rows[-1])
            if save is not None and save_every and done % save_every == 0 and done < steps:
                save(done, _state(learned, steppers, mean, record, running))
    mean.finish()
    if light is not None:
        record.gains = light.gains().detach().cpu()
    return record


def _row(done: int, losses: list[Tensor]) -> tuple[int, float, float]:
    """Step, mean loss and PSNR of the steps since the last row; UserError when they are not finite."""
    loss, photometric = torch.stack(losses).mean(0).tolist()
    _check_finite(loss, done - 1)
    return done, loss, -10.0 * math.log10(max(photometric, 1e-12))


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
    dense = [
        (name, parameter)
        for stepper in steppers
        for name, parameter in zip(stepper.part.parameters, stepper.parameters, strict=True)
    ]
    pieces = _cut(batch, shards)
    total = batch.observed.shape[0]

    def shard(number: int) -> tuple[Tensor, dict[str, Tensor | None], list[RowGradient]]:
        piece = pieces[number]
        share = piece.observed.shape[0] / total
        source = torch.Generator(piece.observed.device)
        source.manual_seed((seed * 1_000_003 + step) * 64 + number)
        sink: list[RowGradient] = []
        gain = None if light is None else light.gains()[piece.view]
        loss, photometric = _as_field(model).loss(
            piece.rays, piece.observed, piece.drop_mask, step, source, sink, gain
        )
        gradients = torch.autograd.grad(
            loss * share, [parameter for _, parameter in dense], allow_unused=True
        )
        names = [name for name, _ in dense]
        both = torch.stack([loss.detach(), photometric.detach()]) * share
        return both, dict(zip(names, gradients, strict=True)), sink

    done = _map(pool, shard, len(pieces))

    def advance(number: int) -> None:
        stepper = steppers[number]
        gradients = [
            _total(name, parameter, done)
            for name, parameter in zip(stepper.part.parameters, stepper.parameters, strict=True)
        ]
        stepper.step(step, gradients)

    _map(pool, advance, len(steppers))
    return torch.stack([both for both, _, _ in done]).sum(0)


def _total(
    name: str,
    parameter: nn.Parameter,
    done: list[tuple[Tensor, dict[str, Tensor | None], list[RowGradient]]],
) -> Tensor | None:
    """One parameter's gradient over all shards, added in a fixed order."""
    rows = [entry for _, _, sink in done for entry in sink if entry.table == name]
    if rows:
        places = torch.cat([entry.rows for entry in rows])
        gradient = torch.cat([entry.gradient for entry in rows])
        weights = [entry.weights for entry in rows if entry.weights is not None]
        if not weights:
            return add_single(places, gradient, parameter.shape[0])
        return add_rows(places, torch.cat(weights), gradient, parameter.shape[0])
    parts = [gradients[name] for _, gradients, _ in done]
    found = [part for part in parts if part is not None]
    return torch.stack(found).sum(0) if found else None


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
def _pool(threads: int, device: str) -> Iterator[Executor | None]:
    """Threads for the shards, one core each: torch's own threads lose on work this small."""
    if device != "cpu":
        yield None
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        if threads <= 1:
            yield None
        else:
            with ThreadPoolExecutor(threads) as pool:
                yield pool
    finally:
        torch.set_num_threads(before)


def _as_field(model: nn.Module) -> Field:
    return model  # type: ignore[return-value]


def _steppers(model: nn.Module, steps: int, rate: float) -> list[Stepper]:
    named = dict(model.named_parameters())
    parts = _as_field(model).parts()
    listed = sorted(name for part in parts for name in part.parameters)
    if listed != sorted(named):
        raise ValueError("every parameter of a field must be in exactly one part")
    return [Stepper(part, [named[name] for name in part.parameters], steps, rate) for part in parts]


def _check_finite(loss: float, step: int) -> None:
    if not math.isfinite(loss):
        raise UserError(
            f"The fit broke down near step {step}: its loss is {loss}.",
            hint="Lower nerf.rate (0.5, say), or change nerf.seed.",
        )


def _state(
    learned: list[nn.Module],
    steppers: list[Stepper],
    mean: Average,
    record: Record,
    running: list[Tensor],
) -> dict[str, Tensor]:
    state = {f"model:{name}": value.detach() for name, value in _named(learned)} | mean.state()
    for stepper in steppers:
        state |= stepper.state()
    state["record"] = torch.tensor(record.rows, dtype=torch.float64).reshape(-1, 3)
    # Losses since the last row: the row that they go into must not depend on a restart.
    state["running"] = torch.stack(running) if running else torch.zeros(0, 2)
    return state


def _named(learned: list[nn.Module]) -> list[tuple[str, nn.Parameter]]:
    return [entry for module in learned for entry in module.named_parameters()]


def _restore(
    learned: list[nn.Module],
    steppers: list[Stepper],
    mean: Average,
    record: Record,
    resume: tuple[int, dict[str, Tensor]],
) -> int:
    step, state = resume
    with torch.no_grad():
        for name, parameter in _named(learned):
            parameter.copy_(state[f"model:{name}"])
    for stepper in steppers:
        stepper.restore(state)
    mean.restore(state)
    record.rows = [(int(a), b, c) for a, b, c in state["record"].tolist()]
    return step
