"""Where along a ray a field is asked: depth spacing, and samples drawn from a histogram."""

from __future__ import annotations

import torch
from torch import Tensor


def depth_at(s: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """Depth t of the normalised position ``s`` in [0, 1]: linear in inverse depth.

    ``near`` and ``far`` broadcast against ``s``; s = 0 is near, s = 1 is far.
    """
    return 1.0 / (1.0 / near + s * (1.0 / far - 1.0 / near))


def invert_histogram(weights: Tensor, u: Tensor) -> Tensor:
    """Positions in [0, 1] whose cumulative weight is ``u``.

    ``weights`` ``(R, B)``, non-negative, of B equal bins of [0, 1]; ``u`` ``(R, K)`` in [0, 1],
    sorted along the last axis: the result is sorted too. A ray without any weight is taken as
    uniform.
    """
    bins = weights.shape[-1]
    cdf = torch.cumsum(weights + 1e-6, dim=-1)
    cdf = cdf / cdf[:, -1:]
    # The bin whose upper edge is the first to reach u.
    index = torch.searchsorted(cdf, u.contiguous()).clamp_max(bins - 1)
    upper = torch.gather(cdf, 1, index)
    lower = torch.where(index > 0, torch.gather(cdf, 1, (index - 1).clamp_min(0)), 0.0)
    inside = ((u - lower) / (upper - lower).clamp_min(1e-12)).clamp(0.0, 1.0)
    return (index + inside) / bins


def stratified(rays: int, count: int, generator: torch.Generator | None, like: Tensor) -> Tensor:
    """``(rays, count)`` increasing numbers in [0, 1], one per equal stratum.

    Random within each stratum with a generator, in its middle without one.
    """
    strata = torch.arange(count, dtype=like.dtype, device=like.device)
    if generator is None:
        return ((strata + 0.5) / count).expand(rays, count)
    noise = torch.rand(rays, count, generator=generator, dtype=like.dtype, device=like.device)
    return (strata + noise) / count


def intervals_around(s: Tensor) -> Tensor:
    """Edges ``(R, K+1)`` of intervals around sorted positions ``s`` ``(R, K)``.

    Half-way between neighbours; the outer ones mirror the first and the last gap, within [0, 1].
    """
    middle = 0.5 * (s[:, 1:] + s[:, :-1])
    first = (2.0 * s[:, :1] - middle[:, :1]).clamp_min(0.0)
    last = (2.0 * s[:, -1:] - middle[:, -1:]).clamp_max(1.0)
    return torch.cat([first, middle, last], dim=1)


def middles(edges: Tensor) -> tuple[Tensor, Tensor]:
    """Middles ``(3, R, S)`` and lengths ``(R, S)`` of the pieces between ``edges`` ``(3, R, S+1)``."""
    step = edges[:, :, 1:] - edges[:, :, :-1]
    # Ten times faster than torch.linalg.vector_norm over the first axis.
    delta = (step[0].square() + step[1].square() + step[2].square()).sqrt()
    return 0.5 * (edges[:, :, 1:] + edges[:, :, :-1]), delta


def invert_pieces(edges: Tensor, weights: Tensor, u: Tensor) -> Tensor:
    """Positions whose cumulative weight is ``u``, for bins of any width.

    ``edges`` ``(R, B+1)`` increasing, ``weights`` ``(R, B)``, ``u`` ``(R, K)`` sorted, in [0, 1]:
    NeRF's hierarchical sampling (doi:10.1145/3503250, section 5.2).
    """
    mass = weights + 1e-5
    cdf = torch.cumsum(mass / mass.sum(-1, keepdim=True), dim=-1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], dim=-1)
    upper = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, edges.shape[1] - 1)
    low_mass, high_mass = torch.gather(cdf, 1, upper - 1), torch.gather(cdf, 1, upper)
    low, high = torch.gather(edges, 1, upper - 1), torch.gather(edges, 1, upper)
    inside = ((u - low_mass) / (high_mass - low_mass).clamp_min(1e-5)).clamp(0.0, 1.0)
    return low + inside * (high - low)
