"""Fits the radiance field to the pixels that no drop covers."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from tqdm import tqdm

from pipeline.errors import UserError
from pipeline.field.buffer import PosedPhoto, RayBuffer
from pipeline.field.fit import Record, fit
from pipeline.field.grid_field import GridField
from pipeline.field.model import build_around, describe
from pipeline.field.paper_field import PaperField
from pipeline.io.atomic import publish_dir, write_json, write_text
from pipeline.io.posed import read_posed_images
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.io.transforms import View, read_transforms
from pipeline.parallel import cores
from pipeline.stage import Job, Section, run


class Params(Section):
    """The section `nerf` of params.yaml."""

    model: Literal["fast", "paper"]
    use_masks: bool
    space: Literal["auto", "ndc", "contract"]
    steps: Annotated[int, Field(ge=1)]
    batch_rays: Annotated[int, Field(ge=64, le=65536)]
    paper_steps: Annotated[int, Field(ge=1)]
    paper_batch_rays: Annotated[int, Field(ge=64, le=65536)]
    samples: Annotated[int, Field(ge=4, le=64)]
    levels: Annotated[int, Field(ge=1, le=16)]
    features: Annotated[int, Field(ge=1, le=16)]
    table_log2: Annotated[int, Field(ge=10, le=22)]
    resolution: Annotated[int, Field(ge=32, le=8192)]
    distortion: Annotated[float, Field(ge=0, le=1)]
    far_factor: Annotated[float, Field(ge=1, le=100)]
    save_every: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0, lt=2**31)]


def main(job: Job, params: Params) -> str:
    """Makes `nerf/` from the images, the masks (with use_masks) and the poses."""
    views = read_transforms(job.paths.poses / "transforms.json")
    if not views:
        raise UserError("No photo has a pose.", "See poses/poses.json for why.")
    near = min(view.near for view in views.values())
    far = max(view.far for view in views.values()) * params.far_factor
    photos, key = _photos(job, params, views, near, far)
    field = _field(params, views, near, far).to(job.device)
    buffer = RayBuffer(photos, params.seed, job.device)
    paper = params.model == "paper"
    record = _fit(job, params, field, buffer, key)
    with publish_dir(job.paths.nerf) as fresh:
        tensors = {name: value.detach().cpu() for name, value in field.state_dict().items()}
        save_tensors(fresh / "field.safetensors", tensors)
        about: dict[str, Any] = {
            "bounds": {"near": near, "far": far},
            "steps": params.paper_steps if paper else params.steps,
            "seed": params.seed,
            "use_masks": params.use_masks,
            "rays": buffer.count,
            "photos": [photo.name for photo in photos],
        }
        write_json(fresh / "field.json", describe(field) | about)
        lines = [f"{step},{loss:.9g},{psnr:.6g}" for step, loss, psnr in record.rows]
        write_text(fresh / "fit.csv", "\n".join(["step,loss,psnr", *lines]) + "\n")
    (job.paths.work("nerf") / "checkpoint.safetensors").unlink(missing_ok=True)
    return (
        f"{len(photos)} photos, {buffer.count:,} pixels, training PSNR {record.rows[-1][2]:.2f} dB"
    )


def _photos(
    job: Job, params: Params, views: dict[str, View], near: float, far: float
) -> tuple[list[PosedPhoto], str]:
    """The photos to fit, and a key of everything that decides the result."""
    digest = hashlib.sha256(json.dumps(params.model_dump(), sort_keys=True).encode())
    digest.update((job.paths.poses / "transforms.json").read_bytes() + job.device.encode())
    masks = job.paths.masks if params.use_masks else None
    photos = []
    for image in read_posed_images(job.paths.images, masks, views):
        if image.record.split == "train":
            name, view = image.record.name, image.view
            digest.update(name.encode() + image.rgb.tobytes() + image.keep_mask.tobytes())
            pose, camera = view.cam_from_world, view.intrinsics
            photos.append(PosedPhoto(name, image.rgb, image.keep_mask, pose, camera, near, far))
    if not photos:
        raise UserError(
            "None of the photos with a pose is for fitting (every 8th is held out).",
            "See poses/poses.json for the photos that were lost.",
        )
    return photos, digest.hexdigest()


def _field(
    params: Params, views: dict[str, View], near: float, far: float
) -> GridField | PaperField:
    same = ("space", "seed", "resolution")
    config = ("samples", "levels", "features", "table_log2", "distortion")
    chosen: dict[str, Any] = {key: getattr(params, key) for key in (*same, *config)}
    return build_around(params.model, list(views.values()), near, far, **chosen)


def _fit(
    job: Job, params: Params, field: GridField | PaperField, buffer: RayBuffer, key: str
) -> Record:
    file = job.paths.work("nerf") / "checkpoint.safetensors"
    paper = params.model == "paper"
    steps = params.paper_steps if paper else params.steps

    def save(step: int, state: dict[str, torch.Tensor]) -> None:
        tensors = {name: value.cpu() for name, value in state.items()}
        save_tensors(file, tensors, {"key": key, "step": str(step)})

    resume = None
    if file.is_file():
        arrays, about = load_tensors(file, f"Delete {file}.")
        if about.get("key") == key:
            tensors = {name: torch.from_numpy(a).to(job.device) for name, a in arrays.items()}
            resume = (int(about["step"]), tensors)
    with tqdm(total=steps, unit="step", leave=False, initial=resume[0] if resume else 0) as bar:

        def show(step: int, loss: float, psnr: float) -> None:
            bar.update(step - bar.n)
            bar.set_postfix_str(f"loss {loss:.5f} psnr {psnr:.2f} dB", refresh=False)

        return fit(
            field,
            buffer,
            steps=steps,
            batch_rays=params.paper_batch_rays if paper else params.batch_rays,
            seed=params.seed,
            shards=2 if job.device == "cpu" else 1,
            threads=cores(),
            save_every=params.save_every,
            save=save,
            resume=resume,
            progress=show,
        )


if __name__ == "__main__":
    run("nerf", Params, main)
