"""The scene in the formats of other programs: nerfstudio, COLMAP, LLFF, PLY, depth maps, clean photos."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from pipeline.geometry.fuse import DepthView, fuse
from pipeline.io.atomic import publish_dir, write_npy
from pipeline.io.images import read_image, resized, write_image, write_photo
from pipeline.io.llff import poses_bounds
from pipeline.io.maps import write_depth
from pipeline.io.masks import fit_mask, rain_mask, write_keep_mask
from pipeline.io.ply import write_ply
from pipeline.io.straight import StraightScene, read_straight
from pipeline.io.transforms import write_transforms
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


def main(job: Job, params: Params) -> str:
    """Makes the scene's (or its variant's) `export/` from the images, masks, poses and views there are."""
    scene = read_straight(job.paths)
    export = job.paths.out / "export"
    with publish_dir(export) as fresh:
        for name in params.formats:
            WRITERS[name](scene, fresh / name, params)
    return f"{len(scene.images)} photos as {', '.join(params.formats)} in {export}"


def _nerfstudio(scene: StraightScene, folder: Path, params: Params) -> None:
    for image in scene.images:
        write_image(folder / "images" / image.view.name, image.rgb)
        write_keep_mask(folder / "masks" / image.view.name, image.keep_mask)
    write_ply(folder / "sparse_pc.ply", *sparse_points(read_sparse(scene.sparse)), scene.origin)
    views, extras = [i.view.as_given for i in scene.images], {"ply_file_path": "sparse_pc.ply"}
    write_transforms(folder / "transforms.json", views, extras, beside="")


def _colmap(scene: StraightScene, folder: Path, params: Params) -> None:
    for image in scene.images:
        write_image(folder / "images" / image.view.name, scene.straight_rgb(image))
        write_keep_mask(folder / "masks" / f"{image.view.name}.png", scene.straight_keep(image))
    write_straight(read_sparse(scene.sparse), scene.straight, folder / "sparse/0")


def _llff(scene: StraightScene, folder: Path, params: Params) -> None:
    factor, keep_masks = params.llff_factor, []
    for image in scene.images:
        rgb, view = scene.straight_rgb(image), scene.straight[image.view.name]
        size = (round(view.width / factor), round(view.height / factor))
        write_image(folder / "images" / view.name, rgb)
        write_image(folder / f"images_{factor}" / view.name, resized(rgb, size))
        keep_masks.append(fit_mask(scene.straight_keep(image), size))
    write_npy(folder / "poses_bounds.npy", poses_bounds(list(scene.straight.values())))
    write_npy(folder / "rainMask.npy", rain_mask(keep_masks))


def _ply(scene: StraightScene, folder: Path, params: Params) -> None:
    write_ply(folder / "sparse.ply", *sparse_points(read_sparse(scene.sparse)), scene.origin)
    views = []
    for image in scene.images:
        view, depth = scene.straight[image.view.name], scene.straight_depth(image.view)
        if depth is not None:
            camera = (view.cam_from_world, view.fx, view.fy, view.cx, view.cy)
            views.append(DepthView(depth, scene.straight_field(view.name), *camera))
    if len(views) < 2:
        log.warning("no dense points: run `python -m stages.render` for depth maps")
        return
    dense = fuse(views, step=params.dense_step, agreeing=params.dense_agreeing)
    write_ply(folder / "dense.ply", *dense, scene.origin)


def _depth(scene: StraightScene, folder: Path, params: Params) -> None:
    for image in scene.images:
        depth = scene.straight_depth(image.view)
        if depth is None:
            log.warning("%s has no depth map: run `python -m stages.render`", image.view.name)
            continue
        folder.mkdir(parents=True, exist_ok=True)
        write_depth(folder / f"{image.record.stem}.exr", depth)


def _photos(scene: StraightScene, folder: Path, params: Params) -> None:
    for image in scene.images:
        path = scene.paths.views / "composite" / image.view.name
        if not path.is_file():
            log.warning("%s has no clean form: run `python -m stages.render`", image.view.name)
            continue
        write_photo(folder / f"{image.record.stem}.jpg", read_image(path), image.view.fx)


WRITERS: dict[str, Callable[[StraightScene, Path, Params], None]] = {
    "nerfstudio": _nerfstudio,
    "colmap": _colmap,
    "llff": _llff,
    "ply": _ply,
    "depth": _depth,
    "photos": _photos,
}


if __name__ == "__main__":
    run("export", Params, main)
