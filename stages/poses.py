"""Structure from motion that does not see the drops: where each photo was taken from."""

from __future__ import annotations

import logging
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import Field
from tqdm import tqdm

from pipeline import sfm
from pipeline.errors import UserError
from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.scene import GIVEN_POSES, ImageRecord, read_images_json, read_origin
from pipeline.io.transforms import read_transforms, write_transforms
from pipeline.parallel import cores
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)


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
    seed: Annotated[int, Field(ge=0, lt=2**31)]


def main(job: Job, params: Params) -> str:
    """Makes `artifacts/<scene>/poses/` from the images and, with use_masks, the masks."""
    paths = job.paths
    records = read_images_json(paths.images)
    if params.use_masks and not paths.masks.is_dir():
        raise UserError(
            f"{paths.masks} does not exist.",
            "Run `python -m stages.masks` first, or set poses.use_masks: false.",
        )
    with tqdm(unit="photo", leave=False) as bar:
        found = _found(job, params, records, partial(_show, bar))
    with publish_dir(paths.poses) as fresh:
        sfm.write_sparse(found.model, fresh / "sparse")
        write_transforms(fresh / "transforms.json", found.views.values())
        write_json(fresh / "poses.json", sfm.account(found, len(records)))
    if found.lost and len(found.model_sizes) > 1:
        log.warning("models of %s photos were found; the largest is used", found.model_sizes)
    return (
        f"{len(found.views)} of {len(records)} photos placed, {len(found.points_xyz)} points, "
        f"{found.reprojection_px:.2f} px"
    )


def _found(
    job: Job, params: Params, records: list[ImageRecord], progress: sfm.Progress
) -> sfm.Reconstructed:
    """Poses and points from the photos, or the poses that came with them and points for these."""
    paths, names = job.paths, [record.name for record in records]
    masks = paths.masks if params.use_masks else None
    common: dict[str, Any] = {
        "work_dir": paths.work("poses"),
        "settings": _settings(params, read_origin(paths.images).kind, len(records)),
        "depth_margin": params.depth_margin,
        "seed": params.seed,
        "threads": cores(),
        "progress": progress,
    }
    given = paths.images / GIVEN_POSES
    if params.use_given and given.is_file():
        log.info("the poses that came with the photos are kept; points are found for them")
        return sfm.triangulate(paths.images, masks, names, read_transforms(given), **common)
    return sfm.reconstruct(
        paths.images,
        masks,
        names,
        focal_px={record.name: record.focal_px for record in records if record.focal_px},
        min_registered=params.min_registered,
        retry=params.retry,
        **common,
    )


def _show(bar: tqdm, phase: str, done: int, total: int) -> None:
    bar.set_description_str(phase, refresh=False)
    bar.total, bar.n = total, done
    bar.refresh()


def _settings(params: Params, kind: str, count: int) -> sfm.Settings:
    same = ("camera", "mapper", "max_features", "max_image_size")
    still = params.stationary == "drop" or (params.stationary == "auto" and not params.use_masks)
    return sfm.Settings(
        **{key: getattr(params, key) for key in same},
        matcher=params.matcher if params.matcher != "auto" else sfm.fitting_matcher(kind, count),
        masked=params.use_masks,
        still=still,
        refine_focal=params.refine_focal,
        refine_distortion=params.refine_distortion,
    )


if __name__ == "__main__":
    run("poses", Params, main)
