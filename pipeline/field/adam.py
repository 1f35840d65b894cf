"""AdamW's steps (arXiv:1412.6980, 1711.05101) of parameters in place, on any device.

torch's own, without ``torch.optim.AdamW`` around them, which loads torch's compiler: one to two seconds at the
start of every fit. A table of features is stepped in a loop of its own on a CPU, which clears the gradient for
the next step as it goes: what limits such a step is the memory that it moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.optim.adamw import adamw

from pipeline.geometry.compiled import compiled as machine_code


class Moments(NamedTuple):
    """What Adam knows of a parameter: the running means of its gradient and of its square, and its steps."""

    exp_avg: Tensor
    exp_avg_sq: Tensor
    step: Tensor


class Settings(NamedTuple):
    """Of one step: the learning rate, on a GPU a tensor; beta 1 and 2; epsilon; and the decay by the rate."""

    rate: float | Tensor
    betas: tuple[float, float]
    eps: float
    decay: float


def at_rest(parameter: Tensor) -> Moments:
    """The moments before the first step."""
    still = torch.zeros((), device=parameter.device)
    return Moments(torch.zeros_like(parameter), torch.zeros_like(parameter), still)


@torch.no_grad()
def advance(moved: Sequence[tuple[Tensor, Tensor, Moments]], settings: Settings) -> None:
    """One step of all parameters and their moments; ``moved``: parameter, gradient and moments of each."""
    parameters, gradients, moments = zip(*moved, strict=True)
    adamw(
        list(parameters),
        list(gradients),
        [one.exp_avg for one in moments],
        [one.exp_avg_sq for one in moments],
        [],
        [one.step for one in moments],
        fused=True,
        amsgrad=False,
        maximize=False,
        beta1=settings.betas[0],
        beta2=settings.betas[1],
        lr=settings.rate,
        weight_decay=settings.decay,
        eps=settings.eps,
    )


def advance_and_clear(
    parameter: Tensor, gradient: Tensor, moments: Moments, settings: Settings
) -> None:
    """As :func:`advance`, of one parameter on a CPU, whose gradient is zero afterwards."""
    moments.step.add_(1)
    step, rate, (beta1, beta2) = int(moments.step), float(settings.rate), settings.betas
    numbers = (
        1.0 - rate * settings.decay, 1.0 - beta1, beta2, 1.0 - beta2, settings.eps,
        math.sqrt(1.0 - beta2**step), -rate / (1.0 - beta1**step),
    )  # fmt: skip
    arrays = parameter, gradient, moments.exp_avg, moments.exp_avg_sq
    flat = (array.detach().view(-1).numpy() for array in arrays)
    _stepped(*flat, *(np.float32(number) for number in numbers))


def _fused(function: Any) -> Any:
    """Products and sums rounded once, as torch's are; all else as written."""
    return machine_code(function, fastmath={"contract"})


@_fused
def _mean(before, now, share):  # type: ignore[no-untyped-def]
    return before + share * (now - before)


@_fused
def _mean_square(before, now, keep, share):  # type: ignore[no-untyped-def]
    return before * keep + share * now * now


@machine_code
def _stepped(p, g, m, v, kept, share1, beta2, share2, eps, root, pace):  # type: ignore[no-untyped-def]
    """Steps ``p`` and its moments ``m`` and ``v``, all (N,), and clears ``g``."""
    for i in range(p.size):
        now = g[i]
        g[i] = np.float32(0.0)
        mean = _mean(m[i], now, share1)
        square = _mean_square(v[i], now, beta2, share2)
        m[i], v[i] = mean, square
        p[i] = p[i] * kept + pace * mean / (np.sqrt(square) / root + eps)
