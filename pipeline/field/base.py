"""What a fit and a render need of a radiance field: one small interface for every model."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class Rays(NamedTuple):
    """Rays, components first: ``rays_o``, ``rays_d`` ``(3, R)``, ``near``, ``far`` ``(R,)``.

    Directions have length 1 along their camera's optical axis: ``near`` and ``far`` are depths.
    """

    rays_o: Tensor
    rays_d: Tensor
    near: Tensor
    far: Tensor


class Rendering(NamedTuple):
    """What rays see: ``rgb`` ``(R, 3)``, ``depth`` ``(R,)`` along z, ``weights`` ``(R, S)`` of the intervals
    between ``edges`` ``(R, S+1)``.

    ``edges`` are normalised positions along the ray: 0 near, 1 far.
    """

    rgb: Tensor
    depth: Tensor
    weights: Tensor
    edges: Tensor


class TableGradient(Protocol):
    """A gradient of the parameter named ``table`` that is known by its parts, not yet added up."""

    @property
    def table(self) -> str:
        """The parameter's name."""

    def add_to(self, total: Tensor) -> None:
        """Adds it up in ``total``, of the parameter's shape, in a fixed order on a CPU."""


@dataclass(frozen=True)
class Part:
    """Parameters that are stepped together, with Adam's settings for them.

    ``rate`` falls exponentially to ``rate * final`` over the fit, after ``warmup`` steps or a twentieth
    of the fit: a short one has no more to lose. Every step shrinks the parameters by ``decay`` times the
    rate (AdamW, arXiv:1711.05101).
    """

    name: str
    parameters: tuple[str, ...]
    rate: float
    final: float
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    warmup: int = 0
    decay: float = 0.0


class Field(Protocol):
    """A radiance field: rays in, colours and depths out, and a loss to fit it by."""

    def render(self, rays: Rays) -> Rendering:
        """What the rays see, without randomness."""

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
        """The loss to descend, and the plain photometric loss (eq. 4) within it.

        ``generator`` was seeded for this call: all its random numbers are the first of that seed's.
        ``gain`` ``(R, 3)`` multiplies the rendered colours: the exposure of each ray's photo.
        """

    def phase(self, step: int) -> Hashable:
        """Steps of the same phase do the same operations, with other numbers."""

    def samples_per_ray(self) -> int:
        """How many samples a ray takes: what its memory grows with."""

    def parts(self) -> list[Part]:
        """How each parameter is to be stepped; every parameter is in one part."""
