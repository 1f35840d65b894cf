"""The scene in the formats of other programs: nerfstudio, COLMAP, LLFF, PLY, depth maps, clean photos."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pipeline.errors import UserError
from pipeline.geometry.fuse import DepthView, fuse
from pipeline.io.atomic import publish_dir, write_npy
from pipeline.io.images import read_image, resized, write_image, write_photo
from pipeline.io.llff import poses_bounds
from pipeline.io.maps import read_depth, read_map, write_depth
from pipeline.io.masks import fit_mask, rain_mask, write_keep_mask
from pipeline.io.ply import write_ply
from pipeline.io.posed import PosedImage, read_posed_images
from pipeline.io.straighten import common_pinholes, straighteners_to
from pipeline.io.transforms import View, read_transforms, write_transforms
from pipeline.sfm import read_sparse, sparse_points, write_straight
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)
Format = Literal["nerfstudio", "colmap", "llff", "ply", "depth", "photos"]


class Params(Section):
    """Section `export`."""

    formats: list[Format]
    llff_factor: Annotated[int, Field(ge=1, le=32)]
    dense_step: Annotated[int, Field(ge=1, le=64)]
    dense_agreeing: Annotated[int, Field(ge=1, le=8)]


class Scene:
    """What is exported: posed images with their final masks, and their straight forms."""

    def __init__(self, job: Job) -> None:
        self.paths = job.paths
        refined, first = job.paths.refine, job.paths.masks
        masks = refined if refined.is_dir() else first
        views = read_transforms(job.paths.poses / "transforms.json")
        self.images = read_posed_images(job.paths.images, masks if masks.is_dir() else None, views)
        if not self.images:
            raise UserError(
                f"{job.paths.poses} has no posed image.", "Run `python -m stages.poses`."
            )
        views_ = [image.view for image in self.images]
        self.straight = common_pinholes(views_)
        self.straighten = straighteners_to(views_, self.straight)

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


def main(job: Job, params: Params) -> str:
    """Makes `artifacts/<scene>/export/` from the images, masks, poses and views there are."""
    scene = Scene(job)
    export = job.paths.artifacts / "export"
    with publish_dir(export) as fresh:
        for name in params.formats:
            WRITERS[name](scene, fresh / name, params)
    return f"{len(scene.images)} photos as {', '.join(params.formats)} in {export}"


def _nerfstudio(scene: Scene, folder: Path, params: Params) -> None:
    for image in scene.images:
        write_image(folder / "images" / image.view.name, image.rgb)
        write_keep_mask(folder / "masks" / image.view.name, image.keep_mask)
    write_ply(folder / "sparse_pc.ply", *sparse_points(read_sparse(scene.paths.poses / "sparse")))
    views = [image.view for image in scene.images]
    extras = {"ply_file_path": "sparse_pc.ply"}
    write_transforms(folder / "transforms.json", views, extras, beside="")


def _colmap(scene: Scene, folder: Path, params: Params) -> None:
    for image in scene.images:
        write_image(folder / "images" / image.view.name, scene.straight_rgb(image))
        write_keep_mask(folder / "masks" / f"{image.view.name}.png", scene.straight_keep(image))
    model = read_sparse(scene.paths.poses / "sparse")
    write_straight(model, scene.straight, folder / "sparse/0")


def _llff(scene: Scene, folder: Path, params: Params) -> None:
    factor, keep_masks = params.llff_factor, []
    for image in scene.images:
        rgb, view = scene.straight_rgb(image), scene.straight[image.view.name]
        size = (round(view.width / factor), round(view.height / factor))
        write_image(folder / "images" / view.name, rgb)
        write_image(folder / f"images_{factor}" / view.name, resized(rgb, size))
        keep_masks.append(fit_mask(scene.straight_keep(image), size))
    write_npy(folder / "poses_bounds.npy", poses_bounds(list(scene.straight.values())))
    write_npy(folder / "rainMask.npy", rain_mask(keep_masks))


def _ply(scene: Scene, folder: Path, params: Params) -> None:
    write_ply(folder / "sparse.ply", *sparse_points(read_sparse(scene.paths.poses / "sparse")))
    views = []
    for image in scene.images:
        view, depth = scene.straight[image.view.name], scene.straight_depth(image.view)
        if depth is not None:
            clean = scene.straighten[view.name](read_image(_clean(scene.paths.views, view.name)))
            rgb = np.rint(np.clip(clean, 0, 1) * 255).astype(np.uint8)
            views.append(
                DepthView(depth, rgb, view.cam_from_world, view.fx, view.fy, view.cx, view.cy)
            )
    if len(views) < 2:
        log.warning("no dense points: run `python -m stages.render` for depth maps")
        return
    points = fuse(views, step=params.dense_step, agreeing=params.dense_agreeing)
    write_ply(folder / "dense.ply", *points)


def _clean(views: Path, name: str) -> Path:
    """The field's picture of a photo, fitted or held out."""
    held_out = views / "test" / name
    return held_out if held_out.is_file() else views / "input" / name


def _depth(scene: Scene, folder: Path, params: Params) -> None:
    for image in scene.images:
        depth = scene.straight_depth(image.view)
        if depth is None:
            log.warning("%s has no depth map: run `python -m stages.render`", image.view.name)
            continue
        folder.mkdir(parents=True, exist_ok=True)
        write_depth(folder / f"{image.record.stem}.exr", depth)


def _photos(scene: Scene, folder: Path, params: Params) -> None:
    for image in scene.images:
        path = scene.paths.views / "composite" / image.view.name
        if not path.is_file():
            log.warning("%s has no clean form: run `python -m stages.render`", image.view.name)
            continue
        write_photo(folder / f"{image.record.stem}.jpg", read_image(path), image.view.fx)


WRITERS: dict[str, Callable[[Scene, Path, Params], None]] = {
    "nerfstudio": _nerfstudio,
    "colmap": _colmap,
    "llff": _llff,
    "ply": _ply,
    "depth": _depth,
    "photos": _photos,
}


if __name__ == "__main__":
    run("export", Params, main)
