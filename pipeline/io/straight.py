"""A scene's posed images with their final masks, and their straight forms for programs without lenses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.io.given import Straightener
from pipeline.io.images import as_bytes, read_image
from pipeline.io.maps import read_depth, read_map
from pipeline.io.masks import fit_mask
from pipeline.io.paths import ScenePaths
from pipeline.io.posed import PosedImage, read_posed_images
from pipeline.io.straighten import common_pinholes, straighteners_to
from pipeline.io.transforms import Place, View, read_transforms


@dataclass(frozen=True)
class StraightScene:
    """Posed images, the common pinhole of each by name, and what takes its pixels there."""

    paths: ScenePaths
    images: list[PosedImage]
    straight: dict[str, View]
    straighten: dict[str, Straightener]

    @property
    def origin(self) -> Place:
        """Where the world's origin lies in the coordinates that the capture came with."""
        return self.images[0].view.origin

    @property
    def sparse(self) -> Path:
        """The folder of the COLMAP model, in the scene's own world."""
        return self.paths.poses / "sparse"

    def straight_rgb(self, image: PosedImage) -> np.ndarray:
        """The photo (H, W, 3) in [0, 1] as the common pinhole shows it."""
        return np.clip(self.straighten[image.view.name](image.rgb), 0.0, 1.0)

    def straight_keep(self, image: PosedImage) -> np.ndarray:
        """Its keep mask (H, W)."""
        return self.straighten[image.view.name](image.keep_mask.astype(np.uint8)) > 0

    def straight_depth(self, view: View) -> np.ndarray | None:
        """The rendered depth (H, W) along z, 0 where no photo saw the surface; None without one."""
        stem = Path(view.name).stem
        path, seen = self.paths.views / f"depth/{stem}.exr", self.paths.views / f"seen/{stem}.exr"
        if not path.is_file():
            return None
        depth = read_depth(path)
        if seen.is_file():
            known = fit_mask(read_map(seen, "render") > 0, (view.width, view.height))
            depth = np.where(known, depth, 0).astype(np.float32)
        return self.straighten[view.name](depth)

    def straight_field(self, name: str) -> np.ndarray:
        """The field's picture (H, W, 3) uint8 at a photo's pose, fitted or held out."""
        held_out = self.paths.views / "test" / name
        path = held_out if held_out.is_file() else self.paths.views / "input" / name
        return as_bytes(self.straighten[name](read_image(path, "render")))


def read_straight(paths: ScenePaths) -> StraightScene:
    """The scene with the last masks that there are; UserError when no image has a pose."""
    keep_masks = paths.refine if paths.refine.is_dir() else paths.masks
    views = read_transforms(paths.poses / "transforms.json")
    images = read_posed_images(paths.images, keep_masks if keep_masks.is_dir() else None, views)
    posed = [image.view for image in images]
    straight = common_pinholes(posed)
    return StraightScene(paths, images, straight, straighteners_to(posed, straight))
