"""The fused work on a CPU gives the numbers, and the gradients, of the plain tensor operations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pipeline.field import encoding, fused, losses, sampling
from pipeline.field.base import Rays, TableGradient
from pipeline.field.encoding import HashGrid
from pipeline.field.grid_field import GridConfig, GridField
from pipeline.field.volume import composite, render_weights
from pipeline.geometry.spaces import Space

R, B, S = 60, 16, 7
NDC = Space("ndc", ((1, 0, 0, 0.1), (0, 1, 0, 0), (0, 0, 1, 0.2)), 2.0, (-1, -1, 0), (1, 1, 0.9))
BALL = Space(
    "contract", ((0.5, 0, 0, 0), (0, 0, 0.5, 0), (0, -0.5, 0, 0)), 1.0, (-2,) * 3, (2,) * 3
)
SMALL = GridConfig(
    levels=2, features=4, table_log2=10, coarse=(6, 5, 4), fine=(24, 18, 16), hidden=16, samples=S,
    bins=B, proposal=(12, 9, 8),
)  # fmt: skip


def source(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def some_rays() -> Rays:
    g = source(5)
    rays_d = torch.rand(3, R, generator=g) - 0.5
    rays_d[2] = 1.0
    near = 2.0 + torch.rand(R, generator=g)
    return Rays(0.2 * torch.rand(3, R, generator=g), rays_d, near, near * 8.0)


def taught_field(config: GridConfig, space: Space) -> GridField:
    """A field whose proposal's weights differ from bin to bin."""
    field = GridField(config, space, 0)
    with torch.no_grad():
        field.proposal.copy_(4.0 * torch.randn(field.proposal.shape, generator=source(5)))
    return field


