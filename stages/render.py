"""Clean views from the fitted field: held out, at every photo's pose, composites, depth, a path."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from pipeline.field.compose import composite_photo
from pipeline.field.grid_field import GridField
from pipeline.field.model import restore
from pipeline.field.paper_field import PaperField
from pipeline.field.render import RenderedView, render_view
from pipeline.field.visibility import Witness, witness_count
from pipeline.geometry.trajectory import interpolated_path, spiral_path
from pipeline.io.atomic import publish_dir, read_json, write_json
from pipeline.io.images import read_image, write_image
from pipeline.io.maps import read_depth, write_depth, write_map
from pipeline.io.masks import read_keep_mask
from pipeline.io.scene import read_images_json
from pipeline.io.tensors import load_tensors
from pipeline.io.transforms import View, read_transforms
from pipeline.io.video import write_video
from pipeline.parallel import map_named
from pipeline.stage import Job, Section, run


class Params(Section):
    """The section `render` of params.yaml."""

    feather_px: Annotated[float, Field(ge=0, le=100)]
    gain_px: Annotated[float, Field(ge=1, le=1000)]
    path_frames: Annotated[int, Field(ge=0, le=10_000)]
    path_scale: Annotated[float, Field(gt=0, le=2)]
    path_fps: Annotated[int, Field(ge=1, le=120)]
    seen_counts: bool


def main(job: Job, params: Params) -> str:
    """Makes `views/` from the field, the poses, the images and the masks."""
    paths = job.paths
    views = read_transforms(paths.poses / "transforms.json")
    records = [r for r in read_images_json(paths.images) if r.name in views]
    # On a GPU the views queue up for the one device; on a CPU each core takes one.
    how: dict[str, Any] = {
        "scheduler": job.scheduler,
        "workers": 1 if job.device != "cpu" else None,
    }
    _load(
        paths.nerf, job.device
    )  # once here, so that a missing field is told before the work begins
    with publish_dir(paths.views) as fresh:
        for folder in ("test", "input", "composite", "depth", "seen"):
            (fresh / folder).mkdir()
        fill = (params.feather_px, params.gain_px)
        tasks = {
            r.name: (paths.nerf, job.device, views[r.name], r.split == "test", paths.images,
                     paths.masks, fresh, fill)
            for r in records
        }  # fmt: skip
        map_named(_one_view, tasks, job_label="render", **how)
        if params.seen_counts:
            train = tuple(views[r.name] for r in records if r.split == "train")
            items = {r.name: (views[r.name], train, paths.masks, fresh) for r in records}
            shares = map_named(_count_seen, items, job_label="seen", **how)
            write_json(fresh / "seen.json", shares)
        if params.path_frames > 1 and len(views) > 1:
            _film(job, params, list(views.values()), fresh, how)
    return f"{len(records)} views, {params.path_frames} frames of video"


@functools.lru_cache(maxsize=1)
def _load(nerf: Path, device: str) -> tuple[GridField | PaperField, float, float]:
    about = read_json(nerf / "field.json", made_by="nerf")
    tensors, _ = load_tensors(nerf / "field.safetensors", "Run `python -m stages.nerf` first.")
    bounds = about["bounds"]
    return restore(about, tensors).to(device), bounds["near"], bounds["far"]


def _render(nerf: Path, device: str, view: View, pose: np.ndarray, scale: float) -> RenderedView:
    field, near, far = _load(nerf, device)
    size = (max(2, round(view.width * scale)), max(2, round(view.height * scale)))
    x, y = size[0] / view.width, size[1] / view.height
    camera = (view.fx * x, view.fy * y, view.cx * x, view.cy * y, view.k1)
    return render_view(field, pose, camera, size, near, far, device=device)


def _one_view(
    nerf: Path, device: str, view: View, held_out: bool, images: Path, masks: Path, out: Path,
    fill: tuple[float, float],
) -> None:  # fmt: skip
    seen = _render(nerf, device, view, view.cam_from_world, 1.0)
    write_image(out / ("test" if held_out else "input") / view.name, seen.rgb)
    write_depth(out / "depth" / f"{Path(view.name).stem}.exr", seen.depth)
    photo = read_image(images / view.name)
    keep_mask = np.ones(photo.shape[:2], bool)
    if masks.is_dir():
        keep_mask = read_keep_mask(masks / view.name, (view.width, view.height))
    mixed = composite_photo(photo, seen.rgb, keep_mask, feather_px=fill[0], reach_px=fill[1])
    write_image(out / "composite" / view.name, mixed)


@functools.lru_cache(maxsize=512)
def _witness(masks: Path, out: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    depth = read_depth(out / "depth" / f"{Path(name).stem}.exr")
    keep_mask = np.ones(depth.shape, bool)
    return (read_keep_mask(masks / name) if masks.is_dir() else keep_mask), depth


def _count_seen(view: View, train: tuple[View, ...], masks: Path, out: Path) -> dict[str, float]:
    def witness(one: View) -> Witness:
        return Witness(one.cam_from_world, one.intrinsics, *_witness(masks, out, one.name))

    count = witness_count(witness(view), [witness(one) for one in train])
    write_map(out / "seen" / f"{Path(view.name).stem}.exr", count.astype(np.float32))
    return {
        "never": round(float((count == 0).mean()), 6),
        "fewer_than_3": round(float((count < 3).mean()), 6),
    }


def _film(job: Job, params: Params, views: list[View], out: Path, how: dict[str, Any]) -> None:
    cams = [view.cam_from_world for view in views]
    field, near, far = _load(job.paths.nerf, job.device)
    if field.space.kind == "ndc":
        poses = spiral_path(cams, near=near, far=far, frames=params.path_frames)
    else:
        poses = interpolated_path(cams, frames=params.path_frames)
    size = (params.path_scale, views[len(views) // 2])
    items = {
        f"{number:05d}": (job.paths.nerf, job.device, size[1], pose, size[0])
        for number, pose in enumerate(poses)
    }
    frames = map_named(_frame, items, job_label="film", **how)
    torch.set_num_threads(1)
    write_video(out / "path.mp4", (f / np.float32(255.0) for f in frames.values()), params.path_fps)


def _frame(nerf: Path, device: str, view: View, pose: np.ndarray, scale: float) -> np.ndarray:
    rgb = _render(nerf, device, view, pose, scale).rgb
    return np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)


if __name__ == "__main__":
    run("render", Params, main)
