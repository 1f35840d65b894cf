"""The same window of several pictures side by side, labelled, as the paper's figures show them."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

LABEL_HEIGHT, GAP = 22, 4


def busiest_window(coverage: np.ndarray, size: tuple[int, int]) -> tuple[int, int]:
    """The (x, y) of the window of `size` (w, h) that holds the most coverage (H, W); the first of equals.

    ValueError when the window is larger than the map.
    """
    height, width = coverage.shape
    if size[0] > width or size[1] > height:
        raise ValueError(f"a window of {size} in a map of {(width, height)}")
    sums = cv2.integral(coverage.astype(np.float64))
    w, h = size
    inside = sums[h:, w:] - sums[:-h, w:] - sums[h:, :-w] + sums[:-h, :-w]
    y, x = np.unravel_index(int(np.argmax(np.round(inside, 6))), inside.shape)
    return int(x), int(y)


def side_by_side(
    pictures: Mapping[str, np.ndarray], corner: tuple[int, int], size: tuple[int, int], scale: int
) -> np.ndarray:
    """One strip (H, W, 3) float32: the window at `corner` (x, y) of `size` (w, h) of each picture
    (H, W, 3) in [0, 1], enlarged `scale` times without smoothing, under its label."""
    (x, y), (w, h) = corner, size
    parts = []
    for label, rgb in pictures.items():
        crop = np.ascontiguousarray(rgb[y : y + h, x : x + w], np.float32)
        large = cv2.resize(crop, (w * scale, h * scale), interpolation=cv2.INTER_NEAREST)
        head = np.full((LABEL_HEIGHT, w * scale, 3), 255, np.uint8)  # OpenCV letters 8 bits only
        cv2.putText(
            head, label, (3, LABEL_HEIGHT - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1,
            cv2.LINE_AA,
        )  # fmt: skip
        parts.append(np.vstack([head.astype(np.float32) / 255, large]))
        parts.append(np.ones((parts[-1].shape[0], GAP, 3), np.float32))
    return np.hstack(parts[:-1])
