"""From a photo to its map of drops: any size, in tiles, at several scales."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.attention.network import STEP_RADIUS, STEPS, AttentiveRecurrentNet, bgr_from_rgb


def attend(
    network: AttentiveRecurrentNet,
    image: np.ndarray,
    *,
    scales: Sequence[float] = (1.0,),
    tile: int = 512,
    steps: int = STEPS,
) -> np.ndarray:
    """Where drops are on a photo: (H,W) float32 in [0,1], 1 = a drop.

    image: RGB (H,W,3) in [0,1], any size from 1x1. It is computed on the device that holds the
    network, in tiles of at most tile x tile pixels, each with as many pixels around it as the
    network sees: the same map as in one piece, at most (tile + 2*13*steps)^2 pixels at a time.
    scales: factors of the image's size; the maps, brought back to that size, are averaged.
    The raw output is clamped to [0,1], which the network's last layer does not do.
    """
    if not scales or min(scales) <= 0 or tile < 1 or steps < 1:
        raise ValueError(f"scales {scales}, tile {tile} and steps {steps} must be positive")
    height, width = image.shape[:2]
    total = np.zeros((height, width), np.float32)
    for scale in scales:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        found = _attend_once(network, _resized(image, size), tile, steps)
        total += _resized(found, (width, height))
    return np.clip(total / np.float32(len(scales)), 0.0, 1.0)


def _resized(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The array at another (width, height): averaged when it shrinks, bilinear when it grows."""
    if (values.shape[1], values.shape[0]) == size:
        return values.astype(np.float32, copy=False)
    shrinks = size[0] < values.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(values.astype(np.float32), size, interpolation=how)


def _attend_once(
    network: AttentiveRecurrentNet, image: np.ndarray, tile: int, steps: int
) -> np.ndarray:
    bgr = bgr_from_rgb(image)
    height, width = image.shape[:2]
    found = np.empty((height, width), np.float32)
    halo = STEP_RADIUS * steps
    for y0, y1 in _spans(height, tile):
        for x0, x1 in _spans(width, tile):
            top, left = max(0, y0 - halo), max(0, x0 - halo)
            part = bgr[:, :, top : y1 + halo, left : x1 + halo]
            piece = _last_map(network, part, steps)
            found[y0:y1, x0:x1] = piece[y0 - top : y1 - top, x0 - left : x1 - left]
    return np.clip(found, 0.0, 1.0)


def _spans(length: int, tile: int) -> Iterator[tuple[int, int]]:
    """Cuts [0, length) into the fewest spans of at most `tile`, as equal as they can be."""
    count = math.ceil(length / tile)
    edges = [round(length * k / count) for k in range(count + 1)]
    return pairwise(edges)


def _last_map(network: AttentiveRecurrentNet, bgr: Tensor, steps: int) -> np.ndarray:
    device = next(network.parameters()).device
    # Full float32 and fixed algorithms: the map is the same every time, on a GPU too.
    exact = torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    )
    with torch.inference_mode(), exact:
        return network(bgr.contiguous().to(device), steps)[-1][0, 0].cpu().numpy()
