"""What the detector learns from: pools of rainy pictures with their true coverage, and crops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.attention.lures import lure
from pipeline.geometry.crops import window_side

# Any pixel with more water than this counts as a drop: faintly wet pixels spoil a fit as well.
VISIBLE_COVERAGE = 0.05
# |rainy - clean| beyond this is a drop in a pair of photos, as in Qian et al. (CVPR 2018).
PAIR_DIFFERENCE = 30 / 255
# Water that changes the picture by less than this cannot be seen, and counts for little.
SEEN_DIFFERENCE = 6 / 255
UNSEEN_WEIGHT = 0.1
# What crops at another scale take from the picture, in parts of their own size.
ZOOM = (0.6, 2.0)


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
    """The map that the network learns, from soft coverage in [0,1]: its square root.

    Faint water counts for more than in the coverage itself (0.05 becomes 0.22), but the map keeps
    telling the blurred rim of a drop from its core.
    """
    return coverage.clamp(0, 1).sqrt()


def coverage_of_pair(
    rainy: np.ndarray, clean: np.ndarray, difference: float = PAIR_DIFFERENCE
) -> np.ndarray:
    """Coverage (H,W) uint8, 0 or 255, of a photo pair: where any channel differs by more than 30.

    rainy, clean: (H,W,3) uint8 of one size; difference: in [0,1], instead of 30/255. Both are
    smoothed over 3x3 pixels first, so that sensor noise does not count as water. Source: Qian et al.,
    CVPR 2018, section 4.1.
    """
    if rainy.shape != clean.shape:
        raise ValueError(f"a pair differs in size: {rainy.shape} and {clean.shape}")
    smooth = [cv2.blur(image.astype(np.float32) / 255, (3, 3)) for image in (rainy, clean)]
    differs = np.abs(smooth[0] - smooth[1]).max(axis=2) > difference
    return np.where(differs, 255, 0).astype(np.uint8)


def draw_batch(
    pools: Sequence[Pool], rng: np.random.Generator, batch: int, crop: int, clean_share: float,
    lures: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Augmented crops: (N,3,crop,crop) BGR in [0,1], (N,1,crop,crop) coverage and weight.

    clean_share: the part of the crops that show no drop at all; lures: the part of those that are made to
    look wet, see `lure`. The weight in the loss is 1, but
    small where there is water that changes nothing.
    """
    shares = np.array([pool.share for pool in pools], np.float64)
    drawn = [
        _draw(pools[rng.choice(len(pools), p=shares / shares.sum())], rng, crop, clean_share, lures)
        for _ in range(batch)
    ]
    images = np.stack([image[..., ::-1].transpose(2, 0, 1) for image, _, _ in drawn])
    coverage = np.stack([cover[None] for _, cover, _ in drawn])
    weight = np.stack([weight[None] for _, _, weight in drawn])
    return (
        torch.from_numpy(np.ascontiguousarray(images)),
        torch.from_numpy(coverage),
        torch.from_numpy(weight),
    )


def _draw(
    pool: Pool, rng: np.random.Generator, crop: int, clean_share: float, lures: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    index = int(rng.integers(len(pool.rainy)))
    dry = len(pool.clean) > 0 and rng.random() < clean_share
    cover = pool.coverage[index]
    size = min(window_side(rng, crop, ZOOM), *cover.shape)
    places = [(_offset(rng, cover.shape[0], size), _offset(rng, cover.shape[1], size))]
    if rng.random() < 0.5:  # half of the crops: the wetter one of two places
        places.append((_offset(rng, cover.shape[0], size), _offset(rng, cover.shape[1], size)))
    wet = [int(cover[y : y + size : 4, x : x + size : 4].sum()) for y, x in places]
    y, x = places[int(np.argmax(wet))]
    window = (slice(y, y + size), slice(x, x + size))
    image = (pool.clean if dry else pool.rainy)[index][window].astype(np.float32) / 255
    part = cover[window].astype(np.float32) / 255
    weight = np.ones_like(part)
    if dry:
        part = np.zeros_like(part)
    elif len(pool.clean) > 0:
        weight = visibility(image, pool.clean[index][window].astype(np.float32) / 255, part)
    if size != crop:
        how = cv2.INTER_AREA if size > crop else cv2.INTER_LINEAR
        image, part, weight = (
            np.clip(cv2.resize(a, (crop, crop), interpolation=how), 0, 1)
            for a in (image, part, weight)
        )
    if rng.random() < 0.5:
        image, part, weight = image[:, ::-1], part[:, ::-1], weight[:, ::-1]
    if dry and lures > 0 and rng.random() < lures:
        image = lure(image, rng)
    image = photographed(image, rng)
    return image, np.ascontiguousarray(part), np.ascontiguousarray(weight)


def visibility(rainy: np.ndarray, clean: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Weight (H,W) in the loss: 1, or UNSEEN_WEIGHT where water leaves the photo as it was.

    rainy, clean: (H,W,3) in [0,1]; coverage: (H,W). Differences are averaged over 5x5 pixels.
    """
    change = cv2.blur(np.abs(rainy - clean).max(axis=2), (5, 5))
    unseen = (coverage > 0) & (change < SEEN_DIFFERENCE)
    return np.where(unseen, np.float32(UNSEEN_WEIGHT), np.float32(1))


def _offset(rng: np.random.Generator, length: int, size: int) -> int:
    return int(rng.integers(length - size + 1))


def photographed(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The image with other exposure, contrast, colour cast and noise, in [0,1]."""
    if rng.random() < 0.1:
        image = image[..., rng.permutation(3)]
    if rng.random() < 0.7:
        image = np.power(np.clip(image, 0, 1), np.exp(rng.uniform(-0.35, 0.35)))
        image = image * np.exp(rng.normal(0, 0.12) + rng.normal(0, 0.04, 3))
        image = (image - 0.5) * np.exp(rng.normal(0, 0.1)) + 0.5
    if rng.random() < 0.25:  # soft lenses; and a renderer's noise should not give drops away
        image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.4, 1.1)))
    if rng.random() < 0.5:
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        image = image + np.float32(rng.uniform(0, 0.03)) * noise
    return np.clip(image, 0, 1).astype(np.float32)
