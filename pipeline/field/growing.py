"""A field that is fitted a little, looked at, and fitted further with other masks."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from pipeline.field.align import aligned
from pipeline.field.buffer import RayBuffer, photos_to_fit
from pipeline.field.fit import fit
from pipeline.field.model import build_around
from pipeline.field.render import RenderedView, render_view, scaled_camera
from pipeline.field.visibility import Witness, seen_by_others
from pipeline.geometry.cameras import intrinsic_matrix, project
from pipeline.io.images import resized
from pipeline.io.posed import PosedImage
from pipeline.io.transforms import View

log = logging.getLogger(__name__)

FAR_FACTOR = 2.0  # the world ends this far beyond the farthest sparse point
ALIGN_RAYS = 1024  # per step of the fits that cameras are aligned to
ALIGN_FIELD: dict[str, Any] = {"distortion": 0.002, "decay": 0.1}  # as the final fit has them
ALIGN_STEPS = 1  # of each camera between two fits: a second one is as little as what the fits leave

Each = Callable[[Callable[..., Any], Mapping[str, tuple[Any, ...]]], dict[str, Any]]


def scaled_image(image: PosedImage, scale: float) -> PosedImage:
    """The image and its camera with ``scale`` times the pixels; one that is partly covered is not kept."""
    view = image.view
    (fx, fy, cx, cy, _), size = scaled_camera(view.intrinsics, (view.width, view.height), scale)
    smaller = replace(view, fx=fx, fy=fy, cx=cx, cy=cy, width=size[0], height=size[1])
    keep_mask = resized(image.keep_mask.astype(np.float32), size) > 0.999
    return replace(image, view=smaller, rgb=resized(image.rgb, size), keep_mask=keep_mask)


class GrowingField:
    """The fast field of a scene, each fit warm-started from the one before.

    `near` and `far` bound it: those of the images' sparse points, `far` times `far_factor`; `config` overrides
    the field's own as in :func:`build_around`. `psnr` is the training PSNR at the end of each fit.
    """

    def __init__(
        self,
        images: Sequence[PosedImage],
        far_factor: float,
        seed: int,
        device: str,
        **config: Any,
    ) -> None:
        self.images, self.seed, self.device = list(images), seed, device
        self.near = min(image.view.near for image in images)
        self.far = max(image.view.far for image in images) * far_factor
        views = [image.view for image in images]
        self.field = build_around(
            "fast", views, self.near, self.far, seed=seed, device=device, **config
        )
        self.psnr: list[float] = []

    def fit(
        self,
        drop_masks: Mapping[str, np.ndarray],
        steps: int,
        batch_rays: int,
        threads: int,
        shards: int = 2,
        rate: float = 1.0,
    ) -> None:
        """Fits the images that are not held out, without the pixels of `drop_masks` (by name).

        `shards`, `threads` and `rate` as in :func:`pipeline.field.fit.fit`.
        """
        images = [replace(image, keep_mask=~drop_masks[image.record.name]) for image in self.images]
        seed = self.seed + len(self.psnr)
        with tqdm(total=steps, desc="brief fit", unit="step", leave=False) as bar:

            def show(step: int, loss: float, psnr: float) -> None:
                bar.update(step - bar.n)

            record = fit(
                self.field,
                RayBuffer(photos_to_fit(images, self.near, self.far), seed, self.device),
                steps=steps,
                batch_rays=batch_rays,
                seed=seed,
                rate=rate,
                shards=shards,
                threads=threads,
                progress=show,
            )
        self.psnr.append(record.rows[-1][2])

    def view(self, image: PosedImage, cam_from_world: np.ndarray | None = None) -> RenderedView:
        """What the field shows at an image's pose, or with its camera at another one."""
        view = image.view
        size = (view.width, view.height)
        return render_view(
            self.field,
            view.cam_from_world if cam_from_world is None else cam_from_world,
            view.intrinsics,
            size,
            self.near,
            self.far,
            device=self.device,
        )

    def sure(
        self,
        depths: Mapping[str, np.ndarray],
        drop_masks: Mapping[str, np.ndarray],
        fewest: int,
        each: Each,
    ) -> dict[str, np.ndarray]:
        """Where the field has reason to know what it shows, (H, W) by name of the fitted images.

        There `fewest` other fitted images saw the surface uncovered; `depths` (H, W) as rendered. ``each``
        maps a function over tasks by name.
        """
        fitted = [image for image in self.images if image.record.split == "train"]
        names = [image.record.name for image in fitted]
        witnesses = [
            Witness(
                image.view.cam_from_world,
                image.view.intrinsics,
                ~drop_masks[name],
                depths[name],
            )
            for name, image in zip(names, fitted, strict=True)
        ]
        return each(seen_by_others, {name: (i, witnesses, fewest) for i, name in enumerate(names)})

    def aligned(self, image: PosedImage, steps: int) -> np.ndarray:
        """The pose (4, 4) at which the field lies best on the image's uncovered pixels."""
        return aligned(
            image.rgb,
            image.keep_mask,
            image.view.cam_from_world,
            image.view.intrinsics,
            lambda cam_from_world: self.view(image, cam_from_world),
            steps,
        )

    def place(self, poses: Mapping[str, np.ndarray]) -> None:
        """Further fits go by these poses (by name) of the images, held-out ones included."""
        self.images = [
            replace(image, view=replace(image.view, cam_from_world=poses[image.record.name]))
            for image in self.images
        ]


