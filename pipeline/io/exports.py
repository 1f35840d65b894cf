"""What other programs read of a scene, but for what pycolmap writes: images, masks, poses, depth, photos."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.io.atomic import link_or_copy, write_json, write_npy
from pipeline.io.images import read_image, resized, write_image, write_photo
from pipeline.io.llff import poses_bounds
from pipeline.io.maps import write_depth
from pipeline.io.masks import fit_mask, rain_mask, write_keep_mask
from pipeline.io.ply import write_ply
from pipeline.io.posed import PosedImage
from pipeline.io.straight import StraightScene
from pipeline.io.straighten import tell_cut
from pipeline.io.transforms import ORIGIN, Place, View, write_transforms

log = logging.getLogger(__name__)

ABOUT = "scene.json"  # beside the files of formats that cannot say it themselves


def fault_of(scene: StraightScene, name: str) -> UserError | None:
    """Why the scene cannot be written in the format `name`; None when it can."""
    try:
        if name in ("depth", "photos"):
            scene.rendered("depth" if name == "depth" else "composite")
        if name in ("colmap", "depth"):
            _ = scene.own
        if name == "llff":
            _ = scene.common
    except UserError as error:
        return error
    return None


def write_nerfstudio(scene: StraightScene, folder: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Writes nerfstudio's folder with the points (N, 3) and their colours (N, 3) uint8.

    nerfstudio counts in 32 bits: all lies in the scene's own world, and the file tells its origin.
    """
    for image in scene.images:
        write_image(folder / "images" / image.view.name, image.rgb)
        keep_mask = image.keep_mask & ~image.view.without_ray()
        write_keep_mask(folder / "masks" / image.view.name, keep_mask)
    write_ply(folder / "sparse_pc.ply", xyz, rgb)
    extras: dict[str, Any] = {"ply_file_path": "sparse_pc.ply"}
    train, test = split_of(scene.images)
    if train and test:  # its reader wants all three, none of them empty
        names = {"train": train, "val": test, "test": test}
        for part, those in names.items():
            extras[f"{part}_filenames"] = [f"images/{name}" for name in those]
    write_transforms(folder / "transforms.json", scene.views, extras, beside="")


def write_colmap_images(scene: StraightScene, folder: Path) -> None:
    """Writes the straightened images and masks beside a COLMAP model of them."""
    straight = scene.own
    tell_cut("colmap", scene.views, straight.views, "their lens bends that much")
    for image in scene.images:
        name = image.view.name
        write_image(folder / "images" / name, straight.rgb(name, image.rgb))
        write_keep_mask(folder / "masks" / f"{name}.png", straight.keep(name, image.keep_mask))
    write_about(folder, scene.images, straight.views)


def write_llff(scene: StraightScene, folder: Path, factor: int) -> None:
    """Writes LLFF's folder with the images smaller by `factor`, and rainMask.npy of their size.

    Its readers count in 32 bits: all lies in the scene's own world, whose origin scene.json tells.
    """
    straight, keep_masks = scene.common, []
    why = "one pinhole must serve all; colmap/ and nerfstudio/ give each camera its own"
    tell_cut("llff", scene.views, straight.views, why)
    for image in scene.images:
        name, view = image.view.name, straight.views[image.view.name]
        rgb = straight.rgb(name, image.rgb)
        size = (round(view.width / factor), round(view.height / factor))
        full, small = folder / "images" / name, folder / f"images_{factor}" / name
        write_image(full, rgb)
        if factor == 1:
            link_or_copy(full, small)
        else:
            write_image(small, resized(rgb, size))
        keep_masks.append(fit_mask(straight.keep(name, image.keep_mask), size))
    write_npy(folder / "poses_bounds.npy", poses_bounds(list(straight.views.values())))
    write_npy(folder / "rainMask.npy", rain_mask(keep_masks))
    write_about(folder, scene.images, straight.views, scene.origin)


def write_depths(scene: StraightScene, folder: Path) -> str:
    """Writes the depth maps of the pinholes of colmap/; of how many photos, if not of all."""
    straight, images = scene.own, scene.rendered("depth")
    folder.mkdir(parents=True, exist_ok=True)
    for image in images:
        depth = straight.straighteners[image.view.name](scene.depth(image.view))
        write_depth(folder / f"{image.record.stem}.exr", depth)
    write_about(folder, images, straight.views)
    return _partly("depth", images, scene)


def write_photos(scene: StraightScene, folder: Path) -> str:
    """Writes the cleaned photos through their lenses as JPEG; how many, if not all."""
    images = scene.rendered("composite")
    for image in images:
        rgb = read_image(scene.paths.views / "composite" / image.view.name, "render")
        write_photo(folder / f"{image.record.stem}.jpg", rgb, image.view.fx)
    return _partly("photos", images, scene)


def _partly(name: str, images: Sequence[PosedImage], scene: StraightScene) -> str:
    """ "3 of 24" with a warning where a format holds some of the photos only; else ""."""
    share = f"{len(images)} of {len(scene.images)}"
    if len(images) == len(scene.images):
        return ""
    log.warning("%s/ holds %s photos; `render.views: all` renders the others too", name, share)
    return share


def split_of(images: Sequence[PosedImage]) -> tuple[list[str], list[str]]:
    """The names of the images that are fitted, and of those that are held out."""
    train = [image.record.name for image in images if image.record.split == "train"]
    test = [image.record.name for image in images if image.record.split == "test"]
    return train, test


def write_about(
    folder: Path,
    images: Sequence[PosedImage],
    straight: Mapping[str, View],
    origin: Place = ORIGIN,
) -> None:
    """Writes scene.json: the split, the pinholes (fx, fy, cx, cy), the world's origin if it has one."""
    train, test = split_of(images)
    names = [image.view.name for image in images]
    cameras = {name: list(straight[name].intrinsics[:4]) for name in names}
    about: dict[str, Any] = {"train": train, "test": test, "pinholes": cameras}
    if origin != ORIGIN:
        about["world_origin"] = list(origin)
    write_json(folder / ABOUT, about)
