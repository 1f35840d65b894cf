"""Crops to learn from, cut and altered on the computing device: what `samples` and `lures` do, by batches.

Draws come in other orders, so that one seed gives other crops; what is drawn, and what becomes of a picture
by the same draws, is the same but for borders and the rims of lights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from pipeline.attention.lures import CLIPPED, GAMMA
from pipeline.attention.samples import SEEN_DIFFERENCE, UNSEEN_WEIGHT, ZOOM
from pipeline.geometry.crops import Stack, draw_crops


def draw_resident(
    stacks: Sequence[Stack], rng: np.random.Generator, batch: int, crop: int, clean_share: float,
    lures: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """As `samples.draw_batch`, from pictures on the device; the crops are left there."""
    device = stacks[0].pixels.device
    noise = torch.Generator(device).manual_seed(int(rng.integers(2**63)))
    crops = draw_crops(stacks, rng, batch, crop, zoom=ZOOM, second=0.5)
    rainy, clean, cover = crops[:, :3], crops[:, 3:6], crops[:, 6:7]
    dry = rng.random(batch) < clean_share
    is_dry = torch.from_numpy(dry).to(device)[:, None, None, None]
    weight = torch.where(is_dry, 1.0, visibility(rainy, clean, cover))
    image, cover = torch.where(is_dry, clean, rainy), torch.where(is_dry, 0.0, cover)
    for k in np.nonzero(dry & (rng.random(batch) < lures))[0]:
        image[k] = lure(image[k], rng)
    return photographed(image, rng, noise).flip(1), cover, weight


def visibility(rainy: Tensor, clean: Tensor, coverage: Tensor) -> Tensor:
    """Weight (N,1,H,W) in the loss; see `samples.visibility`."""
    change = (rainy - clean).abs().amax(1, keepdim=True)
    change = F.avg_pool2d(change, 5, 1, 2, count_include_pad=False)
    return torch.where((coverage > 0) & (change < SEEN_DIFFERENCE), UNSEEN_WEIGHT, 1.0)


def lure(image: Tensor, rng: np.random.Generator) -> Tensor:
    """A dry picture (3,H,W) in [0,1] that is easily taken for a wet one; see `lures.lure`."""
    kind = rng.random()
    if kind < 0.25:
        gain = float(np.exp(rng.uniform(np.log(1.3), np.log(3.0))))
        return (image * gain ** (1 / GAMMA)).clamp(max=1)
    radius = float(np.exp(rng.uniform(np.log(1.5), np.log(12.0))))
    if kind < 0.4:
        return defocused(at_night(image, rng), radius)
    blurred = defocused(image, radius)
    if rng.random() < 0.4:
        return blurred
    return torch.lerp(blurred, image, _subject(image, rng))


def defocused(image: Tensor, radius: float) -> Tensor:
    """The picture (3,H,W) in [0,1] through a lens out of focus; see `lures.defocused`."""
    light = image.clamp(0, 1) ** GAMMA
    over = ((image.amin(0, keepdim=True) - CLIPPED) / (1 - CLIPPED)).clamp(0, 1)
    half = int(np.ceil(radius))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    disc = np.clip(radius + 0.5 - np.hypot(y, x), 0, 1)
    kernel = torch.from_numpy(disc / disc.sum()).to(image)[None, None]
    wide = F.pad((light * (1 + 3 * over))[:, None], [half] * 4, mode="reflect")
    return F.conv2d(wide, kernel)[:, 0].clamp(0, 1) ** (1 / GAMMA)


def at_night(image: Tensor, rng: np.random.Generator) -> Tensor:
    """The picture (3,H,W) darkened, with small lights in a few colours; see `lures.at_night`."""
    height, width = image.shape[1:]
    count = int(rng.integers(4, 30))
    at = rng.random((2, count)) * [[height], [width]]
    colour = np.clip(rng.uniform(0.5, 1.6, count) * (1 + rng.normal(0, 0.2, (3, count))), 0, 1)
    told = np.concatenate([at, rng.integers(1, 4, (1, count)), colour])
    rows, columns, radius, *colours = torch.from_numpy(told).to(image)
    y = torch.arange(height, device=image.device)[:, None, None] - rows
    x = torch.arange(width, device=image.device)[:, None] - columns
    strongest, which = (radius + 0.5 - torch.hypot(y, x)).clamp(0, 1).max(2)
    lit = torch.stack(colours)[:, which]
    return torch.lerp(image * float(rng.uniform(0.15, 0.5)), lit, strongest)


def _subject(image: Tensor, rng: np.random.Generator) -> Tensor:
    """1 where the picture is in focus, falling softly to 0; see `lures._subject`."""
    height, width = image.shape[1:]
    place = rng.uniform(0.2, 0.8, 2)
    y = torch.arange(height, device=image.device)[:, None] / max(height, width) - place[0]
    x = torch.arange(width, device=image.device) / max(height, width) - place[1]
    angle = rng.uniform(0, 2 * np.pi)
    inside = x * np.cos(angle) + y * np.sin(angle)
    if rng.random() < 0.5:
        inside = rng.uniform(0.15, 0.4) - torch.hypot(x, y)
    return (0.5 + inside / rng.uniform(0.02, 0.3)).clamp(0, 1)


def photographed(image: Tensor, rng: np.random.Generator, noise: torch.Generator) -> Tensor:
    """The pictures (N,3,H,W) with other exposure, contrast, colour cast, sharpness and noise, in [0,1]."""
    batch = len(image)
    order = np.tile(np.arange(3), (batch, 1))
    for k in np.nonzero(rng.random(batch) < 0.1)[0]:
        order[k] = rng.permutation(3)
    picked = torch.from_numpy(order).to(image.device)[:, :, None, None].expand_as(image)
    changed = (rng.random(batch) < 0.7)[:, None]
    gamma = np.exp(rng.uniform(-0.35, 0.35, (batch, 1)) * changed)
    gain = np.exp((rng.normal(0, 0.12, (batch, 1)) + rng.normal(0, 0.04, (batch, 3))) * changed)
    contrast = np.exp(rng.normal(0, 0.1, (batch, 1)) * changed)
    spread = rng.uniform(0, 0.03, (batch, 1)) * (rng.random((batch, 1)) < 0.5)
    told = torch.from_numpy(np.hstack([gamma, gain, contrast, spread])).to(image)[..., None, None]
    image = image.gather(1, picked).clamp(0, 1) ** told[:, :1] * told[:, 1:4]
    image = (image - 0.5) * told[:, 4:5] + 0.5
    image = _softened(image, rng)
    grain = torch.randn(image.shape, generator=noise, device=image.device)
    return (image + told[:, 5:6] * grain).clamp(0, 1)


def _softened(image: Tensor, rng: np.random.Generator) -> Tensor:
    """A quarter of the pictures through a soft lens."""
    batch = len(image)
    sigma = np.where(rng.random(batch) < 0.25, rng.uniform(0.4, 1.1, batch), 1e-3)
    bell = np.exp(-0.5 * (np.arange(-3, 4) / sigma[:, None]) ** 2)
    bell = np.repeat(bell / bell.sum(1, keepdims=True), 3, axis=0)
    kernel = torch.from_numpy(bell).to(image)[:, None, None]
    flat = F.pad(image.flatten(0, 1)[None], [3] * 4, mode="replicate")
    flat = F.conv2d(flat, kernel, groups=3 * batch)
    return F.conv2d(flat, kernel.transpose(2, 3), groups=3 * batch)[0].view_as(image)
