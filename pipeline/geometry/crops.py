"""Crops cut out of pictures that lie on the computing device, a whole batch at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

WET_GRID = 16  # points per side at which the water of a window is looked up


class WetPictures(Protocol):
    """Rainy pictures, the same without drops, and their water, for crops drawn with a share."""

    @property
    def rainy(self) -> Sequence[np.ndarray]: ...
    @property
    def clean(self) -> Sequence[np.ndarray]: ...
    @property
    def coverage(self) -> Sequence[np.ndarray]: ...
    @property
    def share(self) -> float: ...


@dataclass(frozen=True)
class Stack:
    """Pictures of one size on one device: pixels (N,H,W,C) uint8, the water in the last channel.

    share: how often crops are drawn from this stack, relative to the others.
    """

    pixels: Tensor
    share: float


def window_side(rng: np.random.Generator, crop: int, zoom: tuple[float, float]) -> int:
    """How many pixels a crop takes from its picture: half of them at another scale, within `zoom`."""
    if rng.random() < 0.5:
        return crop
    return round(crop * float(np.exp(rng.uniform(*np.log(zoom)))))


def resident(pools: Sequence[WetPictures], device: str) -> list[Stack]:
    """The pools on the device; channels: rainy, clean, coverage. Every picture needs its clean one."""
    return [
        stack
        for pool in pools
        for stack in stacked([pool.rainy, pool.clean, pool.coverage], pool.share, device)
    ]


def stacked(parts: Sequence[Sequence[np.ndarray]], share: float, device: str) -> list[Stack]:
    """The pictures on the device, one stack per size, and the share split by their numbers.

    parts: what belongs to a picture, each a sequence of (H,W), (H,W,3) or (T,H,W,3) uint8 arrays in the
    same order; their channels follow one another in a stack, of clips frame by frame.
    """
    groups: dict[tuple[int, ...], list[int]] = {}
    for index, first in enumerate(parts[0]):
        groups.setdefault(first.shape, []).append(index)
    stacks = []
    for chosen in groups.values():
        whole: Tensor | None = None
        for place, index in enumerate(chosen):
            joined = np.concatenate([_channels(part[index]) for part in parts], axis=2)
            if whole is None:
                whole = torch.empty((len(chosen), *joined.shape), dtype=torch.uint8)
            whole[place] = torch.from_numpy(joined)
        assert whole is not None
        stacks.append(Stack(whole.to(device), share * len(chosen) / len(parts[0])))
    return stacks


def _channels(picture: np.ndarray) -> np.ndarray:
    """(H,W,C) of (H,W), (H,W,3) or (T,H,W,3)."""
    if picture.ndim == 2:
        return picture[..., None]
    if picture.ndim == 4:
        return picture.transpose(1, 2, 0, 3).reshape(*picture.shape[1:3], -1)
    return picture


def draw_crops(
    stacks: Sequence[Stack], rng: np.random.Generator, batch: int, crop: int,
    *, zoom: tuple[float, float], second: float,
) -> Tensor:  # fmt: skip
    """Crops (N,C,crop,crop) in [0,1], half of them mirrored, half of them at another scale.

    zoom: the smallest and largest window, in parts of the crop, of those at another scale. second: the
    share of the crops that are the wetter one of two places. Crops of one stack follow one another.
    """
    shares = np.array([stack.share for stack in stacks], np.float64)
    low, high = (float(np.log(end)) for end in zoom)
    crops = []
    for stack, count in zip(stacks, rng.multinomial(batch, shares / shares.sum()), strict=True):
        half = int(rng.binomial(count, 0.5))
        if half:
            sides = np.full(half, crop)
            crops.append(_crops(stack.pixels, rng, sides, crop, second, fine=1))
        if count - half:
            sides = np.rint(crop * np.exp(rng.uniform(low, high, count - half)))
            crops.append(_crops(stack.pixels, rng, sides, crop, second, fine=2))
    return torch.cat(crops)


def _crops(
    pixels: Tensor, rng: np.random.Generator, sides: np.ndarray, crop: int, second: float, fine: int
) -> Tensor:
    height, width = pixels.shape[1:3]
    count = len(sides)
    sides = np.minimum(sides, min(height, width))
    # Two places (left, top) for each crop.
    free = np.stack([width - sides, height - sides]) + 1
    places = np.floor(rng.random((2, 2, count)) * free)
    told = np.stack([*places[0], *places[1], sides, rng.random(count) < 0.5])
    left, top, left2, top2, side, flipped = torch.from_numpy(told).to(pixels.device, torch.float32)
    index = torch.from_numpy(rng.integers(len(pixels), size=count)).to(pixels.device)
    picked = pixels[index].permute(0, 3, 1, 2).float() / 255
    for_two = torch.from_numpy(rng.random(count) < second).to(pixels.device)
    water = [
        cut(picked[:, -1:], x, y, side, flipped, WET_GRID).mean((1, 2, 3))
        for x, y in ((left, top), (left2, top2))
    ]
    other = for_two & (water[1] > water[0])
    left, top = torch.where(other, left2, left), torch.where(other, top2, top)
    found = cut(picked, left, top, side, flipped, crop * fine)
    return F.avg_pool2d(found, fine) if fine > 1 else found


def cut(
    pictures: Tensor, left: Tensor, top: Tensor, side: Tensor, flipped: Tensor, size: int
) -> Tensor:
    """Square windows (N,C,size,size) of pictures (N,C,H,W), read between pixels where need be.

    left, top, side: (N,) in pixels, of the window; flipped: (N,), 1 for windows that are mirrored.
    """
    height, width = pictures.shape[-2:]
    steps = (torch.arange(size, device=pictures.device) + 0.5) / size
    along = torch.where(flipped[:, None] > 0, 1 - steps, steps)
    x = 2 * (left[:, None] + along * side[:, None]) / width - 1
    y = 2 * (top[:, None] + steps * side[:, None]) / height - 1
    shape = (len(pictures), size, size)
    grid = torch.stack([x[:, None, :].expand(shape), y[:, :, None].expand(shape)], -1)
    return F.grid_sample(pictures, grid, padding_mode="border", align_corners=False)
