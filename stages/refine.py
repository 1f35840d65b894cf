"""Masks repaired from the scene: where it disagrees with the photos on the glass, there is water."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pipeline.field.growing import GrowingField
from pipeline.io.accounts import MASKS
from pipeline.io.atomic import publish_dir, read_json, write_json
from pipeline.io.images import write_image
from pipeline.io.maps import read_map, write_map
from pipeline.io.masks import copy_keep_masks, write_drop_masks
from pipeline.io.posed import LOOP_BYTES, PosedImage, read_posed_images
from pipeline.io.transforms import read_transforms
from pipeline.masking.account import account
from pipeline.masking.align import held_bytes
from pipeline.masking.glass import GlassCamera
from pipeline.masking.loop import repair
from pipeline.masking.residual import residual
from pipeline.parallel import cores, map_named
from pipeline.stage import Job, Section, run

REPAIR = {"rounds", "mode", "agreement", "quantile", "window", "dilation", "contrast", "settled"}
BEYOND = 1.5  # the pane may stand behind the nearest sparse points: some of those lie on it


class Params(Section):
    """The section `refine` of params.yaml."""

    rounds: Annotated[int, Field(ge=0, le=20)]
    start: Literal["gathered", "masks", "none"]
    mode: Literal["auto", "lens", "pane"]
    agreement: Annotated[float, Field(ge=0, le=1)]
    first_steps: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=1)]
    batch_rays: Annotated[int, Field(ge=64, le=65536)]
    shards: Annotated[int, Field(ge=1, le=64)]
    rate: Annotated[float, Field(gt=0, le=10)]
    quantile: Annotated[float, Field(ge=0, le=1)]
    window: Annotated[int, Field(ge=0)] | Literal["auto"]
    witnesses: Annotated[int, Field(ge=0)]
    dilation: Annotated[int, Field(ge=0, le=100)]
    contrast: Annotated[float, Field(ge=1)]
    settled: Annotated[float, Field(ge=0, le=1)]
    far_factor: Annotated[float, Field(ge=1, le=100)]
    seed: Annotated[int, Field(ge=0, lt=2**31)]


def main(job: Job, params: Params) -> str:
    """Makes `refine/` from the images, their masks, attention maps and poses."""
    paths = job.paths
    given = read_json(paths.masks / "masks.json", "masks", MASKS)["mode"] == "given"
    if given or not params.rounds:
        why = "they came with the photos" if given else "refine.rounds is 0"
        with publish_dir(paths.refine) as fresh:
            copy_keep_masks(paths.masks, fresh)
            write_json(fresh / "refine.json", {"mode": "none", "why": why, "rounds": {}})
        return f"the masks stay as they are: {why}"
    keep_masks = paths.masks if params.start != "none" else None
    views = read_transforms(paths.poses / "transforms.json")
    held = max([LOOP_BYTES, *(held_bytes(view.width * view.height) for view in views.values())])
    images = read_posed_images(paths.images, keep_masks, views, held)
    records, posed = [image.record for image in images], [image.view for image in images]
    field = GrowingField(images, params.far_factor, params.seed, job.device)
    with publish_dir(paths.refine) as fresh:
        copy_keep_masks(paths.masks, fresh)
        done = repair(
            lambda drop_masks, found: _look(job, params, field, drop_masks, fresh / "rounds"),
            [read_map(paths.attention / f"{r.stem}.exr", size=r.size) for r in records],
            [GlassCamera(v.cam_from_world, v.intrinsics, v.width, v.height) for v in posed],
            [~image.keep_mask for image in images],
            BEYOND * field.near,
            use_attention=params.start != "none",
            gather_attention=params.start == "gathered",
            **params.model_dump(include=REPAIR),
        )
        names = [record.name for record in records]
        for number, one in enumerate(done.rounds):
            write_drop_masks(fresh / f"rounds/{number}/masks", names, one.drop_masks)
            if one.redrawn is not None:
                write_map(fresh / f"rounds/{number}/residual.exr", one.redrawn.gathered)
        write_drop_masks(fresh, names, done.rounds[-1].drop_masks)
        write_json(fresh / "refine.json", told := account(done, names))
    rounds = "1 round" if len(done.rounds) == 2 else f"{len(done.rounds) - 1} rounds"
    return f"{rounds}, {100 * told['mean_coverage']:.1f} % masked, {told['why']}"


def _look(
    job: Job, params: Params, field: GrowingField, drop_masks: Sequence[np.ndarray], rounds: Path
) -> list[np.ndarray | None]:
    """The residuals of the fitted images after a further fit; None for the held-out ones."""
    drops = {i.record.name: mask for i, mask in zip(field.images, drop_masks, strict=True)}
    steps = params.steps if (number := len(field.psnr)) else params.first_steps
    field.fit(drops, steps, params.batch_rays, cores(), params.shards, params.rate)

    def looked(image: PosedImage) -> tuple[np.ndarray, np.ndarray]:
        """Depth and residual of a view. Its picture is let go: of hundreds it would fill the memory."""
        name, seen = image.record.name, field.view(image)
        if image.record.split != "train":
            write_image(rounds / f"{number}/test/{name}", seen.rgb)
        return seen.depth, residual(seen.rgb, image.rgb, ~drops[name], True)

    tasks = {image.record.name: (image,) for image in field.images}
    workers = None if job.device == "cpu" else 1
    views = map_named(looked, tasks, job_label="render", workers=workers)
    depths, each = {n: view[0] for n, view in views.items()}, partial(map_named, job_label="trust")
    sure = field.sure(depths, drops, params.witnesses, each)
    nan = np.float32(np.nan)
    return [np.where(sure[n], views[n][1], nan) if n in sure else None for n in drops]


if __name__ == "__main__":
    run("refine", Params, main)