def aligned_poses(
    images: Sequence[PosedImage],
    each: Each,
    fits: Sequence[int],
    scale: float,
    *,
    landmarks: np.ndarray,
    settled_px: float,
    seed: int,
    device: str,
    threads: int,
) -> dict[str, np.ndarray]:
    """The images' poses (4, 4) by name, moved so that one field explains their dry pixels best.

    A field is fitted for ``fits[0]`` steps, every camera moved onto its photo (:func:`aligned`), the field
    fitted on for ``fits[1]`` steps, and so forth; at ``scale`` times the photos' size. It ends early when
    a round moves ``landmarks``, points (N, 3) of the scene, by less than ``settled_px`` pixels of the photos
    on average. ``each`` maps a function over tasks by name. Held-out images are moved too, but never fitted.
    """
    smaller = [scaled_image(image, scale) for image in images]
    field = GrowingField(smaller, FAR_FACTOR, seed, device, **ALIGN_FIELD)
    drop_masks = {image.record.name: ~image.keep_mask for image in smaller}
    views = {image.record.name: image.view for image in images}
    poses = {name: view.cam_from_world for name, view in views.items()}
    for number, steps in enumerate(fits, start=1):
        field.fit(drop_masks, steps, ALIGN_RAYS, threads)
        before, tasks = poses, {i.record.name: (i, ALIGN_STEPS) for i in field.images}
        poses = each(field.aligned, tasks)
        field.place(poses)
        moves = [moved_px(landmarks, view, before[n], poses[n]) for n, view in views.items()]
        moved = float(np.mean(moves))
        log.info("alignment, round %d: points moved by %.3f px", number, moved)
        if moved < settled_px:
            break
    return poses


def moved_px(points: np.ndarray, view: View, before: np.ndarray, after: np.ndarray) -> float:
    """How far points (N, 3) move in the photo between two poses, mean over those before both; 0 for none.

    The lens's radial term is left out: it stretches the motion by 3 k1 r^2, a percent for most lenses, which
    decides nothing but, where a round ends at the very limit, whether one more follows.
    """
    camera = intrinsic_matrix(view.fx, view.fy, view.cx, view.cy)
    (old, old_depth), (new, new_depth) = (project(points, pose, camera) for pose in (before, after))
    ahead = (old_depth > 0) & (new_depth > 0)
    return float(np.linalg.norm(new - old, axis=1)[ahead].mean()) if ahead.any() else 0.0
