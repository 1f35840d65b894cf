"""A reconstruction whose cameras were moved by something else than its features."""

from __future__ import annotations

import copy
import logging
import zlib  # noqa: F401  before pycolmap, see the package
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pycolmap

from pipeline.sfm.model import points_of, views_of
from pipeline.sfm.result import Reconstructed

log = logging.getLogger(__name__)

# Times the features' own error. Measured: 0.98 to 1.16 on six rendered scenes, where the cameras' error fell to
# a half or a third; 1.39 on photos of foliage, which a field then explained less well.
OBJECTION = 1.25


def with_poses(
    found: Reconstructed, poses: Mapping[str, np.ndarray], depth_margin: float
) -> Reconstructed:
    """`found` with its cameras at `poses` (cam_from_world by name), its points where they then fit best.

    The features had no say in these poses, so they may judge them: where their error grows by more
    than OBJECTION, `found` is returned as it was, with a warning.
    """
    model = copy.deepcopy(found.model)
    for image in model.images.values():
        if image.name in poses:
            pose = poses[image.name]
            rotation = pycolmap.Rotation3d(np.ascontiguousarray(pose[:3, :3]))
            rigid = pycolmap.Rigid3d(rotation, pose[:3, 3])
            image.frame.set_cam_from_world(image.camera_id, rigid)
    _settle_points(model)
    error_px = model.compute_mean_reprojection_error()
    if not error_px <= OBJECTION * found.reprojection_px:
        log.warning(
            "the cameras stay as the features tell: aligned to the photos they would leave them "
            "%.2f instead of %.2f px off", error_px, found.reprojection_px,
        )  # fmt: skip
        return found
    xyz, rgb, error = points_of(model)
    return replace(
        found,
        views=views_of(model, depth_margin),
        points_xyz=xyz,
        points_rgb=rgb,
        points_error=error,
        reprojection_px=error_px,
        model=model,
        aligned=True,
    )


def _settle_points(model: pycolmap.Reconstruction) -> None:
    """Moves the points, and nothing else, to where they fit their observations best."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
            config.set_constant_rig_from_world_pose(image.frame_id)
            config.set_constant_cam_intrinsics(image.camera_id)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
