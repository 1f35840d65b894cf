"""The fast field's inner work on a CPU, fused: the same numbers as the tensor operations that it replaces.

Each function here has its twin in plain tensor operations, which any device runs (sampling.py, volume.py,
losses.py, encoding.py); the tests hold the two to each other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from pipeline.field import kernels, table_kernels
from pipeline.field.base import TableGradient
from pipeline.geometry.spaces import Space

NOTHING = np.empty((0, 0), np.float32)
NO_SHAKE = np.empty((0, 0, 0), np.float32)
BLOCK = 2048  # points: what the network makes of as many stays in the nearest caches


def walk(
    space: Space, rays_o: Tensor, rays_d: Tensor, near: Tensor, far: Tensor, s: Tensor
) -> Tensor:
    """Unit-cube positions ``(3, R, K)`` of normalised depths ``s`` ``(R, K)`` or ``(1, K)``."""
    turn, shift, low, scale = _frame(space)
    o, d = torch.addmm(shift, turn, rays_o), turn @ rays_d
    out = torch.empty(3, o.shape[1], s.shape[1])
    kernels.walk(
        o.numpy(), d.numpy(), near.numpy(), far.numpy(), s.numpy(),
        space.kind == "ndc", np.float32(space.near), low, scale, out.numpy(),
    )  # fmt: skip
    return out


@lru_cache(maxsize=8)
def _frame(space: Space) -> tuple[Tensor, Tensor, np.ndarray, np.ndarray]:
    """The space's turn (3, 3) and shift (3, 1) of the world, its low corner and its scale (3,)."""
    matrix = torch.tensor(space.ref_from_world, dtype=torch.float32)
    scale = [1.0 / (high - low) for low, high in zip(space.low, space.high, strict=True)]
    return (
        matrix[:, :3], matrix[:, 3:], np.array(space.low, np.float32), np.array(scale, np.float32)
    )  # fmt: skip


def first_uniform(generator: torch.Generator, count: int) -> Tensor:
    """The first numbers ``(count,)`` in [0, 1) of a generator as it was seeded; torch takes five times as long.

    Where the generator stands does not matter, and it stays there.
    """
    out = torch.empty(count)
    kernels.uniform(np.uint32(generator.initial_seed() & 0xFFFFFFFF), out.numpy())
    return out


