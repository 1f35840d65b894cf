"""The fast field: a hash grid, a small network, and a proposal grid that finds the surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pipeline.field import fused
from pipeline.field.base import Part, Rays, Rendering, TableGradient
from pipeline.field.encoding import (
    HashGrid,
    level_resolutions,
    nearest_rows,
    pick,
    spherical_harmonics,
)
from pipeline.field.losses import distortion_loss, masked_photometric_loss, proposal_loss
from pipeline.field.sampling import (
    depth_at,
    intervals_around,
    invert_histogram,
    middles,
    stratified,
)
from pipeline.field.volume import composite, render_weights
from pipeline.geometry.spaces import Space

SHAPE_OUTPUTS = 16
MAX_LOG_DENSITY = 12.0


@dataclass(frozen=True)
class GridConfig:
    """Sizes of the fast field; what a fitted file has to repeat to be read back."""

    levels: int = 4
    features: int = 8
    table_log2: int = 17
    coarse: tuple[int, int, int] = (24, 18, 16)
    fine: tuple[int, int, int] = (512, 384, 128)
    hidden: int = 64
    samples: int = 8
    bins: int = 24
    proposal: tuple[int, int, int] = (64, 48, 48)
    distortion: float = 0.0
    trim: float = 0.0
    decay: float = 0.0
    half: bool = False


class Phase(NamedTuple):
    """What a step does beside fitting colours: learns where surfaces are, leaves out the rays farthest off."""

    learn_proposal: bool
    trimmed: bool


class Noise(NamedTuple):
    """The random numbers of a step that teaches the proposal, in [0, 1].

    Where in each bin ``(R, B)`` and how far off ``(3, R, B)`` it is asked. Half a cell off: on average
    the nearest cell is the trilinear mixture.
    """

    in_bin: Tensor
    shake: Tensor


class Shaded(NamedTuple):
    """``rgb`` ``(R, 3)``, ``weights`` ``(R, S)`` of the intervals between ``edges`` ``(R, S+1)`` and their
    lengths ``delta`` ``(R, S)`` in the unit cube; ``shape`` ``(R, S, 16)``: log density first."""

    rgb: Tensor
    weights: Tensor
    edges: Tensor
    shape: Tensor
    delta: Tensor


class GridField(nn.Module):
    """Position to density and features through the grid; features along the ray to colour.

    The features are summed along each ray first and the colour network runs once per ray, with the
    viewing direction, instead of once per sample. On a CPU the work along rays is fused
    (:mod:`pipeline.field.fused`) unless ``plain`` is set: the same within rounding.
    """

    plain = False

    def __init__(self, config: GridConfig, space: Space, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.config, self.space = config, space
        resolutions = level_resolutions(config.coarse, config.fine, config.levels)
        self.grid = HashGrid(resolutions, config.features, config.table_log2, generator)
        self.proposal = nn.Parameter(torch.zeros(_cells(config.proposal), 1))
        width = config.levels * config.features
        self.shape_in = _linear(width, config.hidden, generator)
        self.shape_out = _linear(config.hidden, SHAPE_OUTPUTS, generator)
        self.shape_skip = _linear(width, SHAPE_OUTPUTS, generator, bias=False)
        self.colour_in = _linear(SHAPE_OUTPUTS - 1 + 9, config.hidden, generator)
        self.colour_mid = _linear(config.hidden, config.hidden, generator)
        self.colour_out = _linear(config.hidden, 3, generator)

    def render(self, rays: Rays) -> Rendering:
        """See :class:`pipeline.field.base.Field`."""
        with torch.no_grad():
            out = self._shade(rays, self._propose(rays, self._bins(rays), None, None), None)
            middle = 0.5 * (out.edges[:, 1:] + out.edges[:, :-1])
            depth = depth_at((out.weights * middle).sum(-1), rays.near, rays.far)
            return Rendering(out.rgb, depth, out.weights, out.edges)

    def loss(
        self,
        rays: Rays,
        observed: Tensor,
        drop_mask: Tensor,
        step: int,
        generator: torch.Generator,
        sink: list[TableGradient],
        gain: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """See :class:`pipeline.field.base.Field`.

        Colours are those of :meth:`render`: samples lie where the proposal puts them, without chance.
        """
        phase, bins = self.phase(step), self._bins(rays)
        with torch.no_grad():
            guide = self._propose(rays, bins, None, None)
        out = self._shade(rays, guide, sink)
        rgb = out.rgb if gain is None else out.rgb * gain
        photometric = masked_photometric_loss(rgb, observed, drop_mask)
        total = photometric
        if phase.trimmed:
            total = masked_photometric_loss(rgb, observed, drop_mask, self.config.trim)
        if phase.learn_proposal:
            proposed = self._propose(rays, bins, self._noise(rays, generator), sink)
            bound = fused.proposal_loss if self._fused(rays) else proposal_loss
            total = total + bound(out.edges, out.weights, proposed)
        if self.config.distortion > 0.0:
            total = total + self.config.distortion * distortion_loss(out.edges, out.weights)
        return total, photometric

    def phase(self, step: int) -> Phase:
        """See :class:`pipeline.field.base.Field`."""
        return Phase(step < 200 or step % 2 == 0, self.config.trim > 0.0 and step >= 200)

    def samples_per_ray(self) -> int:
        """See :class:`pipeline.field.base.Field`."""
        return self.config.samples

    def _noise(self, rays: Rays, generator: torch.Generator) -> Noise:
        count, bins = rays.near.shape[0], self.config.bins
        if self._fused(rays):
            drawn = fused.first_uniform(generator, 4 * count * bins)
        else:
            drawn = torch.rand(4 * count * bins, generator=generator, device=rays.near.device)
        drawn = drawn.view(4, count, bins)
        return Noise(drawn[0], drawn[1:])

    def parts(self) -> list[Part]:
        """See :class:`pipeline.field.base.Field`."""
        betas, decay = (0.9, 0.99), self.config.decay
        tables = [
            Part(f"grid.tables.{i}", (f"grid.tables.{i}",), 4e-2, 0.03, betas, 1e-15, 50, decay)
            for i in range(len(self.grid.tables))
        ]
        head = tuple(
            name for name, _ in self.named_parameters() if name.startswith(("shape", "colour"))
        )
        return [
            *tables,
            Part("proposal", ("proposal",), 1e-1, 0.1, betas, 1e-15, 50),
            Part("head", head, 1e-2, 0.03, betas, 1e-8, 50),
        ]

    def _bins(self, rays: Rays) -> Tensor:
        """Unit-cube positions ``(3, R, B+1)`` of the edges of equal bins of normalised depth."""
        edges = torch.linspace(0, 1, self.config.bins + 1, device=rays.near.device)
        return self._walk(rays, edges[None])

    def _propose(
        self, rays: Rays, edges: Tensor, noise: Noise | None, sink: list[TableGradient] | None
    ) -> Tensor:
        """The proposal's weights ``(R, B)`` between the bins' ``edges``."""
        sizes = self.config.proposal
        along, shake = (None, None) if noise is None else noise
        if self._fused(rays):
            rows, delta = fused.nearest_rows(edges, along, shake, sizes)
        else:
            rows, delta = nearest_rows(edges, along, shake, sizes)
        raw = pick(self.proposal, rows, "proposal", sink)
        if self._fused(rays):
            return fused.weights_of(raw, delta, MAX_LOG_DENSITY)
        sigma = torch.exp(raw.clamp_max(MAX_LOG_DENSITY))
        return render_weights(sigma, delta, opaque_last=True)

    def _shade(
        self,
        rays: Rays,
        proposed: Tensor,
        sink: list[TableGradient] | None,
    ) -> Shaded:
        """Colours from samples where the proposal has its weight: at equal shares of it."""
        count, samples = rays.near.shape[0], self.config.samples
        u = stratified(count, samples, None, rays.near)
        mixed = proposed + 0.01 / self.config.bins
        if self._fused(rays):
            edges = fused.drawn_edges(mixed, u)
            x, delta = fused.middles(self._walk(rays, edges))
        else:
            edges = intervals_around(invert_histogram(mixed, u))
            x, delta = middles(self._walk(rays, edges))
        features = self.grid(x.view(3, -1), "grid.", sink, fast=self._fused(rays))
        shape = self._shape(features).view(count, samples, -1)
        if self._fused(rays):
            weights, seen = fused.along_rays(shape, delta, MAX_LOG_DENSITY)
        else:
            sigma = torch.exp(shape[..., 0].clamp_max(MAX_LOG_DENSITY))
            weights = render_weights(sigma, delta, opaque_last=True)
            seen = composite(weights, shape)[:, 1:]
        hidden = torch.cat([seen, spherical_harmonics(rays.rays_d)], dim=1)
        hidden = torch.relu(self.colour_mid(torch.relu(self.colour_in(hidden))))
        rgb = torch.sigmoid(self.colour_out(hidden) + seen[:, :3])
        return Shaded(rgb, weights, edges, shape, delta)

    def _shape(self, features: Tensor) -> Tensor:
        """Log density and what the colour is made of, ``(N, 16)``.

        A linear map beside the network: the tables learn through it from the first step.
        """
        if not self.plain:
            inner, outer = self.shape_in, self.shape_out
            return fused.shape_network(
                features, self.config.half, inner.weight, inner.bias, outer.weight, outer.bias,
                self.shape_skip.weight,
            )  # fmt: skip
        hidden = torch.relu(self.shape_in(features))
        return self.shape_out(hidden) + self.shape_skip(features)

    def _fused(self, rays: Rays) -> bool:
        return rays.near.device.type == "cpu" and not self.plain

    def _walk(self, rays: Rays, s: Tensor) -> Tensor:
        """Unit-cube positions ``(3, R, K)`` of normalised depths ``(R or 1, K)`` along the rays."""
        if self._fused(rays):
            return fused.walk(self.space, *rays, s)
        t = depth_at(s, rays.near[:, None], rays.far[:, None])
        return self.space.along(rays.rays_o, rays.rays_d, t)


def _linear(inputs: int, outputs: int, generator: torch.Generator, bias: bool = True) -> nn.Linear:
    layer = nn.Linear(inputs, outputs, bias)
    with torch.no_grad():
        bound = (6.0 / inputs) ** 0.5
        layer.weight.uniform_(-bound, bound, generator=generator)
        if bias:
            layer.bias.zero_()
    return layer


def _cells(sizes: tuple[int, int, int]) -> int:
    return sizes[0] * sizes[1] * sizes[2]
