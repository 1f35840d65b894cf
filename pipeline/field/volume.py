"""Volume rendering: eq. 1 of the paper as a sum over intervals along each ray."""

from __future__ import annotations

import torch
from torch import Tensor


def transmittance(sigma: Tensor, delta: Tensor) -> Tensor:
    """``T_i``, the share of light that reaches the start of each interval, in [0, 1].

    ``sigma`` ``(..., S)`` density, constant over each interval, ``delta`` ``(..., S)`` the
    intervals' lengths: ``T_i = exp(-sum_{j<i} sigma_j delta_j)`` (eq. 1, T(t)).
    """
    tau = sigma * delta
    return torch.exp(-(torch.cumsum(tau, dim=-1) - tau))


def render_weights(sigma: Tensor, delta: Tensor, *, opaque_last: bool = False) -> Tensor:
    """``w_i = T_i (1 - exp(-sigma_i delta_i))``, each interval's share of the pixel (eq. 1).

    Shapes as in :func:`transmittance`. With ``opaque_last`` the last interval stops what is left
    of the ray: the background, so that the weights sum to one.
    """
    # T_i alpha_i = T_i - T_{i+1}: what enters an interval and does not leave it.
    left = torch.exp(-torch.cumsum(sigma * delta, dim=-1))
    enters = torch.cat([torch.ones_like(left[..., :1]), left[..., :-1]], dim=-1)
    if opaque_last:
        left = torch.cat([left[..., :-1], torch.zeros_like(left[..., :1])], dim=-1)
    return enters - left


def composite(weights: Tensor, values: Tensor) -> Tensor:
    """``sum_i w_i v_i``: the pixel's value ``(..., C)`` from ``(..., S)`` and ``(..., S, C)``."""
    return (weights.unsqueeze(-2) @ values).squeeze(-2)