def nearest_rows(
    edges: Tensor, along: Tensor | None, shake: Tensor | None, sizes: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """Proposal rows ``(R, B)`` int32 of one point in each interval, and the intervals' lengths.

    ``edges`` ``(3, R, B+1)`` in the unit cube; ``along`` ``(R, B)`` places the points (None: the
    middles), ``shake`` ``(3, R, B)`` in [0, 1] moves them by up to half a cell.
    """
    rows = torch.empty(edges.shape[1], edges.shape[2] - 1, dtype=torch.int32)
    delta = torch.empty(rows.shape)
    kernels.nearest_rows(
        edges.numpy(),
        NOTHING if along is None else along.numpy(),
        NO_SHAKE if shake is None else shake.numpy(),
        np.array(sizes, np.int32), rows.numpy(), delta.numpy(),
    )  # fmt: skip
    return rows, delta


def drawn_edges(weights: Tensor, u: Tensor) -> Tensor:
    """``intervals_around(invert_histogram(weights, u))`` of sampling.py."""
    edges = torch.empty(u.shape[0], u.shape[1] + 1)
    kernels.draw(weights.contiguous().numpy(), u.contiguous().numpy(), edges.numpy())
    return edges


def middles(edges: Tensor) -> tuple[Tensor, Tensor]:
    """Middles ``(3, R, S)`` and lengths ``(R, S)`` of the pieces between ``edges`` ``(3, R, S+1)``."""
    x = torch.empty(3, edges.shape[1], edges.shape[2] - 1)
    delta = torch.empty(x.shape[1:])
    kernels.middles(edges.numpy(), x.numpy(), delta.numpy())
    return x, delta


class CellGradient(NamedTuple):
    """A gradient of one level's table, not yet added up: columns from ``first`` on of the features'."""

    table: str
    x: Tensor
    resolution: tuple[int, int, int]
    first: int
    gradient: Tensor

    def add_to(self, total: Tensor) -> None:
        """Adds what the samples pass back into the table's rows, ``(size, F)``, sample by sample."""
        table_kernels.add_rows(
            self.x.numpy(), *_grid(self.resolution, total.shape[0]), self.gradient.numpy(),
            self.first, total.numpy(), (0,) * total.shape[1],
        )  # fmt: skip


def _grid(resolution: tuple[int, int, int], size: int) -> tuple[np.ndarray, bool, np.int32]:
    """Vertices per axis, whether a table of ``size`` rows holds them all, and its last row."""
    return np.array(resolution, np.int32), math.prod(resolution) <= size, np.int32(size - 1)


class _GridFeatures(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        names: Sequence[str],
        resolutions: Sequence[tuple[int, int, int]],
        sink: list[TableGradient] | None,
        *tables: Tensor,
    ) -> Tensor:
        *firsts, width = itertools.accumulate((table.shape[1] for table in tables), initial=0)
        out = torch.empty(x.shape[1], width)
        for table, resolution, first in zip(tables, resolutions, firsts, strict=True):
            table_kernels.read_rows(
                x.numpy(), *_grid(resolution, table.shape[0]), table.detach().numpy(), first,
                out.numpy(), (0,) * table.shape[1],
            )  # fmt: skip
        ctx.save_for_backward(x)
        ctx.sink, ctx.levels = sink, list(zip(names, resolutions, firsts, strict=True))
        ctx.shapes = [table.shape for table in tables]
        return out

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> Any:
        (x,), g = ctx.saved_tensors, g.contiguous()
        entries = [CellGradient(n, x, r, first, g) for n, r, first in ctx.levels]
        if ctx.sink is not None:
            ctx.sink.extend(entries)
            return (None,) * (4 + len(entries))
        totals = [torch.zeros(shape) for shape in ctx.shapes]
        for entry, total in zip(entries, totals, strict=True):
            entry.add_to(total)
        return None, None, None, None, *totals


def grid_features(
    x: Tensor,
    names: Sequence[str],
    resolutions: Sequence[tuple[int, int, int]],
    tables: Sequence[Tensor],
    sink: list[TableGradient] | None,
) -> Tensor:
    """As :meth:`pipeline.field.encoding.HashGrid.forward`; ``names`` are the tables' in the sink."""
    out: Tensor = _GridFeatures.apply(x, names, resolutions, sink, *tables)
    return out


def _absorbed(raw: Tensor, delta: Tensor, limit: float) -> tuple[Tensor, Tensor, Tensor]:
    """Optical depth of each interval, what is left behind it, and the weights; the last is opaque."""
    tau = torch.exp(raw.clamp_max(limit)).mul_(delta)
    left = torch.exp(-torch.cumsum(tau, dim=-1))
    left[:, -1] = 0.0
    weights = torch.empty_like(left)
    weights[:, 0] = 1.0 - left[:, 0]
    torch.sub(left[:, :-1], left[:, 1:], out=weights[:, 1:])
    # The gradient of a density at its limit is nothing.
    tau.masked_fill_(raw > limit, 0.0)
    return tau, left, weights


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor, delta: Tensor, limit: float) -> Tensor:
        tau, left, weights = _absorbed(raw, delta, limit)
        ctx.save_for_backward(tau, left, weights)
        return weights

    @staticmethod
    def backward(ctx: Any, g_weights: Tensor) -> Any:
        tau, left, weights = ctx.saved_tensors
        out = torch.empty_like(weights)
        kernels.weights_back(
            weights.numpy(), left.numpy(), tau.numpy(), g_weights.contiguous().numpy(), out.numpy()
        )
        return out, None, None


def weights_of(raw: Tensor, delta: Tensor, limit: float) -> Tensor:
    """``render_weights(exp(raw), delta, opaque_last=True)`` with ``raw`` at most ``limit``."""
    out: Tensor = _Weights.apply(raw, delta, limit)
    return out


