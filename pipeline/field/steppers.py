"""What steps a fit's parameters: gradients of a batch in, Adam's steps, and their mean at the end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pipeline.field.adam import Moments, Settings, advance, advance_and_clear, at_rest
from pipeline.field.base import Field, Part, TableGradient
from pipeline.field.buffer import Batch


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
        self.now: float | Tensor = self.rate
        self.rooms: dict[str, Tensor] = {}
        self.moments: dict[str, Moments] = {}

    def rate_at(self, step: int) -> float:
        """The rate of a step."""
        rate = self.rate * self.part.final ** (step / self.steps)
        warmup = min(self.part.warmup, self.steps // 20)
        return rate * min(1.0, (step + 1) / warmup) if warmup else rate

    def step(self, step: int, gradients: Sequence[Tensor | None]) -> None:
        """One step with the given gradients; what has none stays as it is."""
        self.now = self.rate_at(step)
        self.apply(gradients)

    def apply(self, gradients: Sequence[Tensor | None]) -> None:
        """As :meth:`step`, at the rate that was set last."""
        part, moved = self.part, list[tuple[Tensor, Tensor, Moments]]()
        settings = Settings(self.now, part.betas, part.eps, part.decay)
        for name, parameter, gradient in zip(
            part.parameters, self.parameters, gradients, strict=True
        ):
            if gradient is None:
                continue
            if name not in self.moments:
                self.moments[name] = at_rest(parameter)
            moments = self.moments[name]
            if gradient is self.rooms.get(name) and gradient.device.type == "cpu":
                advance_and_clear(parameter, gradient, moments, settings)
            else:
                moved.append((parameter, gradient, moments))
        if moved:
            advance(moved, settings)

    def room(self, name: str) -> Tensor:
        """Zeros of a parameter's shape to add its gradient up in, the same memory in every step.

        On a CPU the step clears it.
        """
        if name not in self.rooms:
            place = self.part.parameters.index(name)
            self.rooms[name] = torch.zeros_like(self.parameters[place])
        room = self.rooms[name]
        return room if room.device.type == "cpu" else room.zero_()

    def state(self) -> dict[str, Tensor]:
        """Adam's running moments by name; what :meth:`restore` takes back."""
        return {
            f"{key}:{name}": value
            for name, moments in self.moments.items()
            for key, value in moments._asdict().items()
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`state`."""
        self.moments = {
            name: Moments(*(state[f"{key}:{name}"].clone() for key in Moments._fields))
            for name in self.part.parameters
            if f"step:{name}" in state
        }


class Average:
    """The mean of parameters over the last ``share`` of ``steps`` steps: after every tenth and the last.

    Rates of Adam's kind leave parameters wandering about where they have arrived; their mean is
    nearer to it than any of them (Polyak and Juditsky, doi:10.1137/0330046).
    """

    EVERY = 10

    def __init__(self, learned: list[nn.Module], steps: int, share: float) -> None:
        self.named, self.steps, self.span = named_in(learned), steps, round(share * steps)
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


class Found(NamedTuple):
    """Of one piece of a batch: (loss, photometric loss), gradients by name, rows still to be added."""

    losses: Tensor
    gradients: dict[str, Tensor | None]
    sink: list[TableGradient]


def found_in(
    model: nn.Module,
    light: Exposure | None,
    steppers: Sequence[Stepper],
    piece: Batch,
    step: int,
    source: torch.Generator,
    share: float,
) -> Found:
    """The losses and gradients of a piece that is ``share`` of its batch."""
    named = {
        name: parameter
        for stepper in steppers
        for name, parameter in zip(stepper.part.parameters, stepper.parameters, strict=True)
    }
    sink: list[TableGradient] = []
    gain = None if light is None else light.gains().index_select(0, piece.view)
    loss, photometric = as_field(model).loss(
        piece.rays, piece.observed, piece.drop_mask, step, source, sink, gain
    )
    gradients = torch.autograd.grad(loss * share, list(named.values()), allow_unused=True)
    both = torch.stack([loss.detach(), photometric.detach()]) * share
    return Found(both, dict(zip(named, gradients, strict=True)), sink)


def totals(stepper: Stepper, found: Sequence[Found]) -> list[Tensor | None]:
    """The gradients of all of a part's parameters over all pieces, added in a fixed order."""
    out: list[Tensor | None] = []
    for name in stepper.part.parameters:
        entries = [entry for piece in found for entry in piece.sink if entry.table == name]
        if entries:
            total = stepper.room(name)
            for entry in entries:
                entry.add_to(total)
            out.append(total)
        else:
            out.append(_sum([piece.gradients[name] for piece in found]))
    return out


def _sum(parts: Sequence[Tensor | None]) -> Tensor | None:
    dense = [part for part in parts if part is not None]
    if len(dense) == 1:
        return dense[0]
    return torch.stack(dense).sum(0) if dense else None


def as_field(model: nn.Module) -> Field:
    """A field that is a module."""
    return model  # type: ignore[return-value]


def steppers_of(model: nn.Module, steps: int, rate: float) -> list[Stepper]:
    """One for each part of a field."""
    named = dict(model.named_parameters())
    parts = as_field(model).parts()
    listed = sorted(name for part in parts for name in part.parameters)
    if listed != sorted(named):
        raise ValueError("every parameter of a field must be in exactly one part")
    return [Stepper(part, [named[name] for name in part.parameters], steps, rate) for part in parts]


def named_in(learned: list[nn.Module]) -> list[tuple[str, nn.Parameter]]:
    """All parameters that are learned, by name."""
    return [entry for module in learned for entry in module.named_parameters()]
