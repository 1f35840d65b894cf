"""What the removers learn from: pairs of rainy and dry pictures, and crops of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.geometry.crops import Stack, draw_crops, window_side

# |rainy - clean| beyond this is a drop, in Qian et al. (CVPR 2018) as for all who use their pairs.
DIFFERENCE = 30 / 255
ZOOM = (0.7, 1.6)


@dataclass(frozen=True)
class Pairs:
    """Rainy pictures, the same without drops, and how much of each pixel is water.

    rainy, clean: sequences of (H,W,3), or of clips (T,H,W,3) whose drops stay where they are, uint8
    RGB; coverage: of (H,W) uint8, 255 = all water. share: how often crops are drawn from these
    pictures, relative to others.
    """

    rainy: Sequence[np.ndarray]
    clean: Sequence[np.ndarray]
    coverage: Sequence[np.ndarray]
    share: float = 1.0


class Batch(NamedTuple):
    """rainy, clean (B,T,3,H,W), red first, in [0,1], T = 1 but for clips; drops (B,T,1,H,W), 0 or 1."""

    rainy: Tensor
    clean: Tensor
    drops: Tensor


def drop_map(rainy: Tensor, clean: Tensor) -> Tensor:
    """1 where any channel differs by more than 30 of 255, else 0: (...,1,H,W) of (...,3,H,W).

    Source: Qian et al., CVPR 2018, section 4.1.
    """
    return ((rainy - clean).abs().amax(-3, keepdim=True) > DIFFERENCE).to(rainy.dtype)


def draw_batch(pools: Sequence[Pairs], rng: np.random.Generator, batch: int, crop: int) -> Batch:
    """Crops at random places, scales, sides and exposures; both partners of a pair alike.

    All pictures that one batch is drawn from must have the same number of frames.
    """
    shares = np.array([pool.share for pool in pools], np.float64)
    drawn = []
    for _ in range(batch):
        pool = pools[rng.choice(len(pools), p=shares / shares.sum())]
        index = int(rng.integers(len(pool.rainy)))
        pair = np.stack([pool.rainy[index], pool.clean[index]])
        if pair.ndim == 4:  # single pictures are clips of one frame
            pair = pair[:, None]
        drawn.append(_draw(pair, pool.coverage[index], rng, crop))
    rainy, clean = torch.from_numpy(np.stack(drawn, 1).transpose(0, 1, 2, 5, 3, 4).copy())
    return Batch(rainy, clean, drop_map(rainy, clean))


def draw_resident(
    stacks: Sequence[Stack], rng: np.random.Generator, batch: int, crop: int
) -> Batch:
    """As `draw_batch`, cut and altered on the device where the pictures lie."""
    crops = draw_crops(stacks, rng, batch, crop, zoom=ZOOM, second=1.0)
    changed = rng.random((batch, 1)) < 0.5
    gamma = np.exp(rng.uniform(-0.25, 0.25, (batch, 1)) * changed)
    gain = np.exp((rng.normal(0, 0.1, (batch, 1)) + rng.normal(0, 0.04, (batch, 3))) * changed)
    told = torch.from_numpy(np.hstack([gamma, gain])).to(crops)[:, None, :, None, None]
    pair = crops[:, :-1].unflatten(1, (-1, 3)).clamp(0, 1) ** told[:, :, :1] * told[:, :, 1:]
    rainy, clean = pair.clamp(0, 1).chunk(2, 1)
    return Batch(rainy, clean, drop_map(rainy, clean))


def _draw(pair: np.ndarray, cover: np.ndarray, rng: np.random.Generator, crop: int) -> np.ndarray:
    """A crop (2,T,crop,crop,3) in [0,1] of a pair (2,T,H,W,3) uint8 whose water is `cover` (H,W)."""
    size = min(window_side(rng, crop, ZOOM), *cover.shape)
    # Of two places the wetter one: most of a picture is dry, and there is little to learn there.
    places = [tuple(int(rng.integers(n - size + 1)) for n in cover.shape) for _ in range(2)]
    wet = [int(cover[y : y + size : 4, x : x + size : 4].sum()) for y, x in places]
    y, x = places[int(np.argmax(wet))]
    pair = pair[:, :, y : y + size, x : x + size].astype(np.float32) / 255
    if size != crop:
        how = cv2.INTER_AREA if size > crop else cv2.INTER_LINEAR
        flat = pair.reshape(-1, *pair.shape[2:])
        scaled = np.stack([cv2.resize(frame, (crop, crop), interpolation=how) for frame in flat])
        pair = scaled.reshape(*pair.shape[:2], crop, crop, 3)
    if rng.random() < 0.5:
        pair = pair[..., ::-1, :]
    if rng.random() < 0.5:  # what a camera set otherwise would have made of both
        pair = np.power(pair, np.exp(rng.uniform(-0.25, 0.25)))
        pair = pair * np.exp(rng.normal(0, 0.1) + rng.normal(0, 0.04, 3))
    return np.clip(pair, 0, 1).astype(np.float32)
