"""A scene's posed images with their final masks, and their straight forms for programs without lenses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from pipeline.io.images import read_image
from pipeline.io.made_of import changed_inputs
from pipeline.io.maps import read_depth, read_map
from pipeline.io.masks import fit_mask
from pipeline.io.paths import ScenePaths
from pipeline.io.posed import PosedImage, read_posed_images
from pipeline.io.scene import read_images_json
from pipeline.io.straighten import Pinholes, common_pinholes, own_pinholes, pinholes
from pipeline.io.transforms import Place, View, read_transforms

# What `render` makes: the folder in views/, what its files end with, and what they are called in a sentence.
RENDERED = {"depth": (".exr", "depth maps"), "composite": (".png", "clean photos")}


@dataclass(frozen=True)
class StraightScene:
    """Posed images, how many photos have no pose, and pinholes for them, made when they are asked for."""

    paths: ScenePaths
    images: list[PosedImage]
    lost: int

    @property
    def views(self) -> list[View]:
        """The images' views, through their lenses."""
        return [image.view for image in self.images]

    @property
    def origin(self) -> Place:
        """Where the world's origin lies in the coordinates that the capture came with."""
        return self.images[0].view.origin

    @property
    def sparse(self) -> Path:
        """The folder of the COLMAP model, in the scene's own world."""
        return self.paths.poses / "sparse"

    @cached_property
    def own(self) -> Pinholes:
        """A pinhole per lens; UserError when a lens cannot be straightened."""
        return pinholes(self.views, own_pinholes(self.views))

    @cached_property
    def common(self) -> Pinholes:
        """One pinhole for all; UserError when there is none."""
        return pinholes(self.views, common_pinholes(self.views))

    @cached_property
    def changed(self) -> list[str]:
        """What of photos, poses and masks is not what `render` made its views of."""
        return changed_inputs(self.paths)

    def rendered(self, kind: str) -> list[PosedImage]:
        """The images that `render` made a `kind` (of RENDERED) of.

        UserError for none, and when what they were made of has changed since.
        """
        suffix, called = RENDERED[kind]
        folder = self.paths.views / kind
        found = [i for i in self.images if (folder / f"{i.record.stem}{suffix}").is_file()]
        if not found:
            raise UserError(
                f"there are no {called} in {folder}.", "Run `python -m stages.render` first."
            )
        if self.changed:
            raise UserError(
                f"{self.paths.views} was rendered from other {' and '.join(self.changed)} than there are "
                "now.",
                "Run `python -m stages.nerf` and `python -m stages.render` again, or `dvc repro`.",
            )
        return found

    def depth(self, view: View) -> np.ndarray:
        """The rendered depth (H, W) along z as the lens shows it, 0 where no photo saw the surface."""
        depth = read_depth(self.paths.views / f"depth/{Path(view.name).stem}.exr")
        return np.where(self.seen(view), depth, 0).astype(np.float32)

    def seen(self, view: View) -> np.ndarray:
        """Where some photo saw the surface uncovered (H, W); everywhere, if that was not counted."""
        path = self.paths.views / f"seen/{Path(view.name).stem}.exr"
        if not path.is_file():
            return np.ones((view.height, view.width), bool)
        return fit_mask(read_map(path, "render") > 0, (view.width, view.height))

    def field(self, name: str) -> np.ndarray:
        """The field's picture (H, W, 3) in [0, 1] at a photo's pose, fitted or held out."""
        held_out = self.paths.views / "test" / name
        path = held_out if held_out.is_file() else self.paths.views / "input" / name
        return read_image(path, "render")


def read_straight(paths: ScenePaths, *, clean: bool = False) -> StraightScene:
    """The scene with the last masks that there are; UserError when no image has a pose.

    `clean`: with the cleaned photos instead of the photos. Masks then leave out only what no photo saw
    uncovered, which is made up; UserError when a photo has no clean form.
    """
    keep_masks = paths.refine if paths.refine.is_dir() else paths.masks
    views = read_transforms(paths.poses / "transforms.json")
    images = read_posed_images(paths.images, keep_masks if keep_masks.is_dir() else None, views)
    lost = len(read_images_json(paths.images)) - len(images)
    scene = StraightScene(paths, images, lost)
    if clean:
        _clean(scene)
    return scene


def _clean(scene: StraightScene) -> None:
    """Puts the cleaned photos in the photos' place."""
    missing = len(scene.images) - len(scene.rendered("composite"))
    if missing:
        raise UserError(
            f"export.images: clean: {missing} of {len(scene.images)} photos have no clean form in "
            f"{scene.paths.views / 'composite'}.",
            "Set render.views: all and run `python -m stages.render`.",
        )
    for index, image in enumerate(
        scene.images
    ):  # one at a time: both forms of all take twice the room
        size = (image.view.width, image.view.height)
        rgb = read_image(scene.paths.views / "composite" / image.view.name, "render", size)
        keep_mask = image.keep_mask | scene.seen(image.view)
        scene.images[index] = replace(image, rgb=rgb, keep_mask=keep_mask)
