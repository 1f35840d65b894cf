"""Fits the radiance field to the pixels that no drop covers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field
from tqdm import tqdm

from pipeline.field.buffer import RayBuffer, depth_bounds, photos_to_fit
from pipeline.field.fit import Record, fit, refuse_large
from pipeline.field.model import build_around
from pipeline.field.store import Checkpoint, fit_key, save_field
from pipeline.io.atomic import publish_dir, write_csv
from pipeline.io.maps import read_map
from pipeline.io.posed import HELD_BYTES, read_posed_images
from pipeline.io.transforms import read_transforms
from pipeline.parallel import cores
from pipeline.stage import Job, Section, run

SETTINGS = {
    "space", "seed", "resolution", "samples", "levels", "features", "table_log2", "distortion",
    "trim", "decay", "precision",
}  # fmt: skip


class Params(Section):
    """The section `nerf` of params.yaml."""

    model: Literal["fast", "paper"]
    use_masks: bool
    soft_masks: bool
    space: Literal["auto", "ndc", "contract"]
    steps: Annotated[int, Field(ge=1)]
    batch_rays: Annotated[int, Field(ge=64, le=65536)]
    shards: Annotated[int, Field(ge=1, le=64)]
    paper_steps: Annotated[int, Field(ge=1)]
    paper_batch_rays: Annotated[int, Field(ge=64, le=65536)]
    samples: Annotated[int, Field(ge=4, le=64)]
    levels: Annotated[int, Field(ge=1, le=16)]
    features: Annotated[int, Field(ge=1, le=16)]
    table_log2: Annotated[int, Field(ge=10, le=22)]
    resolution: Annotated[int, Field(ge=32, le=8192)]
    distortion: Annotated[float, Field(ge=0, le=1)]
    trim: Annotated[float, Field(ge=0, le=0.5)]
    decay: Annotated[float, Field(ge=0, le=1)]
    rate: Annotated[float, Field(gt=0, le=10)]
    precision: Literal["auto", "float32", "bfloat16"]
    exposure: bool
    average: Annotated[float, Field(ge=0, le=1)]
    near_factor: Annotated[float, Field(gt=0, le=10)]
    far_factor: Annotated[float, Field(ge=1, le=100)]
    save_every: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0, lt=2**31)]


def main(job: Job, params: Params) -> str:
    """Makes `nerf/` from the images, the masks (with use_masks) and the poses."""
    views = read_transforms(job.paths.poses / "transforms.json")
    near, far = depth_bounds(views.values(), params.near_factor, params.far_factor)
    keep_masks = job.paths.refine if params.use_masks else None
    held = HELD_BYTES + 5 * params.soft_masks  # a soft mask, as read and in the buffer
    images = read_posed_images(job.paths.images, keep_masks, views, held)
    soft = None  # equation 4's M of kept pixels
    if params.soft_masks:
        files = {image.record: job.paths.attention / f"{image.record.stem}.exr" for image in images}
        soft = {record.name: read_map(files[record], size=record.size) for record in files}
    photos = photos_to_fit(images, near, far, soft)
    del images  # the held-out ones
    settings = params.model_dump(include=SETTINGS)
    cameras = list(views.values())
    field = build_around(params.model, cameras, near, far, device=job.device, **settings)
    refuse_large(field, job.device)
    buffer = RayBuffer(photos, params.seed, job.device)
    key = fit_key(field, photos, params.model_dump(), job.device)
    checkpoint = Checkpoint(job.paths.work("nerf") / "checkpoint.safetensors", key)
    names = [photo.name for photo in photos]
    del photos, soft  # their pixels lie in the buffer, at a quarter of the size
    steps, record = _fit(job, params, field, buffer, checkpoint)
    gains = None if record.gains is None else record.gains.tolist()
    about = {"steps": steps, "rays": buffer.count, "photos": names, "gains": gains}
    about |= params.model_dump(include={"seed", "use_masks"})
    with publish_dir(job.paths.nerf) as fresh:
        save_field(fresh, field, near, far, about)
        rows = [(step, f"{loss:.9g}", f"{psnr:.6g}") for step, loss, psnr in record.rows]
        write_csv(fresh / "fit.csv", ("step", "loss", "psnr"), rows)
    checkpoint.remove()
    psnr = record.rows[-1][2]
    return f"{len(names)} photos, {buffer.count:,} pixels, training PSNR {psnr:.2f} dB"


def _fit(
    job: Job, params: Params, field: Any, buffer: RayBuffer, checkpoint: Checkpoint
) -> tuple[int, Record]:
    paper = params.model == "paper"
    steps = params.paper_steps if paper else params.steps
    resume = checkpoint.load(job.device)
    with tqdm(total=steps, unit="step", leave=False, initial=resume[0] if resume else 0) as bar:

        def show(step: int, loss: float, psnr: float) -> None:
            bar.update(step - bar.n)
            bar.set_postfix_str(f"loss {loss:.5f} psnr {psnr:.2f} dB", refresh=False)

        record = fit(
            field,
            buffer,
            steps=steps,
            batch_rays=params.paper_batch_rays if paper else params.batch_rays,
            seed=params.seed, rate=params.rate,
            exposure=params.exposure,
            average=0.0 if paper else params.average,
            shards=params.shards, threads=cores(),
            save_every=params.save_every, save=checkpoint.save, resume=resume, progress=show,
        )  # fmt: skip
    return steps, record


if __name__ == "__main__":
    run("nerf", Params, main)
