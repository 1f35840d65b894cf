"""The paper's own field: NeRF's two networks and hierarchical samples (doi:10.1145/3503250)."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pipeline.field.base import Part, Rays, Rendering, TableGradient
from pipeline.field.encoding import positional_encoding
from pipeline.field.losses import masked_photometric_loss
from pipeline.field.sampling import depth_at, invert_pieces, stratified
from pipeline.field.volume import composite, render_weights
from pipeline.geometry.spaces import Space

FAR_AWAY = 1e10


@dataclass(frozen=True)
class PaperConfig:
    """The paper's settings, and those of the NeRF code that it builds on."""

    layers: int = 8
    width: int = 256
    skip: int = 4
    position_frequencies: int = 10
    direction_frequencies: int = 4
    coarse_samples: int = 64
    fine_samples: int = 64
    density_noise: float = 1.0
    rate: float = 5e-4
    final_rate: float = 5e-5
    half: bool = False


class PaperNetwork(nn.Module):
    """Encoded position and direction to raw density and colour: eight layers, one skip."""

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.config = config
        place = 3 + 6 * config.position_frequencies
        view = 3 + 6 * config.direction_frequencies
        inputs = [place] + [
            config.width + (place if layer == config.skip else 0)
            for layer in range(config.layers - 1)
        ]
        self.trunk = nn.ModuleList(nn.Linear(size, config.width) for size in inputs)
        self.density = nn.Linear(config.width, 1)
        self.feature = nn.Linear(config.width, config.width)
        self.view = nn.Linear(config.width + view, config.width // 2)
        self.rgb = nn.Linear(config.width // 2, 3)

    def forward(self, x: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Raw density ``(N,)`` and colour ``(N, 3)`` of points in [-1, 1] seen along unit rows."""
        place = positional_encoding(x, self.config.position_frequencies)
        h = place
        for number, layer in enumerate(self.trunk):
            h = torch.relu(layer(h))
            if number == self.config.skip:
                h = torch.cat([place, h], dim=-1)
        view = positional_encoding(directions, self.config.direction_frequencies)
        seen = torch.relu(self.view(torch.cat([self.feature(h), view], dim=-1)))
        return self.density(h).squeeze(-1), self.rgb(seen)


class PaperField(nn.Module):
    """A coarse network that places the samples of a fine one."""

    def __init__(self, config: PaperConfig, space: Space, seed: int) -> None:
        super().__init__()
        self.config, self.space = config, space
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.coarse = PaperNetwork(config)
            self.fine = PaperNetwork(config)

    def render(self, rays: Rays) -> Rendering:
        """See :class:`pipeline.field.base.Field`."""
        with torch.no_grad():
            return self._trace(rays, None)[1]

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
        """The sum of both networks' photometric losses; the fine one's alone beside it."""
        coarse, fine = (one.rgb for one in self._trace(rays, generator))
        if gain is not None:
            coarse, fine = coarse * gain, fine * gain
        photometric = masked_photometric_loss(fine, observed, drop_mask)
        return photometric + masked_photometric_loss(coarse, observed, drop_mask), photometric

    def phase(self, step: int) -> Hashable:
        """See :class:`pipeline.field.base.Field`."""
        return 0

    def samples_per_ray(self) -> int:
        """See :class:`pipeline.field.base.Field`."""
        return self.config.coarse_samples + self.config.fine_samples

    def parts(self) -> list[Part]:
        """See :class:`pipeline.field.base.Field`."""
        names = tuple(name for name, _ in self.named_parameters())
        return [Part("all", names, self.config.rate, self.config.final_rate / self.config.rate)]

    def _trace(self, rays: Rays, generator: torch.Generator | None) -> tuple[Rendering, Rendering]:
        count = rays.near.shape[0]
        s = stratified(count, self.config.coarse_samples, generator, rays.near)
        coarse = self._shade(self.coarse, rays, s, generator)
        middle = 0.5 * (s[:, 1:] + s[:, :-1])
        u = stratified(count, self.config.fine_samples, generator, rays.near)
        more = invert_pieces(middle, coarse.weights[:, 1:-1].detach(), u)
        both = torch.sort(torch.cat([s, more], dim=-1), dim=-1).values
        return coarse, self._shade(self.fine, rays, both, generator)

    def _shade(
        self,
        network: PaperNetwork,
        rays: Rays,
        s: Tensor,
        generator: torch.Generator | None,
    ) -> Rendering:
        t = depth_at(s, rays.near[:, None], rays.far[:, None])
        x = self.space.along(rays.rays_o, rays.rays_d, t)
        step = x[:, :, 1:] - x[:, :, :-1]
        delta = 2.0 * step.square().sum(0).sqrt()
        delta = torch.cat([delta, torch.full_like(delta[:, :1], FAR_AWAY)], dim=-1)
        unit = (rays.rays_d / torch.linalg.vector_norm(rays.rays_d, dim=0)).t()
        directions = unit[:, None].expand(-1, s.shape[1], -1).reshape(-1, 3)
        with torch.autocast(
            s.device.type, torch.bfloat16, enabled=self.config.half, cache_enabled=False
        ):
            raw, colour = network(2.0 * x.reshape(3, -1).t() - 1.0, directions)
        raw, colour = raw.float().view(s.shape), colour.float()
        if generator is not None and self.config.density_noise > 0.0:
            noise = torch.randn(raw.shape, generator=generator, device=raw.device)
            raw = raw + noise * self.config.density_noise
        sigma = torch.relu(raw)
        weights = render_weights(sigma, delta)
        rgb = composite(weights, torch.sigmoid(colour).view(*s.shape, 3))
        with torch.no_grad():
            mean = (weights * s).sum(-1) + (1.0 - weights.sum(-1))
            depth = depth_at(mean.clamp(0.0, 1.0), rays.near, rays.far)
        edges = torch.cat([s, torch.ones_like(s[:, :1])], dim=-1)
        return Rendering(rgb, depth, weights, edges)