class _Along(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, shape: Tensor, delta: Tensor, limit: float) -> Any:
        tau, left, weights = _absorbed(shape[..., 0].contiguous(), delta, limit)
        seen = torch.empty(shape.shape[0], shape.shape[2] - 1)
        kernels.seen(weights.numpy(), shape.numpy(), seen.numpy())
        ctx.save_for_backward(tau, left, weights, shape)
        ctx.set_materialize_grads(False)
        return weights, seen

    @staticmethod
    def backward(ctx: Any, g_weights: Tensor | None, g_seen: Tensor | None) -> Any:
        tau, left, weights, shape = ctx.saved_tensors
        out = torch.empty_like(shape)
        if g_seen is None:
            g_seen = torch.zeros(shape.shape[0], shape.shape[2] - 1)
        kernels.seen_back(
            weights.numpy(), left.numpy(), tau.numpy(), shape.numpy(), g_seen.contiguous().numpy(),
            NOTHING if g_weights is None else g_weights.contiguous().numpy(), out.numpy(),
        )  # fmt: skip
        return out, None, None


def along_rays(shape: Tensor, delta: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """The weights ``(R, S)`` of samples and their weighted features ``(R, C-1)``.

    ``shape`` ``(R, S, C)``: log density first (at most ``limit``), then features; ``delta`` ``(R, S)``.
    """
    weights, seen = _Along.apply(shape, delta, limit)
    return weights, seen


class _OuterBound(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, proposed: Tensor, edges: Tensor, weights: Tensor, eps: float) -> Tensor:
        gradient = torch.empty_like(proposed)
        total = kernels.outer_bound(
            edges.numpy(), weights.numpy(), proposed.numpy(), np.float32(eps), gradient.numpy()
        )
        ctx.save_for_backward(gradient)
        return torch.tensor(total / proposed.shape[0], dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> Any:
        (gradient,) = ctx.saved_tensors
        return gradient * (g / gradient.shape[0]), None, None, None


def proposal_loss(edges: Tensor, weights: Tensor, proposed: Tensor, eps: float = 1e-7) -> Tensor:
    """As :func:`pipeline.field.losses.proposal_loss`."""
    out: Tensor = _OuterBound.apply(proposed.contiguous(), edges, weights.detach(), eps)
    return out


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, half: bool, learns: bool, *weights: Tensor) -> Tensor:
        kind = torch.bfloat16 if half else x.dtype
        x, w_in, b_in, w_out, b_out, w_skip = (part.to(kind) for part in (x, *weights))
        blocks = _blocks(x)
        hidden = x.new_empty(x.shape[0] if learns else blocks[0].stop, w_in.shape[0])
        out = x.new_empty(x.shape[0], w_out.shape[0])
        for rows in blocks:
            inside = hidden[rows] if learns else hidden[: rows.stop - rows.start]
            torch.addmm(b_in, x[rows], w_in.t(), out=inside).relu_()
            torch.addmm(b_out, inside, w_out.t(), out=out[rows]).addmm_(x[rows], w_skip.t())
        ctx.save_for_backward(x, hidden, w_in, w_out, w_skip)
        return out.float()

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> Any:
        x, hidden, w_in, w_out, w_skip = ctx.saved_tensors
        low = g.to(x.dtype)
        g_hidden, g_x = torch.empty_like(hidden), torch.empty_like(x)
        for rows in _blocks(x):
            inside = torch.mm(low[rows], w_out, out=g_hidden[rows])
            torch.ops.aten.threshold_backward.grad_input(inside, hidden[rows], 0, grad_input=inside)
            torch.mm(inside, w_in, out=g_x[rows]).addmm_(low[rows], w_skip)
        g_in, g_out, g_skip = g_hidden.t() @ x, low.t() @ hidden, low.t() @ x
        sums = (low.new_ones(1, low.shape[0]) @ g_hidden)[0].float(), g.sum(0)
        weights = g_in.float(), sums[0], g_out.float(), sums[1], g_skip.float()
        return g_x.float(), None, None, *weights


def _blocks(x: Tensor) -> list[slice]:
    """Runs of points that are taken at a time; of bfloat16 numbers, which were not measured so, all at once."""
    count = x.shape[0]
    size = BLOCK if x.dtype == torch.float32 else max(count, 1)
    return [slice(first, min(first + size, count)) for first in range(0, max(count, 1), size)]


def shape_network(x: Tensor, half: bool, *weights: Tensor) -> Tensor:
    """One hidden layer beside a linear map: ``(N, C)`` from ``x`` ``(N, F)``.

    ``weights``: hidden layer and bias, output layer and bias, and the linear map's weights. With
    ``half`` the products are those of bfloat16 numbers, which newer processors multiply several
    times faster.
    """
    out: Tensor = _Network.apply(x, half, torch.is_grad_enabled(), *weights)
    return out
