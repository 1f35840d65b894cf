"""Clean views from the fitted field: held out, at every photo's pose, composites, depth, a path."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from pipeline.field.compose import composite_photo
from pipeline.field.render import RenderedView, render_view, scaled_camera
from pipeline.field.store import load_field
from pipeline.field.visibility import Witness, shares, witness_count
from pipeline.geometry.trajectory import camera_path
from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.images import as_bytes, read_image, write_image
from pipeline.io.made_of import write_inputs
from pipeline.io.maps import read_depth, write_depth, write_map
from pipeline.io.masks import read_keep_mask
from pipeline.io.posed import posed_records
from pipeline.io.transforms import View, read_transforms
from pipeline.io.video import write_video
from pipeline.parallel import map_named, stream_named
from pipeline.stage import Job, Section, run


class Params(Section):
    """The section `render` of params.yaml."""

    views: Literal["all", "test"]
    feather_px: Annotated[float, Field(ge=0, le=100)]
    gain_px: Annotated[float, Field(ge=1, le=1000)]
    path_frames: Literal[0] | Annotated[int, Field(ge=2, le=10_000)]
    path_scale: Annotated[float, Field(gt=0, le=2)]
    path_fps: Annotated[int, Field(ge=1, le=120)]
    seen_counts: bool


def main(job: Job, params: Params) -> str:
    """Makes `views/` from the field, the poses, the images and the masks."""
    paths = job.paths
    views = read_transforms(paths.poses / "transforms.json")
    records = posed_records(paths.images, views, held_out_alone=params.views == "test")
    workers = 1 if job.device != "cpu" else None  # on a CPU each core takes a view
    how: dict[str, Any] = {"scheduler": job.scheduler, "workers": workers}
    load_field(paths.nerf, job.device)  # a missing field is told before the work begins
    with publish_dir(paths.views) as fresh:
        for folder in ("test", "input", "composite", "depth", "seen"):
            (fresh / folder).mkdir()
        fill = {"feather_px": params.feather_px, "reach_px": params.gain_px}
        how_to = (job.device, paths.nerf, paths.images, paths.refine, fresh)
        tasks = {r.name: (views[r.name], r.split, fill, *how_to) for r in records}
        map_named(_one_view, tasks, job_label="render", **how)
        if params.seen_counts and params.views == "all":
            train = tuple(views[r.name] for r in records if r.split == "train")
            items = {r.name: (views[r.name], train, paths.refine, fresh) for r in records}
            write_json(fresh / "seen.json", map_named(_count_seen, items, job_label="seen", **how))
        if filmed := params.path_frames if len(views) > 1 else 0:
            _film(job, params, list(views.values()), fresh, how)
        write_inputs(fresh, paths)
    return f"{len(records)} views, {filmed} frames of video in {paths.views}"


def _render(nerf: Path, device: str, view: View, pose: np.ndarray, scale: float) -> RenderedView:
    fitted = load_field(nerf, device)
    camera, size = scaled_camera(view.intrinsics, (view.width, view.height), scale)
    return render_view(fitted.field, pose, camera, size, fitted.near, fitted.far, device=device)


def _one_view(view: View, split: str, fill: dict[str, float], device: str, *where: Path) -> None:
    nerf, images, kept, out = where
    seen = _render(nerf, device, view, view.cam_from_world, 1.0)
    write_image(out / ("test" if split == "test" else "input") / view.name, seen.rgb)
    write_depth(out / "depth" / f"{Path(view.name).stem}.exr", seen.depth)
    photo = read_image(images / view.name, size=(view.width, view.height))
    keep_mask = _keep_mask(kept, view.name, seen.depth)
    lit = seen.rgb * load_field(nerf, device).gains.get(view.name, np.float32(1.0))
    write_image(out / "composite" / view.name, composite_photo(photo, lit, keep_mask, **fill))


@functools.cache  # of one run, whose folder has a name of its own; 5 bytes a pixel, where a fit takes 25
def _witness(kept: Path, out: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    depth = read_depth(out / "depth" / f"{Path(name).stem}.exr")
    return _keep_mask(kept, name, depth), depth


def _keep_mask(kept: Path, name: str, depth: np.ndarray) -> np.ndarray:
    return read_keep_mask(kept / name, (depth.shape[1], depth.shape[0]))


def _count_seen(view: View, train: tuple[View, ...], kept: Path, out: Path) -> dict[str, float]:
    def witness(one: View) -> Witness:
        return Witness(one.cam_from_world, one.intrinsics, *_witness(kept, out, one.name))

    count = witness_count(witness(view), [witness(one) for one in train])
    write_map(out / "seen" / f"{Path(view.name).stem}.exr", count.astype(np.float32))
    return shares(count)


def _film(job: Job, params: Params, views: list[View], out: Path, how: dict[str, Any]) -> None:
    fitted = load_field(job.paths.nerf, job.device)
    bounds = (fitted.near, fitted.far) if fitted.field.space.kind == "ndc" else None
    poses = camera_path([view.cam_from_world for view in views], bounds, params.path_frames)
    how_seen = (job.paths.nerf, job.device, views[len(views) // 2])
    items = {f"{i:05d}": (*how_seen, pose, params.path_scale) for i, pose in enumerate(poses)}
    size = int(3 * how_seen[2].width * how_seen[2].height * params.path_scale**2)
    frames = stream_named(_frame, items, size, job_label="film", **how)
    torch.set_num_threads(1)
    write_video(out / "path.mp4", (f / np.float32(255.0) for f in frames), params.path_fps)


def _frame(nerf: Path, device: str, view: View, pose: np.ndarray, scale: float) -> np.ndarray:
    return as_bytes(_render(nerf, device, view, pose, scale).rgb)


if __name__ == "__main__":
    run("render", Params, main)