def both(work: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """The result and the gradient of a fixed mixture of it."""
    x = x.clone().requires_grad_()
    out = work(x)
    mixture = torch.rand(out.shape, generator=source(9))
    return out.detach(), torch.autograd.grad((out * mixture).sum(), x)[0]


@pytest.mark.parametrize("space", [NDC, BALL])
@pytest.mark.parametrize("rows", [1, R])
def test_positions_along_rays(space: Space, rows: int) -> None:
    rays = some_rays()
    s = torch.sort(torch.rand(rows, S, generator=source())).values
    t = sampling.depth_at(s, rays.near[:, None], rays.far[:, None])
    plain = space.warp(rays.rays_o[:, :, None] + rays.rays_d[:, :, None] * t)
    found = fused.walk(space, *rays, s)
    torch.testing.assert_close(found, plain, atol=2e-6, rtol=0)
    assert float(found.std()) > 0.05


RESOLUTIONS = [(5, 4, 3), (17, 9, 12)]  # into 64 rows: the one indexed, the other hashed


def a_grid(features: int) -> HashGrid:
    grid = HashGrid(RESOLUTIONS, features, 6, source(1))
    with torch.no_grad():
        for table in grid.tables:
            table.uniform_(-1, 1, generator=source(2))
    return grid


@pytest.mark.parametrize("features", [1, 2, 3, 8])
@pytest.mark.parametrize("deferred", [False, True])
def test_features_of_a_grid_and_what_they_pass_back(features: int, deferred: bool) -> None:
    x = torch.rand(3, 500, generator=source())
    x[:, :3] = torch.tensor([0.0, 1.0, 0.5])
    upstream = torch.rand(500, 2 * features, generator=source(3))
    grid, results = a_grid(features), []
    for fast in (False, True):
        sink: list[TableGradient] | None = [] if deferred else None
        out = grid(x, "", sink, fast=fast)
        found = torch.autograd.grad(out, list(grid.tables), upstream, allow_unused=deferred)
        gradients = [
            torch.zeros_like(table) if g is None else g
            for table, g in zip(grid.tables, found, strict=True)
        ]
        for entry in sink or []:
            entry.add_to(gradients[int(entry.table.split(".")[-1])])
        results.append([out.detach(), *gradients])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
        assert float(one.abs().max()) > 0.1


@pytest.mark.parametrize("points", [1, 7, 8, 9])
def test_few_points_are_read_as_many_are(points: int) -> None:
    x, grid = torch.rand(3, 40, generator=source()), a_grid(8)
    expected = grid(x, fast=True)[:points]
    assert torch.equal(grid(x[:, :points].contiguous(), fast=True), expected)


def test_a_broken_fit_that_asks_for_nan_reads_and_adds_within_the_table() -> None:
    x, grid = torch.full((3, 4), float("nan")), a_grid(2)
    out = grid(x, fast=True)
    assert bool(out.isnan().all())
    for gradient in torch.autograd.grad(out.sum(), list(grid.tables)):
        assert 1 <= int(gradient.isnan().any(1).sum()) <= 8  # none: they went elsewhere


@pytest.mark.parametrize("random", [True, False])
def test_rows_of_the_proposal(random: bool) -> None:
    edges = torch.sort(torch.rand(3, R, B + 1, generator=source())).values
    along = torch.rand(R, B, generator=source(1)) if random else None
    shake = torch.rand(3, R, B, generator=source(2)) if random else None
    rows, delta = fused.nearest_rows(edges, along, shake, (12, 9, 8))
    expected, lengths = encoding.nearest_rows(edges, along, shake, (12, 9, 8))
    # A point on the border between two cells may fall to either side by rounding.
    assert int((rows != expected).sum()) <= 2
    torch.testing.assert_close(delta, lengths)


def test_edges_drawn_from_a_histogram() -> None:
    weights = torch.rand(R, B, generator=source()) ** 4
    weights[0] = 0.0
    weights[1, :-1] = 0.0
    u = sampling.stratified(R, S, source(1), weights)
    plain = sampling.intervals_around(sampling.invert_histogram(weights, u))
    torch.testing.assert_close(fused.drawn_edges(weights, u), plain, atol=2e-5, rtol=0)
    x, delta = fused.middles(torch.stack([plain, 2 * plain, 0 * plain]))
    expected = 0.5 * (plain[:, 1:] + plain[:, :-1])
    torch.testing.assert_close(x, torch.stack([expected, 2 * expected, 0 * expected]))
    torch.testing.assert_close(delta, 5**0.5 * (plain[:, 1:] - plain[:, :-1]))


def test_weights_and_features_along_rays() -> None:
    shape = torch.randn(R, S, 5, generator=source())
    shape[0, 2, 0] = 20.0  # at the limit: no gradient
    delta = torch.rand(R, S, generator=source(1))

    def plain(shape: Tensor) -> Tensor:
        sigma = torch.exp(shape[..., 0].clamp_max(12.0))
        weights = render_weights(sigma, delta, opaque_last=True)
        return torch.cat([weights, composite(weights, shape)[:, 1:]], 1)

    def quick(shape: Tensor) -> Tensor:
        return torch.cat(fused.along_rays(shape, delta, 12.0), 1)

    for one, other in zip(both(plain, shape), both(quick, shape), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)
    for one, other in zip(
        both(lambda raw: plain(raw[..., None])[:, :S], shape[..., 0]),
        both(lambda raw: fused.weights_of(raw, delta, 12.0), shape[..., 0]),
        strict=True,
    ):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_the_loss_of_the_proposal() -> None:
    edges = torch.sort(torch.rand(R, S + 1, generator=source())).values
    weights = torch.rand(R, S, generator=source(1)) / S
    proposed = torch.rand(R, B, generator=source(2)) / B
    for one, other in zip(
        both(lambda p: losses.proposal_loss(edges, weights, p), proposed),
        both(lambda p: fused.proposal_loss(edges, weights, p), proposed),
        strict=True,
    ):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize(
    ("half", "close", "points"),
    [(True, 3e-2, 200)]
    + [(False, 1e-5, points) for points in (0, 1, 200, fused.BLOCK, 2 * fused.BLOCK + 3)],
)
def test_the_shape_network(half: bool, close: float, points: int) -> None:
    g = source()
    x = torch.randn(points, 6, generator=g)
    sizes = ((8, 6), (8,), (4, 8), (4,), (4, 6))
    weights = [torch.randn(size, generator=g) for size in sizes]

    def plain(x: Tensor, weights: list[Tensor]) -> Tensor:
        inner, inner_bias, outer, outer_bias, skip = weights
        hidden = torch.relu(x @ inner.t() + inner_bias)
        return hidden @ outer.t() + outer_bias + x @ skip.t()

    def gradients(work: Callable[..., Tensor]) -> list[Tensor]:
        leaves = [part.clone().requires_grad_() for part in (x, *weights)]
        out = work(leaves[0], leaves[1:])
        return [out.detach(), *torch.autograd.grad(out.square().sum(), leaves)]

    expected = gradients(plain)
    found = gradients(lambda x, weights: fused.shape_network(x, half, *weights))
    for one, other in zip(expected, found, strict=True):
        assert one.dtype == other.dtype == torch.float32
        assert float((one - other).norm()) <= close * float(one.norm())
    with torch.no_grad():  # where nothing learns, what is between input and output is not kept
        assert torch.equal(fused.shape_network(x, half, *weights), found[0])


@pytest.mark.parametrize("step", [0, 200])
@pytest.mark.parametrize("space", [NDC, BALL])
def test_a_whole_step(space: Space, step: int) -> None:
    """The same losses and gradients; rays farthest off are left out of the later step alone."""
    rays = some_rays()
    observed, none = torch.rand(R, 3, generator=source(3)), torch.zeros(R)
    results = []
    for plain in (True, False):
        field = taught_field(replace(SMALL, distortion=0.1, trim=0.3), space)
        field.plain = plain
        sink: list[TableGradient] = []
        loss, _ = field.loss(rays, observed, none, step, source(4), sink)
        assert field.phase(step).trimmed == (step == 200)
        named = dict(field.named_parameters())
        found = torch.autograd.grad(loss, list(named.values()), allow_unused=True)
        gradients = {n: g for n, g in zip(named, found, strict=True) if g is not None}
        for entry in sink:
            total = gradients.setdefault(entry.table, torch.zeros_like(named[entry.table]))
            entry.add_to(total)
        results.append((loss.detach(), gradients, field.render(rays)))
    (loss, gradients, view), (same_loss, same_gradients, same_view) = results
    torch.testing.assert_close(loss, same_loss)
    assert set(gradients) == set(same_gradients) == set(named)
    for name, gradient in gradients.items():
        off = (gradient - same_gradients[name]).norm() / gradient.norm()
        assert float(off) < 1e-2, name  # a unit near zero may be on in one and off in the other
    for one, other in zip(view, same_view, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("plain", [True, False])
def test_what_a_step_fits_is_what_is_rendered_whatever_the_seed(plain: bool) -> None:
    """Chance moves where the proposal learns, never where a colour is asked for."""
    rays, observed, none = some_rays(), torch.rand(R, 3, generator=source(3)), torch.zeros(R)
    field = taught_field(SMALL, NDC)
    field.plain = plain
    want = losses.masked_photometric_loss(field.render(rays).rgb, observed, none)
    taught = []
    for seed in (1, 2):
        sink: list[TableGradient] = []
        loss, photometric = field.loss(rays, observed, none, 0, source(seed), sink)
        torch.testing.assert_close(photometric.detach(), want, atol=0, rtol=1e-6)
        loss.backward()
        entries = [entry for entry in sink if entry.table == "proposal"]
        taught.append(torch.zeros_like(field.proposal))
        for entry in entries:
            entry.add_to(taught[-1])
    assert not torch.equal(*taught)


@pytest.mark.parametrize("seed", [0, 7, 64 * 1_000_003, 2**40 + 7])
@pytest.mark.parametrize("count", [1, 15, 624, 625, 50_000])
def test_the_first_numbers_are_those_of_torch(seed: int, count: int) -> None:
    """In however many calls torch draws them; a generator that has drawn gives its first ones again."""
    generator = source(seed)
    want = torch.cat([torch.rand(n, generator=generator) for n in (count // 3, count - count // 3)])
    assert torch.equal(fused.first_uniform(generator, count), want)
