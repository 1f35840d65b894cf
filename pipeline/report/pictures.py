"""Pictures of the page: scaled, coloured, encoded into the page itself."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from pipeline.io.images import as_bytes

_INK = np.array([0.92, 0.16, 0.35], np.float32)  # what a mask drops


def data_uri(rgb: np.ndarray, width: int, quality: int) -> str:
    """A JPEG `data:` address of an image (H, W, 3) in [0, 1], no side above `width`."""
    pixels = as_bytes(rgb)
    factor = width / max(pixels.shape[:2])
    if factor < 1:
        size = (max(1, round(pixels.shape[1] * factor)), max(1, round(pixels.shape[0] * factor)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OSError("a picture of the page could not be encoded")
    return as_uri(data.tobytes(), "image/jpeg")


def as_uri(data: bytes, kind: str) -> str:
    """The `data:` address of some bytes."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def coloured(values: np.ndarray, palette: int = cv2.COLORMAP_INFERNO) -> np.ndarray:
    """Colours (H, W, 3) in [0, 1] of values (H, W) in [0, 1]."""
    steps = as_bytes(values)
    return cv2.applyColorMap(steps, palette)[..., ::-1].astype(np.float32) / 255


def attention_heat(photo: np.ndarray, attention: np.ndarray) -> np.ndarray:
    """The dimmed grey photo (H, W, 3) with its attention (H, W) in [0, 1] glowing over it."""
    grey = np.repeat(photo.mean(axis=2, keepdims=True), 3, axis=2) * 0.45
    share = np.clip(attention * 1.5, 0, 1)[..., None]
    return grey * (1 - share) + coloured(attention) * share


def mask_overlay(photo: np.ndarray, keep_mask: np.ndarray) -> np.ndarray:
    """The photo (H, W, 3) with what keep_mask (H, W) drops in red, outlined."""
    drop = ~keep_mask
    edge = drop & ~cv2.erode(drop.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    share = np.where(edge, 1.0, np.where(drop, 0.6, 0.0))[..., None].astype(np.float32)
    return photo * (1 - share) + _INK * share


def depth_colours(depth: np.ndarray) -> np.ndarray:
    """Colours (H, W, 3) of a depth map (H, W): near warm, far cold, even in inverse depth.

    The range runs over the middle 96 % of the pixels, so that a few stray depths do not take it.
    """
    closeness = 1 / np.maximum(depth, 1e-6)
    low, high = np.percentile(closeness, [2, 98])
    return coloured((closeness - low) / max(high - low, 1e-12), cv2.COLORMAP_TURBO)


def upright(pixels: np.ndarray, turned: int) -> np.ndarray:
    """Pixels turned back by the `turned` degrees (counter-clockwise) that `ingest` gave them."""
    return np.ascontiguousarray(np.rot90(pixels, -(turned // 90) % 4))
