"""The scene in the formats of other programs: nerfstudio, COLMAP, LLFF, PLY, depth maps, clean photos."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from pipeline.geometry.fuse import DepthView, fuse
from pipeline.io import exports
from pipeline.io.atomic import publish_dir
from pipeline.io.images import as_bytes
from pipeline.io.ply import write_ply
from pipeline.io.straight import StraightScene, read_straight
from pipeline.sfm import read_sparse, sparse_points, write_straight
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)
Format = Literal["nerfstudio", "colmap", "llff", "ply", "depth", "photos"]


class Params(Section):
    """Section `export`."""

    formats: Literal["all"] | Annotated[list[Format], Field(min_length=1)]
    images: Literal["wet", "clean"]
    llff_factor: Annotated[int, Field(ge=1, le=32)]
    dense_step: Annotated[int, Field(ge=1, le=64)]
    dense_agreeing: Annotated[int, Field(ge=1, le=8)]


def main(job: Job, params: Params) -> str:
    """Makes the scene's (or its variant's) `export/` from the images, masks, poses and views there are.

    Of `all` formats those that can be made, in a folder made anew; of a list each, or none and a UserError,
    and the folders of others stay.
    """
    scene = read_straight(job.paths, clean=params.images == "clean")
    export = job.paths.out / "export"
    wanted = list(WRITERS) if params.formats == "all" else list(dict.fromkeys(params.formats))
    faults = {name: fault for name in wanted if (fault := exports.fault_of(scene, name))}
    for name, fault in faults.items():
        if params.formats != "all":
            raise fault
        log.warning("%s/ is left out: %s", name, fault)
    names = [name for name in wanted if name not in faults]
    if params.formats == "all":
        with publish_dir(export) as fresh:
            told = [_written(name, scene, fresh / name, params) for name in names]
    else:
        told = []
        for name in names:
            with publish_dir(export / name) as fresh:
                told.append(_written(name, scene, fresh, params))
    lost = f" ({scene.lost} without a pose left out)" if scene.lost else ""
    return f"{len(scene.images)} photos{lost} as {', '.join(told)} in {export}"


def _written(name: str, scene: StraightScene, folder: Path, params: Params) -> str:
    """Writes one format; its name, with what it holds where that is not everything."""
    partly = WRITERS[name](scene, folder, params)
    return f"{name} ({partly})" if partly else name


def _nerfstudio(scene: StraightScene, folder: Path, params: Params) -> None:
    exports.write_nerfstudio(scene, folder, *sparse_points(read_sparse(scene.sparse)))


def _colmap(scene: StraightScene, folder: Path, params: Params) -> None:
    exports.write_colmap_images(scene, folder)
    write_straight(read_sparse(scene.sparse), scene.own.views, folder / "sparse/0")


def _ply(scene: StraightScene, folder: Path, params: Params) -> str:
    write_ply(folder / "sparse.ply", *sparse_points(read_sparse(scene.sparse)), scene.origin)
    if fault := exports.fault_of(scene, "depth"):
        log.warning("ply/ holds no dense points: %s", fault)
        return "sparse points alone"
    views = []
    for image in scene.rendered("depth"):
        name, view = image.view.name, scene.own.views[image.view.name]
        depth = scene.own.straighteners[name](scene.depth(image.view))
        rgb = as_bytes(scene.own.rgb(name, scene.field(name)))
        camera = (view.cam_from_world, view.fx, view.fy, view.cx, view.cy)
        views.append(DepthView(depth, rgb, *camera))
    if len(views) < 2:
        log.warning("ply/ holds no dense points: they need depth maps of two photos")
        return "sparse points alone"
    dense = fuse(views, step=params.dense_step, agreeing=params.dense_agreeing)
    write_ply(folder / "dense.ply", *dense, scene.origin)
    return ""


WRITERS: dict[str, Callable[[StraightScene, Path, Params], str | None]] = {
    "nerfstudio": _nerfstudio,
    "colmap": _colmap,
    "llff": lambda scene, folder, params: exports.write_llff(scene, folder, params.llff_factor),
    "ply": _ply,
    "depth": lambda scene, folder, params: exports.write_depths(scene, folder),
    "photos": lambda scene, folder, params: exports.write_photos(scene, folder),
}


if __name__ == "__main__":
    run("export", Params, main)
