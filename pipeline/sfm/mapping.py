"""From matches to models: pycolmap's incremental and global mappers, single-threaded and seeded."""

from __future__ import annotations

import shutil
import zlib  # noqa: F401  before pycolmap, see the package
from pathlib import Path

import pycolmap

from pipeline.sfm.database import Progress
from pipeline.sfm.model import SMALLEST_MODEL
from pipeline.sfm.result import Settings

LOOSE_MATCHES = 10
LOOSE_INLIERS = 15
LOOSE_INLIER_RATIO = 0.15


def map_images(
    database: Path,
    image_dir: Path,
    work_dir: Path,
    total: int,
    settings: Settings,
    *,
    seed: int,
    progress: Progress,
) -> list[pycolmap.Reconstruction]:
    """All models that the matches in `database` give, in the solver's order; maybe none."""
    out = work_dir / "models"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    pycolmap.set_random_seed(seed)
    if settings.mapper == "global":
        progress("placing", 0, total)
        models = pycolmap.global_mapping(database, image_dir, out, _global(settings, seed))
    else:
        placed = 0

        def first_pair() -> None:
            nonlocal placed
            placed = 2
            progress("placing", placed, total)

        def next_image() -> None:
            nonlocal placed
            placed = min(placed + 1, total)
            progress("placing", placed, total)

        models = pycolmap.incremental_mapping(
            database,
            image_dir,
            out,
            _incremental(settings, seed),
            initial_image_pair_callback=first_pair,
            next_image_callback=next_image,
        )
    progress("placing", total, total)
    return [models[key] for key in sorted(models)]


def _incremental(settings: Settings, seed: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=seed,
        min_model_size=SMALLEST_MODEL,
        ba_refine_focal_length=settings.refine_focal,
        ba_refine_extra_params=settings.refine_distortion,
        ba_refine_principal_point=False,
    )
    options.mapper.abs_pose_refine_focal_length = settings.refine_focal
    options.mapper.abs_pose_refine_extra_params = settings.refine_distortion
    if settings.loose:
        options.min_num_matches = LOOSE_MATCHES
        options.mapper.abs_pose_min_num_inliers = LOOSE_INLIERS
        options.mapper.abs_pose_min_inlier_ratio = LOOSE_INLIER_RATIO
    return options


def _global(settings: Settings, seed: int) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions(
        num_threads=1, random_seed=seed, min_model_size=SMALLEST_MODEL
    )
    options.mapper.bundle_adjustment.refine_focal_length = settings.refine_focal
    options.mapper.bundle_adjustment.refine_extra_params = settings.refine_distortion
    if settings.loose:
        options.min_num_matches = LOOSE_MATCHES
    return options
