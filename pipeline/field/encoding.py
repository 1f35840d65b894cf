"""Where a field keeps what it knows: grids of features, and encodings of position and direction.

The multiresolution hash grid is that of Instant NGP (doi:10.1145/3528223.3530127). Its cost is reading
and adding to table rows at random; on a CPU both run in loops of their own (:mod:`pipeline.field.fused`),
whose twins in plain tensor operations are here, for every other device.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.field import fused, kernels
from pipeline.field.base import TableGradient
from pipeline.field.sampling import middles
from pipeline.geometry.constants import constant

HASH_PRIMES = (1, 2654435761 - 2**32, 805459861)


class RowGradient(NamedTuple):
    """A gradient of a table, not yet added up: rows, their weights and the samples' gradients.

    Without ``weights`` each sample has one row, ``(N,)``, and the weight 1.
    """

    table: str
    rows: Tensor
    weights: Tensor | None
    gradient: Tensor

    def add_to(self, total: Tensor) -> None:
        """Adds it up in ``total``, of the table's shape; on a CPU in the order of the samples."""
        if self.weights is None:
            add_single(self.rows, self.gradient, total)
        else:
            add_rows(self.rows, self.weights, self.gradient, total)


def cell_corners(x: Tensor, resolution: tuple[int, int, int], size: int) -> tuple[Tensor, Tensor]:
    """Table rows ``(N, 8)`` int32 of the corners around each point and their trilinear weights.

    ``x`` ``(3, N)`` in [0, 1]; ``resolution`` counts the grid's vertices per axis. A level whose
    vertices fit into ``size`` rows (a power of two) is indexed directly, others are hashed.
    """
    dense = math.prod(resolution) <= size
    steps = (1, resolution[0], resolution[0] * resolution[1]) if dense else HASH_PRIMES
    last = constant(tuple((r - 1.0,) for r in resolution), x)
    position = x * last
    cell = torch.minimum(position.floor_(), last - 1.0)
    upper = torch.addcmul(-cell, x, last)
    stride = constant(tuple((step,) for step in steps), x, torch.int32)
    ids = torch.stack([cell, cell + 1.0]).to(torch.int32) * stride
    shares = torch.stack([1.0 - upper, upper])
    a, b, c = ids[:, None, None, 0], ids[None, :, None, 1], ids[None, None, :, 2]
    rows = a + b + c if dense else (a ^ b ^ c) & (size - 1)
    plane = shares[:, None, 0] * shares[None, :, 1]
    weights = plane[:, :, None] * shares[None, None, :, 2]
    return rows.view(8, -1).t().contiguous(), weights.view(8, -1).t().contiguous()


def add_rows(rows: Tensor, weights: Tensor, gradient: Tensor, total: Tensor) -> None:
    """Adds ``weights[n, k] * gradient[n]`` to row ``rows[n, k]`` of ``total`` ``(size, F)``."""
    expanded = (weights[..., None] * gradient[:, None]).flatten(0, 1)
    total.index_add_(0, rows.flatten(), expanded)


class _Gather(torch.autograd.Function):
    """Weighted sums of table rows; the backward pass adds, or leaves the adding to the sink."""

    @staticmethod
    def forward(
        ctx: Any,
        table: Tensor,
        rows: Tensor,
        weights: Tensor,
        name: str,
        sink: list[TableGradient] | None,
    ) -> Tensor:
        ctx.save_for_backward(rows, weights)
        ctx.name, ctx.sink, ctx.size = name, sink, table.shape[0]
        return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        rows, weights = ctx.saved_tensors
        if ctx.sink is None:
            total = gradient.new_zeros(ctx.size, gradient.shape[1])
            add_rows(rows, weights, gradient, total)
            return total, None, None, None, None
        ctx.sink.append(RowGradient(ctx.name, rows, weights, gradient))
        return None, None, None, None, None


def gather(
    table: Tensor,
    rows: Tensor,
    weights: Tensor,
    name: str = "",
    sink: list[TableGradient] | None = None,
) -> Tensor:
    """``sum_k weights[n, k] * table[rows[n, k]]``, ``(N, F)``, differentiable in ``table``.

    With a ``sink`` the table's gradient is not formed: the rows to add go into the list, under
    ``name``, so that a fit can add up several batches at once, one table per thread.
    """
    return _Gather.apply(table, rows, weights, name, sink)


class _Pick(torch.autograd.Function):
    """Single rows of a table with one column; the gradient goes into the sink."""

    @staticmethod
    def forward(
        ctx: Any, table: Tensor, rows: Tensor, name: str, sink: list[TableGradient] | None
    ) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.name, ctx.sink, ctx.size = name, sink, table.shape[0]
        return table.view(-1).index_select(0, rows.view(-1)).view(rows.shape)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        (rows,) = ctx.saved_tensors
        flat = gradient.contiguous().view(-1)
        if ctx.sink is None:
            total = flat.new_zeros(ctx.size, 1)
            add_single(rows.view(-1), flat, total)
            return total, None, None, None
        ctx.sink.append(RowGradient(ctx.name, rows.view(-1), None, flat))
        return None, None, None, None


