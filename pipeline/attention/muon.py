"""The Muon optimiser: momentum whose matrices are made orthogonal before they are applied."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

# Quintic Newton-Schulz coefficients; they push all singular values into about [0.7, 1.2].
_A, _B, _C = 3.4445, -4.7750, 2.0315


def orthogonalised(matrix: Tensor, rounds: int = 5) -> Tensor:
    """The matrix (rows, columns) with its singular values moved close to 1, by Newton-Schulz.

    Source: K. Jordan, "Muon: an optimizer for hidden layers in neural networks", 2024.
    """
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix
    x = x / x.norm().clamp_min(1e-7)
    for _ in range(rounds):
        gram = x @ x.T
        x = _A * x + (_B * gram + _C * gram @ gram) @ x
    return x.T if tall else x


class Muon(torch.optim.Optimizer):
    """Nesterov momentum on convolution weights, orthogonalised as (outputs, inputs*k*k) matrices.

    torch.optim has one from 2.9 on, for two-dimensional tensors and in bfloat16; this one reads
    four-dimensional weights, works in float32 and with every torch that the project supports.
    """

    def __init__(self, params: Iterable[Tensor], lr: float, momentum: float = 0.95) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Applies one update; parameters without a gradient stay."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if not state:
                    state["velocity"] = torch.zeros_like(weight)
                velocity = state["velocity"].lerp_(weight.grad, 1 - group["momentum"])
                push = weight.grad.lerp(velocity, group["momentum"]).flatten(1)
                stretch = max(1.0, push.shape[0] / push.shape[1]) ** 0.5
                weight.sub_(orthogonalised(push).view_as(weight), alpha=group["lr"] * stretch)
