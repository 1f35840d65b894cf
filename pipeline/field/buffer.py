"""The pixels that a fit may use, shuffled, and the rays through them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import UserError
from pipeline.field.base import Rays
from pipeline.geometry.rays import pixel_rays
from pipeline.io.posed import PosedImage
from pipeline.io.transforms import View

DEEPEST = 1e6  # far over near: beyond ten times this, 1/far is lost beside 1/near in 32 bits


@dataclass(frozen=True)
class PosedPhoto:
    """One photo to fit: ``image`` ``(H, W, 3)`` in [0, 1], ``keep_mask`` ``(H, W)`` True = use,
    ``cam_from_world`` ``(4, 4)``, ``intrinsics`` fx, fy, cx, cy, k1, and its depth bounds.

    ``drop_mask`` ``(H, W)`` in [0, 1], if there is one, weighs kept pixels down: the loss's soft M.
    """

    name: str
    image: np.ndarray
    keep_mask: np.ndarray
    cam_from_world: np.ndarray
    intrinsics: tuple[float, float, float, float, float]
    near: float
    far: float
    drop_mask: np.ndarray | None = None


class Batch(NamedTuple):
    """``rays``, their colours ``observed`` ``(R, 3)`` in [0, 1], the loss's ``drop_mask`` ``(R,)``
    and the number ``view`` ``(R,)`` of the photo that each belongs to."""

    rays: Rays
    observed: Tensor
    drop_mask: Tensor
    view: Tensor


def depth_bounds(
    views: Collection[View], near_factor: float, far_factor: float
) -> tuple[float, float]:
    """``near`` and ``far`` of all views together, times their factors; UserError when nothing is between."""
    if not views:
        raise UserError("No photo has a pose.", "See poses/poses.json for why.")
    near = min(view.near for view in views) * near_factor
    far = max(view.far for view in views) * far_factor
    if near >= far:
        raise UserError("Nothing is left between near and far.", "Lower nerf.near_factor.")
    return near, far


def photos_to_fit(
    images: Iterable[PosedImage],
    near: float,
    far: float,
    drop_masks: Mapping[str, np.ndarray] | None = None,
) -> list[PosedPhoto]:
    """The images that are not held out, in their order; pixels that no ray leads to are not kept.

    ``drop_masks`` ``(H, W)`` in [0, 1], by name, weigh kept pixels down: the loss's soft M.
    UserError when there is none, or nothing between ``near`` and ``far``, or more than 32 bits can tell apart.
    """
    if not 0 < near < far:
        raise UserError(
            f"The poses bound the scene's depth by {near:g} and {far:g}: nothing lies between.",
            "Run `python -m stages.poses` again.",
        )
    if far > DEEPEST * near:
        raise UserError(
            f"The scene's depths reach from {near:g} to {far:g}: more than {DEEPEST:,.0f} times as far.",
            "Raise nerf.near_factor, lower nerf.far_factor, or check the depths that came with the poses.",
        )
    photos = [
        PosedPhoto(
            image.record.name,
            image.rgb,
            image.keep_mask & ~image.view.without_ray(),
            image.view.cam_from_world,
            image.view.intrinsics,
            near,
            far,
            None if drop_masks is None else drop_masks[image.record.name],
        )
        for image in images
        if image.record.split == "train"
    ]
    if not photos:
        raise UserError(
            "None of the photos with a pose is for fitting: all are held out (ingest.holdout).",
            "See poses/poses.json for the photos that were lost.",
        )
    return photos


class RayBuffer:
    """Every kept pixel of every photo, in an order shuffled anew each epoch; the few that fill no batch wait.

    Covered pixels are not in it, so no ray is wasted on them. Holds 12 bytes per pixel; the rays
    are made when a batch is asked for.
    """

    def __init__(self, photos: Sequence[PosedPhoto], seed: int, device: str = "cpu") -> None:
        if not photos:
            raise UserError("No photo is left to fit.", "See poses/poses.json for why.")
        kept, colours, offsets = [], [], [0]
        for photo in photos:
            kept.append(np.flatnonzero(photo.keep_mask.ravel()).astype(np.int32) + offsets[-1])
            colours.append(np.round(photo.image.reshape(-1, 3) * 255.0).astype(np.uint8))
            offsets.append(offsets[-1] + photo.keep_mask.size)
        order = np.concatenate(kept)
        kept.clear()
        if order.size == 0:
            raise UserError(
                "Every pixel of every photo is masked: nothing is left to fit.",
                hint="Raise masks.threshold or lower masks.dilation; look at masks that came with the photos.",
            )
        self.seed, self.device = seed, device
        self.count, self.photos = int(order.size), len(photos)
        self._kept = torch.from_numpy(order).to(device)
        self._colours = torch.from_numpy(np.concatenate(colours)).to(device)
        self._offsets = torch.tensor(offsets[1:], device=device)
        self._starts = torch.tensor(offsets[:-1], device=device)
        self._widths = torch.tensor([p.image.shape[1] for p in photos], device=device)
        self._poses = _stack([p.cam_from_world[:3, :4] for p in photos]).to(device)
        self._intrinsics = _stack([np.array(p.intrinsics) for p in photos]).to(device)
        self._distorted = any(p.intrinsics[4] != 0 for p in photos)
        self._bounds = _stack([np.array([p.near, p.far]) for p in photos]).to(device)
        self._soft = _soft_masks(photos, device)
        self._epoch = -1
        self._shuffled = self._kept

    def batch(self, step: int, size: int) -> Batch:
        """The ``size`` rays of a step; fewer if fewer are kept."""
        return self.rays(self.pixels(step, size))

    def pixels(self, step: int, size: int) -> Tensor:
        """The numbers ``(size,)`` int32 of a step's pixels; fewer if fewer are kept."""
        size = min(size, self.count)
        epoch, place = divmod(step, self.count // size)
        if epoch != self._epoch:
            generator = torch.Generator(self.device).manual_seed(self.seed * 100_003 + epoch)
            order = torch.randperm(
                self.count, generator=generator, dtype=torch.int32, device=self.device
            )
            self._shuffled = self._kept  # lets go of the last order before the next is made
            self._shuffled, self._epoch = self._kept.index_select(0, order), epoch
        return self._shuffled[place * size : (place + 1) * size]

    def rays(self, pixels: Tensor) -> Batch:
        """The rays through :meth:`pixels`; made on the buffer's device, which is not waited for."""
        pixel = pixels.long()
        view = torch.searchsorted(self._offsets, pixel, right=True)
        inside = pixel - self._starts[view]
        width = self._widths[view]
        rows = torch.div(inside, width, rounding_mode="floor")
        columns = inside - rows * width
        rays_o, rays_d = pixel_rays(
            columns, rows, self._intrinsics[view], self._poses[view], self._distorted
        )
        near, far = self._bounds[view].unbind(-1)
        observed = self._colours[pixel].float() / 255.0
        drop_mask = torch.zeros_like(near)
        if self._soft is not None:
            drop_mask = self._soft[pixel].float() / 255.0
        return Batch(Rays(rays_o, rays_d, near, far), observed, drop_mask, view)


def _soft_masks(photos: Sequence[PosedPhoto], device: str) -> Tensor | None:
    if all(photo.drop_mask is None for photo in photos):
        return None
    soft = [
        np.zeros(photo.keep_mask.shape) if photo.drop_mask is None else photo.drop_mask
        for photo in photos
    ]
    bytes_ = [np.round(np.clip(one, 0.0, 1.0).ravel() * 255.0).astype(np.uint8) for one in soft]
    return torch.from_numpy(np.concatenate(bytes_)).to(device)


def _stack(arrays: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32))
