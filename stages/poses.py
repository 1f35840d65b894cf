"""Structure from motion that does not see the drops: where each photo was taken from."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import Field
from tqdm import tqdm

from pipeline import sfm
from pipeline.errors import UserError
from pipeline.field.growing import aligned_poses
from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.posed import read_posed_images, refuse_too_large
from pipeline.io.scene import GIVEN_POSES, ImageRecord, read_images_json, read_origin
from pipeline.io.transforms import read_transforms, write_transforms
from pipeline.parallel import cores, map_named
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)

SETTINGS = {
    "camera", "mapper", "max_features", "max_image_size", "refine_focal", "refine_distortion",
}  # fmt: skip


class Params(Section):
    """Section `poses`."""

    use_given: bool
    use_masks: bool
    camera: Literal["single", "per_image"]
    matcher: Literal["auto", "exhaustive", "sequential"]
    mapper: Literal["incremental", "global"]
    max_features: Annotated[int, Field(ge=100, le=100_000)]
    max_image_size: Annotated[int, Field(ge=0)]
    stationary: Literal["auto", "keep", "drop"]
    refine_focal: bool
    refine_distortion: bool
    retry: bool
    min_registered: Annotated[float, Field(ge=0, le=1)]
    depth_margin: Annotated[float, Field(ge=0, lt=1)]
    align_rounds: Annotated[int, Field(ge=0, le=20)]
    align_first_steps: Annotated[int, Field(ge=1)]
    align_steps: Annotated[int, Field(ge=1)]
    align_scale: Annotated[float, Field(gt=0, le=1)]
    align_settled: Annotated[float, Field(ge=0)]
    seed: Annotated[int, Field(ge=0, lt=2**31)]


def main(job: Job, params: Params) -> str:
    """Makes `artifacts/<scene>/poses/` from the images and, with use_masks, the masks."""
    paths, records = job.paths, read_images_json(job.paths.images)
    if params.use_masks and not paths.masks.is_dir():
        raise UserError(
            f"{paths.masks} does not exist.",
            "Run `python -m stages.masks` first, or set poses.use_masks: false.",
        )
    found = _found(job, params, records)
    with publish_dir(paths.poses) as fresh:
        sfm.write_sparse(found.model, fresh / "sparse")
        write_transforms(fresh / "transforms.json", found.views.values())
        write_json(fresh / "poses.json", sfm.account(found, len(records)))
    if found.lost and len(found.model_sizes) > 1:
        log.warning("models of %s photos were found; the largest is used", found.model_sizes)
    placed = f"{len(found.views)} of {len(records)} photos placed"
    return f"{placed}, {len(found.points_xyz)} points, {found.reprojection_px:.2f} px"


def _found(job: Job, params: Params, records: Sequence[ImageRecord]) -> sfm.Reconstructed:
    """Poses and points from the photos, or the poses that came with them and points for these."""
    paths, names = job.paths, [record.name for record in records]
    masks, given = paths.masks if params.use_masks else None, paths.images / GIVEN_POSES
    keeps = params.use_given and given.is_file()
    if masks and params.align_rounds and not keeps:
        refuse_too_large(records)  # now, not after hours of matching
    with tqdm(total=len(names), desc="features", unit="photo", leave=False) as bar:
        common: dict[str, Any] = {
            "work_dir": paths.work("poses"),
            "settings": _settings(params, read_origin(paths.images).kind, len(records)),
            "progress": partial(_show, bar),
            "threads": cores(),
            **params.model_dump(include={"depth_margin", "min_registered", "seed"}),
        }
        if keeps:
            log.info("the poses that came with the photos are kept; points are found for them")
            return sfm.triangulate(paths.images, masks, names, read_transforms(given), **common)
        common["focal_px"] = {record.name: record.focal_px for record in records if record.focal_px}
        found = sfm.reconstruct(paths.images, masks, names, retry=params.retry, **common)
    if masks is None or not params.align_rounds:
        return found
    images = read_posed_images(paths.images, masks, found.views)
    each = partial(map_named, job_label="align", workers=None if job.device == "cpu" else 1)
    log.info("the cameras are aligned to the photos, in %d rounds at most", params.align_rounds)
    fits = (params.align_first_steps, *[params.align_steps] * (params.align_rounds - 1))
    poses = aligned_poses(
        images, each, fits, params.align_scale, landmarks=found.points_xyz, threads=cores(),
        settled_px=params.align_settled, seed=params.seed, device=job.device,
    )  # fmt: skip
    return sfm.with_poses(found, poses, params.depth_margin)


def _show(bar: tqdm, phase: str, done: int, total: int) -> None:
    bar.set_description_str(phase, refresh=False)
    bar.total, bar.n = total, done
    bar.refresh()


def _settings(params: Params, kind: str, count: int) -> sfm.Settings:
    still = params.stationary == "drop" or (params.stationary == "auto" and not params.use_masks)
    matcher = params.matcher if params.matcher != "auto" else sfm.fitting_matcher(kind, count)
    same = params.model_dump(include=SETTINGS)
    return sfm.Settings(**same, matcher=matcher, masked=params.use_masks, still=still)


if __name__ == "__main__":
    run("poses", Params, main)
