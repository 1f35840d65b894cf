"""From a photo to its map of drops: any size, in tiles, at several scales."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.attention.network import STEPS, bgr_from_rgb
from pipeline.attention.weights import Detector


def attend(
    network: Detector,
    image: np.ndarray,
    *,
    scales: Sequence[float] = (1.0,),
    tile: int = 512,
    steps: int = STEPS,
    mirrored: bool = False,
) -> np.ndarray:
    """Where drops are on a photo: (H,W) float32 in [0,1], 1 = a drop.

    image: RGB (H,W,3) in [0,1], any size from 1x1. It is computed on the device that holds the
    network, in tiles of about tile x tile pixels, each with as many pixels around it as the
    network sees: the same map as in one piece, about (tile + 2*reach)^2 pixels at a time, where
    reach is 13 per step for the attentive network and 144 for the U-Net.
    scales: factors of the image's size; the maps, brought back to that size, are averaged.
    mirrored: each of these maps is the mean of the photo's and of its mirror image's (left for right),
    which is as likely a photo; upside down it is not, since drops turn what stands behind them over.
    """
    if not scales or min(scales) <= 0 or tile < 1 or steps < 1:
        raise ValueError(f"scales {scales}, tile {tile} and steps {steps} must be positive")
    height, width = image.shape[:2]
    total = np.zeros((height, width), np.float32)
    for scale in scales:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        scaled = _resized(image, size)
        found = _attend_once(network, scaled, tile, steps)
        if mirrored:
            found = (found + _attend_once(network, scaled[:, ::-1], tile, steps)[:, ::-1]) / 2
        total += _resized(found, (width, height))
    return np.clip(total / np.float32(len(scales)), 0.0, 1.0)


def _resized(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The array at another (width, height): averaged when it shrinks, bilinear when it grows."""
    if (values.shape[1], values.shape[0]) == size:
        return values.astype(np.float32, copy=False)
    shrinks = size[0] < values.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(values.astype(np.float32), size, interpolation=how)


def _attend_once(network: Detector, image: np.ndarray, tile: int, steps: int) -> np.ndarray:
    bgr = bgr_from_rgb(image)
    height, width = image.shape[:2]
    found = np.empty((height, width), np.float32)
    halo = network.reach(steps)
    for y0, y1 in _spans(height, tile, network.grid):
        for x0, x1 in _spans(width, tile, network.grid):
            top, left = max(0, y0 - halo), max(0, x0 - halo)
            part = bgr[:, :, top : y1 + halo, left : x1 + halo]
            piece = _map(network, part, steps)
            found[y0:y1, x0:x1] = piece[y0 - top : y1 - top, x0 - left : x1 - left]
    return found


def _spans(length: int, tile: int, grid: int) -> Iterator[tuple[int, int]]:
    """Cuts [0, length) into the fewest spans of about `tile`, as equal as they can be.

    Every span begins at a multiple of `grid`.
    """
    count = math.ceil(length / tile)
    edges = [round(length * k / count / grid) * grid for k in range(count)]
    return pairwise(dict.fromkeys([*edges, length]))


def _map(network: Detector, bgr: Tensor, steps: int) -> np.ndarray:
    device = next(network.parameters()).device
    exact_products(device)
    with torch.inference_mode():
        return network.attention(bgr.contiguous().to(device), steps)[0, 0].cpu().numpy()


def exact_products(device: torch.device) -> None:
    """On a GPU, full float32 and fixed algorithms from here on: the map is the same every time.

    For the whole process, and not taken back: several threads make maps at once, and the flags are
    shared, so that what one put back another would compute with.
    """
    if device.type == "cuda":
        torch.backends.cudnn.benchmark = False
        torch.backends.cudnn.deterministic = True
        torch.backends.cudnn.allow_tf32 = False
