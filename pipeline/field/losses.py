"""The losses of a fit: the paper's masked photometric loss, and what trains the proposal."""

from __future__ import annotations

import torch
from torch import Tensor


def masked_photometric_loss(
    rendered: Tensor, observed: Tensor, drop_mask: Tensor, trim: float = 0.0
) -> Tensor:
    """Mean squared colour error over the rays that count (eq. 4 of the paper, normalised).

    ``rendered`` and ``observed`` ``(R, 3)``; ``drop_mask`` ``(R,)`` is the paper's M: 1 on a drop,
    0 elsewhere, soft values between them weigh a ray down. The paper sums over rays; here the sum
    is divided by three times the rays that count, so the step does not shrink with the coverage.
    No ray that counts gives 0. ``trim`` leaves out that share of the rays: those that are farthest
    off, which may be water that no mask covers (least trimmed squares, doi:10.2307/2288718).
    """
    keep = 1.0 - drop_mask.to(rendered.dtype)
    error = ((rendered - observed) * keep[:, None]).square().sum(1)
    weight = keep.square()
    if trim > 0.0:
        used = max(1, round(error.shape[0] * (1.0 - trim)))
        limit = error.detach().kthvalue(used).values
        weight = torch.where(error.detach() <= limit, weight, 0.0)
        error = torch.where(error.detach() <= limit, error, 0.0)
    return error.sum() / (3.0 * weight.sum()).clamp_min(1e-12)


def proposal_loss(
    edges: Tensor, weights: Tensor, proposal_weights: Tensor, eps: float = 1e-7
) -> Tensor:
    """How far the field's weights exceed what the proposal's histogram allows, mean over rays.

    ``edges`` ``(R, S+1)`` in [0, 1] and ``weights`` ``(R, S)`` are the field's intervals (no
    gradient flows into them); ``proposal_weights`` ``(R, B)`` belong to B equal bins of [0, 1].
    Each interval's weight may not exceed the sum of the bins that it touches
    (mip-NeRF 360, doi:10.1109/CVPR52688.2022.00539, eq. 13).
    """
    bins = proposal_weights.shape[-1]
    zero = torch.zeros_like(proposal_weights[:, :1])
    total = torch.cat([zero, torch.cumsum(proposal_weights, dim=-1)], dim=-1)
    scaled = edges.detach() * bins
    first = scaled[:, :-1].floor().clamp(0, bins).long()
    last = scaled[:, 1:].ceil().clamp(0, bins).long()
    bound = torch.gather(total, 1, last) - torch.gather(total, 1, first)
    fixed = weights.detach()
    excess = (fixed - bound).clamp_min(0.0)
    return (excess.square() / (fixed + eps)).sum(-1).mean()


def distortion_loss(edges: Tensor, weights: Tensor) -> Tensor:
    """How spread out the weights are along each ray, mean over rays.

    ``edges`` ``(R, S+1)`` in [0, 1], ``weights`` ``(R, S)``:
    ``sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (e_{i+1} - e_i)`` with the midpoints m
    (mip-NeRF 360, doi:10.1109/CVPR52688.2022.00539, eq. 15).
    """
    width = edges[:, 1:] - edges[:, :-1]
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    # For sorted midpoints the double sum is a single pass over running sums.
    mass = torch.cumsum(weights, dim=-1) - weights
    moment = torch.cumsum(weights * middle, dim=-1) - weights * middle
    between = 2.0 * (weights * (middle * mass - moment)).sum(-1)
    within = (weights.square() * width).sum(-1) / 3.0
    return (between + within).mean()
