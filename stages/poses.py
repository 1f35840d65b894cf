"""Structure from motion that does not see the drops: where each photo was taken from."""

from __future__ import annotations

import logging
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from tqdm import tqdm

from pipeline.errors import UserError
from pipeline.io.atomic import publish_dir, write_json
from pipeline.io.scene import ImageRecord, read_images_json
from pipeline.io.transforms import write_transforms
from pipeline.parallel import cores
from pipeline.sfm import Reconstructed, Settings, reconstruct, write_sparse
from pipeline.stage import Job, Section, run

log = logging.getLogger(__name__)


class Params(Section):
    """Section `poses`."""

    use_masks: bool
    camera: Literal["single", "per_image"]
    matcher: Literal["exhaustive", "sequential"]
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
        found = reconstruct(
            paths.images,
            paths.masks if params.use_masks else None,
            [record.name for record in records],
            work_dir=paths.work("poses"),
            settings=_settings(params),
            focal_px={record.name: record.focal_px for record in records if record.focal_px},
            min_registered=params.min_registered,
            depth_margin=params.depth_margin,
            retry=params.retry,
            seed=params.seed,
            threads=cores(),
            progress=partial(_show, bar),
        )
    with publish_dir(paths.poses) as fresh:
        write_sparse(found.model, fresh / "sparse")
        write_transforms(fresh / "transforms.json", found.views.values())
        write_json(fresh / "poses.json", _summary(found, records))
    if found.lost and len(found.model_sizes) > 1:
        log.warning("models of %s photos were found; the largest is used", found.model_sizes)
    return (
        f"{len(found.views)} of {len(records)} photos placed, {len(found.points_xyz)} points, "
        f"{found.reprojection_px:.2f} px"
    )


def _show(bar: tqdm, phase: str, done: int, total: int) -> None:
    bar.set_description_str(phase, refresh=False)
    bar.total, bar.n = total, done
    bar.refresh()


def _settings(params: Params) -> Settings:
    same = ("camera", "matcher", "mapper", "max_features", "max_image_size")
    still = params.stationary == "drop" or (params.stationary == "auto" and not params.use_masks)
    return Settings(
        **{key: getattr(params, key) for key in same},
        masked=params.use_masks,
        still=still,
        refine_focal=params.refine_focal,
        refine_distortion=params.refine_distortion,
    )


def _summary(found: Reconstructed, records: list[ImageRecord]) -> dict[str, Any]:
    """What poses.json holds: who was placed, who was not and why, and what was tried."""
    return {
        "total": len(records),
        "registered": sorted(found.views),
        "lost": [vars(image) for image in found.lost],
        "images": {
            name: {"keypoints": count, "best_match": found.matching.best_match[name]}
            for name, count in found.matching.keypoints.items()
        },
        "reprojection_px": round(found.reprojection_px, 6),
        "points": len(found.points_xyz),
        "model_sizes": found.model_sizes,
        "focal_px": round(float(np.median([view.fx for view in found.views.values()])), 4),
        "masked": found.settings.masked,
        "stationary_dropped": found.settings.still,
        "tried": [
            {**vars(one), "reprojection_px": one.reprojection_px and round(one.reprojection_px, 6)}
            for one in found.attempts
        ],
    }


if __name__ == "__main__":
    run("poses", Params, main)