def pick(
    table: Tensor, rows: Tensor, name: str = "", sink: list[TableGradient] | None = None
) -> Tensor:
    """``table[rows]`` of a table ``(size, 1)``, in the shape of ``rows``; ``sink`` as for gather."""
    return _Pick.apply(table, rows, name, sink)


def add_single(rows: Tensor, gradient: Tensor, total: Tensor) -> None:
    """Adds ``gradient`` ``(N,)`` to ``total`` ``(size, 1)`` at ``rows`` ``(N,)``; on a CPU in their order."""
    if rows.device.type == "cpu":
        kernels.add_single(rows.numpy(), gradient.numpy(), total.view(-1).numpy())
    else:
        total.view(-1).index_add_(0, rows, gradient)


def nearest_rows(
    edges: Tensor, along: Tensor | None, shake: Tensor | None, sizes: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """Rows ``(R, B)`` int32 of the cells at one point in each interval, and the intervals' lengths.

    ``edges`` ``(3, R, B+1)`` in the unit cube; ``along`` ``(R, B)`` places the points (None: the
    middles), ``shake`` ``(3, R, B)`` in [0, 1] moves them by up to half a cell.
    """
    middle, delta = middles(edges)
    x = middle
    if along is not None:
        x = edges[:, :, :-1] + along * (edges[:, :, 1:] - edges[:, :, :-1])
    counts = constant(sizes, x)[:, None, None]
    place = x * counts
    if shake is not None:
        place = place + shake - 0.5
    cell = torch.minimum(place.clamp_min(0.0), counts - 1.0).to(torch.int32)
    return cell[0] + sizes[0] * (cell[1] + sizes[1] * cell[2]), delta


def level_resolutions(
    coarse: tuple[int, int, int], fine: tuple[int, int, int], levels: int
) -> list[tuple[int, int, int]]:
    """Vertices per axis of each level: a geometric sequence from coarse to fine."""
    if levels == 1:
        return [fine]
    out = []
    for level in range(levels):
        share = level / (levels - 1)
        sizes = [round(c * (f / c) ** share) for c, f in zip(coarse, fine, strict=True)]
        out.append((sizes[0], sizes[1], sizes[2]))
    return out


class HashGrid(nn.Module):
    """Features ``(N, levels * features)`` of points ``(3, N)`` in [0, 1], at several resolutions.

    ``size_log2`` bounds the rows of a level's table. Deterministic for a given generator.
    """

    def __init__(
        self,
        resolutions: list[tuple[int, int, int]],
        features: int,
        size_log2: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.resolutions = resolutions
        self.sizes = [min(2**size_log2, _power_of_two(math.prod(r))) for r in resolutions]
        self.tables = nn.ParameterList(
            nn.Parameter(torch.empty(size, features).uniform_(-1e-4, 1e-4, generator=generator))
            for size in self.sizes
        )

    def forward(
        self,
        x: Tensor,
        prefix: str = "",
        sink: list[TableGradient] | None = None,
        fast: bool = False,
    ) -> Tensor:
        """``sink`` as for :func:`gather`; ``fast``: in loops of its own, on a CPU."""
        names = [f"{prefix}tables.{level}" for level in range(len(self.tables))]
        if fast:
            return fused.grid_features(x, names, self.resolutions, list(self.tables), sink)
        parts = []
        for name, table, resolution in zip(names, self.tables, self.resolutions, strict=True):
            rows, weights = cell_corners(x, resolution, table.shape[0])
            parts.append(gather(table, rows, weights, name, sink))
        return torch.cat(parts, dim=1)


def _power_of_two(count: int) -> int:
    return 1 << max(0, (count - 1).bit_length())


def spherical_harmonics(directions: Tensor) -> Tensor:
    """The nine real spherical harmonics up to degree 2, ``(R, 9)``, of directions ``(3, R)``."""
    x, y, z = (directions / torch.linalg.vector_norm(directions, dim=0)).unbind(0)
    return torch.stack(
        [
            torch.full_like(x, 0.28209479),
            0.48860251 * y,
            0.48860251 * z,
            0.48860251 * x,
            1.09254843 * x * y,
            1.09254843 * y * z,
            0.31539157 * (3.0 * z * z - 1.0),
            1.09254843 * x * z,
            0.54627422 * (x * x - y * y),
        ],
        dim=1,
    )


def positional_encoding(x: Tensor, frequencies: int) -> Tensor:
    """``(x, sin(2^k x), cos(2^k x))`` for k below ``frequencies``: ``(N, C)`` to ``(N, C(1+2k))``.

    NeRF, doi:10.1145/3503250, eq. 4, without its factor pi and with x itself, as its code has it.
    """
    parts = [x]
    for k in range(frequencies):
        parts += [torch.sin(x * 2.0**k), torch.cos(x * 2.0**k)]
    return torch.cat(parts, dim=-1)
