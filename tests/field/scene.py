"""A small scene with depth and known truth: textured walls and boxes, seen by cast rays."""

from __future__ import annotations

import numpy as np

BOXES = [  # low corner, high corner, texture seed; y down, z forward
    ((-9.0, -6.0, 11.0), (9.0, 3.0, 12.0), 1),
    ((-9.0, 1.4, 0.5), (9.0, 2.4, 12.0), 2),
    ((-2.2, -0.2, 5.0), (-1.0, 1.4, 6.2), 3),
    ((0.4, -1.0, 6.5), (1.8, 1.4, 8.0), 4),
    ((-0.6, 0.6, 3.6), (0.1, 1.4, 4.4), 5),
    ((2.2, 0.2, 4.6), (3.2, 1.4, 5.6), 6),
    ((-4.6, -2.0, 8.0), (-3.0, 1.4, 10.0), 7),
]


def camera(index: int, count: int) -> np.ndarray:
    """(4, 4) cam_from_world of one of ``count`` views on a small forward-facing arc."""
    angle = 2 * np.pi * index * 0.381966
    radius = 0.75 * np.sqrt((index + 0.5) / count)
    centre = np.array(
        [radius * np.cos(angle), 0.5 * radius * np.sin(angle), 0.25 * np.sin(3 * angle)]
    )
    forward = np.array([0.0, 0.3, 6.5]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, -rotation @ centre
    return out


def texture(points: np.ndarray, seed: int) -> np.ndarray:
    """(N, 3) colours in [0, 1] of points on a box: smooth noise in three octaves."""
    rng = np.random.default_rng(seed)
    base = rng.uniform(0.25, 0.75, 3)
    out = np.tile(base, (len(points), 1))
    for frequency, amplitude in ((1.3, 0.25), (4.0, 0.2), (9.0, 0.12)):
        for _ in range(3):
            direction = rng.normal(size=(3, 3)) * frequency
            out += amplitude * np.sin(points @ direction.T + rng.uniform(0, 6, 3)) / 2
    return np.clip(out, 0.0, 1.0)


def look(origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours ``(N, 3)`` and ray parameters ``(N,)`` of the first surfaces hit, or a grey sky."""
    best = np.full(len(directions), np.inf)
    which = np.full(len(directions), -1)
    inverse = 1.0 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    for number, (low, high, _) in enumerate(BOXES):
        a, b = (np.array(low) - origin) * inverse, (np.array(high) - origin) * inverse
        enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        hit = (enter < leave) & (enter > 1e-6) & (enter < best)
        best[hit], which[hit] = enter[hit], number
    colours = np.full((len(directions), 3), 0.8)
    for number, (_, _, seed) in enumerate(BOXES):
        hit = which == number
        colours[hit] = texture(origin + directions[hit] * best[hit, None], seed)
    return colours, best


def photograph(
    cam_from_world: np.ndarray, width: int, height: int, focal: float, oversample: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """An image ``(H, W, 3)`` float32 and its z-depth ``(H, W)``; principal point in the middle."""
    side = np.arange(oversample) / oversample + 0.5 / oversample
    x = (np.arange(width)[:, None] + side).ravel()
    y = (np.arange(height)[:, None] + side).ravel()
    grid = np.stack(np.meshgrid((x - width / 2) / focal, (y - height / 2) / focal), -1)
    cam = np.concatenate([grid, np.ones_like(grid[..., :1])], -1).reshape(-1, 3)
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    colours, depth = look(-rotation.T @ translation, cam @ rotation)
    shape = (height, oversample, width, oversample)
    image = colours.reshape(*shape, 3).mean((1, 3)).astype(np.float32)
    return image, depth.reshape(shape)[:, 0, :, 0].astype(np.float32)
