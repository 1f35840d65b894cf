"""A field that is fitted a little, looked at, and fitted further with other masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.field.buffer import RayBuffer, photos_to_fit
from pipeline.field.fit import fit
from pipeline.field.model import build_around
from pipeline.field.render import RenderedView, render_view
from pipeline.field.visibility import Witness, seen_by_others
from pipeline.io.posed import PosedImage


class GrowingField:
    """The fast field of a scene, each fit warm-started from the one before.

    `near` and `far` bound it: those of the images' sparse points, `far` times `far_factor`. `psnr` is the
    training PSNR at the end of each fit.
    """

    def __init__(
        self, images: Sequence[PosedImage], far_factor: float, seed: int, device: str
    ) -> None:
        self.images, self.seed, self.device = list(images), seed, device
        self.near = min(image.view.near for image in images)
        self.far = max(image.view.far for image in images) * far_factor
        views = [image.view for image in images]
        self.field = build_around("fast", views, self.near, self.far, seed=seed).to(device)
        self.psnr: list[float] = []

    def fit(
        self, drop_masks: Mapping[str, np.ndarray], steps: int, batch_rays: int, threads: int
    ) -> None:
        """Fits the images that are not held out, without the pixels of `drop_masks` (by name)."""
        images = [replace(image, keep_mask=~drop_masks[image.record.name]) for image in self.images]
        seed = self.seed + len(self.psnr)
        record = fit(
            self.field,
            RayBuffer(photos_to_fit(images, self.near, self.far), seed, self.device),
            steps=steps,
            batch_rays=batch_rays,
            seed=seed,
            shards=2 if self.device == "cpu" else 1,
            threads=threads,
        )
        self.psnr.append(record.rows[-1][2])

    def view(self, image: PosedImage) -> RenderedView:
        """What the field shows at an image's pose."""
        view = image.view
        size = (view.width, view.height)
        return render_view(
            self.field,
            view.cam_from_world,
            view.intrinsics,
            size,
            self.near,
            self.far,
            device=self.device,
        )

    def sure(
        self,
        views: Mapping[str, RenderedView],
        drop_masks: Mapping[str, np.ndarray],
        fewest: int,
    ) -> dict[str, np.ndarray]:
        """Where the field has reason to know what it shows, (H, W) by name of the fitted images.

        There `fewest` other fitted images saw the surface uncovered; `views` of all of them as rendered.
        """
        fitted = [image for image in self.images if image.record.split == "train"]
        names = [image.record.name for image in fitted]
        witnesses = [
            Witness(
                image.view.cam_from_world,
                image.view.intrinsics,
                ~drop_masks[name],
                views[name].depth,
            )
            for name, image in zip(names, fitted, strict=True)
        ]
        return {name: seen_by_others(index, witnesses, fewest) for index, name in enumerate(names)}
