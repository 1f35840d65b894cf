"""What the detector learns from: pools of rainy pictures with their true coverage, and crops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

# Any pixel with more water than this counts as a drop: faintly wet pixels spoil a fit as well.
VISIBLE_COVERAGE = 0.05
# Where the map is cut to find those pixels; see `wetness`.
MAP_THRESHOLD = 0.3
# |rainy - clean| beyond this is a drop in a pair of photos, as in Qian et al. (CVPR 2018).
PAIR_DIFFERENCE = 30 / 255


@dataclass(frozen=True)
class Pool:
    """Rainy pictures, the same without drops, and how much of each pixel is water.

    rainy, clean: sequences of (H,W,3) uint8 RGB; coverage: of (H,W) uint8, 255 = all water.
    clean may be empty: then the pool gives no dry crops. share: how often crops are drawn from
    this pool, relative to the others.
    """

    rainy: Sequence[np.ndarray]
    clean: Sequence[np.ndarray]
    coverage: Sequence[np.ndarray]
    share: float = 1.0


def wetness(coverage: Tensor) -> Tensor:
    """The map that the network learns, from soft coverage in [0,1]: min(1, 6 coverage).

    It saturates early because what matters is whether there is any visible water: a map cut at
    0.3 marks coverage above 0.05, and the blurred rim of a drop weighs like its core.
    """
    return (coverage * (MAP_THRESHOLD / VISIBLE_COVERAGE)).clamp(0, 1)


def coverage_of_pair(rainy: np.ndarray, clean: np.ndarray) -> np.ndarray:
    """Coverage (H,W) uint8, 0 or 255, of a photo pair: where any channel differs by more than 30.

    rainy, clean: (H,W,3) uint8 of one size. Both are smoothed over 3x3 pixels first, so that
    sensor noise does not count as water. Source: Qian et al., CVPR 2018, section 4.1.
    """
    if rainy.shape != clean.shape:
        raise ValueError(f"a pair differs in size: {rainy.shape} and {clean.shape}")
    smooth = [cv2.blur(image.astype(np.float32) / 255, (3, 3)) for image in (rainy, clean)]
    differs = np.abs(smooth[0] - smooth[1]).max(axis=2) > PAIR_DIFFERENCE
    return np.where(differs, 255, 0).astype(np.uint8)


def draw_batch(
    pools: Sequence[Pool], rng: np.random.Generator, batch: int, crop: int, clean_share: float
) -> tuple[Tensor, Tensor]:
    """A batch of augmented crops: (N,3,crop,crop) BGR in [0,1] and (N,1,crop,crop) coverage.

    clean_share: the part of the crops that show no drop at all.
    """
    shares = np.array([pool.share for pool in pools], np.float64)
    pairs = [
        _draw(pools[rng.choice(len(pools), p=shares / shares.sum())], rng, crop, clean_share)
        for _ in range(batch)
    ]
    images = np.stack([image[..., ::-1].transpose(2, 0, 1) for image, _ in pairs])
    coverage = np.stack([cover[None] for _, cover in pairs])
    return torch.from_numpy(np.ascontiguousarray(images)), torch.from_numpy(coverage)


def _draw(
    pool: Pool, rng: np.random.Generator, crop: int, clean_share: float
) -> tuple[np.ndarray, np.ndarray]:
    index = int(rng.integers(len(pool.rainy)))
    dry = len(pool.clean) > 0 and rng.random() < clean_share
    source = (pool.clean if dry else pool.rainy)[index]
    cover = pool.coverage[index]
    size = min(_window(rng, crop), *cover.shape)
    places = [(_offset(rng, cover.shape[0], size), _offset(rng, cover.shape[1], size))]
    if rng.random() < 0.5:  # half of the crops: the wetter one of two places
        places.append((_offset(rng, cover.shape[0], size), _offset(rng, cover.shape[1], size)))
    wet = [int(cover[y : y + size : 4, x : x + size : 4].sum()) for y, x in places]
    y, x = places[int(np.argmax(wet))]
    image = source[y : y + size, x : x + size].astype(np.float32) / 255
    part = cover[y : y + size, x : x + size].astype(np.float32) / 255
    if dry:
        part = np.zeros_like(part)
    if size != crop:
        how = cv2.INTER_AREA if size > crop else cv2.INTER_LINEAR
        image, part = (cv2.resize(a, (crop, crop), interpolation=how) for a in (image, part))
    if rng.random() < 0.5:
        image, part = image[:, ::-1], part[:, ::-1]
    return _photographed(image, rng), np.ascontiguousarray(part)


def _window(rng: np.random.Generator, crop: int) -> int:
    """How many pixels a crop takes from the picture: half of them at another scale."""
    if rng.random() < 0.5:
        return crop
    return round(crop * float(np.exp(rng.uniform(np.log(0.7), np.log(1.8)))))


def _offset(rng: np.random.Generator, length: int, size: int) -> int:
    return int(rng.integers(length - size + 1))


def _photographed(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The image with other exposure, contrast, colour cast and noise, in [0,1]."""
    if rng.random() < 0.1:
        image = image[..., rng.permutation(3)]
    if rng.random() < 0.7:
        image = np.power(np.clip(image, 0, 1), np.exp(rng.uniform(-0.35, 0.35)))
        image = image * np.exp(rng.normal(0, 0.12) + rng.normal(0, 0.04, 3))
        image = (image - 0.5) * np.exp(rng.normal(0, 0.1)) + 0.5
    if rng.random() < 0.5:
        image = image + rng.normal(0, rng.uniform(0, 0.02), image.shape)
    return np.clip(image, 0, 1).astype(np.float32)
