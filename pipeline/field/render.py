"""Whole images from a field, in chunks of bounded memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from pipeline.field.base import Field, Rays
from pipeline.geometry.rays import pixel_rays
from pipeline.io.memory import keep_memory

CHUNK = 2048  # rays: what a core keeps in its cache; larger chunks are slower
CPU_SAMPLES = 2**16  # at a time on each core: the paper's field takes 2 kB for each
CUDA_SAMPLES = 2**20  # at a time on a GPU, which has too little to do with fewer; one to two GB


class RenderedView(NamedTuple):
    """``rgb`` ``(H, W, 3)`` in [0, 1] and ``depth`` ``(H, W)``, float32."""

    rgb: np.ndarray
    depth: np.ndarray


Intrinsics = tuple[float, float, float, float, float]


def scaled_camera(
    intrinsics: Intrinsics, size: tuple[int, int], scale: float
) -> tuple[Intrinsics, tuple[int, int]]:
    """fx, fy, cx, cy, k1 and (width, height) of the same camera with ``scale`` times the pixels."""
    width, height = (max(2, round(side * scale)) for side in size)
    x, y = width / size[0], height / size[1]
    fx, fy, cx, cy, k1 = intrinsics
    return (fx * x, fy * y, cx * x, cy * y, k1), (width, height)


def render_view(
    field: Field,
    cam_from_world: np.ndarray,
    intrinsics: Intrinsics,
    size: tuple[int, int],
    near: float,
    far: float,
    *,
    device: str = "cpu",
    chunk: int | None = None,
) -> RenderedView:
    """One view of the field. ``size`` is (width, height); depth is along z, in the poses' unit.

    ``intrinsics`` are fx, fy, cx, cy, k1. Memory is bounded by ``chunk`` rays at a time (None: what
    suits the device). The same bytes for the same chunk, whatever runs beside it.
    """
    width, height = size
    keep_memory()
    if chunk is None:
        samples = field.samples_per_ray()
        chunk = max(1, CUDA_SAMPLES // samples)
        if device == "cpu":
            chunk = min(CHUNK, max(1, CPU_SAMPLES // samples))
    pose = torch.from_numpy(np.asarray(cam_from_world, np.float32)[:3, :4]).to(device)
    camera = torch.tensor(intrinsics, dtype=torch.float32, device=device)
    parts = []
    for start in range(0, width * height, chunk):
        pixel = torch.arange(start, min(start + chunk, width * height), device=device)
        rows = torch.div(pixel, width, rounding_mode="floor")
        distorted = intrinsics[4] != 0
        rays_o, rays_d = pixel_rays(pixel - rows * width, rows, camera, pose, distorted)
        bounds = [torch.full_like(rays_d[0], value) for value in (near, far)]
        out = field.render(Rays(rays_o.contiguous(), rays_d, *bounds))
        parts.append(torch.cat([out.rgb, out.depth[:, None]], 1))
    pixels = torch.cat(parts).cpu().view(height, width, 4).numpy()
    return RenderedView(np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3]))
