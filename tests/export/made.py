"""A scene of a grey wall with every artifact that an export reads, worked out by hand."""

from __future__ import annotations

import zlib  # noqa: F401
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.io.images import write_image
from pipeline.io.made_of import write_inputs
from pipeline.io.maps import write_depth
from pipeline.io.masks import write_keep_mask
from pipeline.io.scene import ImageRecord, write_images_json
from pipeline.io.transforms import ORIGIN, Place, View, write_transforms
from pipeline.sfm import write_sparse
from pipeline.stage import Job
from stages import export

WIDTH, HEIGHT, K1 = 80, 60, 0.08
NAMES = ("a.png", "b.png", "c.png")
PARAMS = export.Params(
    formats="all", images="wet", llff_factor=2, dense_step=1, dense_agreeing=1
)  # fmt: skip
WET, CLEAN = 0.5, 0.25  # grey of the photos and of their cleaned forms


def lens_at(name: str, x: float, k1: float = K1, focal: float = 70.0) -> View:
    """A camera at (x, 0, 0) that looks along z."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return View(name, pose, focal, focal, WIDTH / 2, HEIGHT / 2, k1, WIDTH, HEIGHT, 1.5, 4.0)


VIEWS = [lens_at(name, 0.1 * number) for number, name in enumerate(NAMES)]
POINTS = np.array([[0.2, 0.1, 2.0], [-0.3, 0.2, 2.0], [0.1, -0.4, 2.0]])


def bent(points: np.ndarray, view: View) -> np.ndarray:
    """Pixels of world points (N, 3) through the view's lens, written out."""
    cam = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    x, y = cam[:, 0] / cam[:, 2], cam[:, 1] / cam[:, 2]
    gain = 1 + view.k1 * (x * x + y * y)
    return np.stack([view.fx * x * gain + view.cx, view.fy * y * gain + view.cy], axis=1)


def model(
    views: Sequence[View] = VIEWS, strays: np.ndarray | None = None
) -> pycolmap.Reconstruction:
    """The views with the points that each sees, ids from 5; the first view's first keypoints are `strays`."""
    made = pycolmap.Reconstruction()
    before = np.empty((0, 2)) if strays is None else strays
    for number, one in enumerate(views, start=5):
        camera = pycolmap.Camera(
            model="OPENCV", width=WIDTH, height=HEIGHT, camera_id=number,
            params=[*one.intrinsics, 0.0, 0.0, 0.0],
        )  # fmt: skip
        made.add_camera_with_trivial_rig(camera)
        keypoints = bent(POINTS, one)
        if number == 5:
            keypoints = np.concatenate([before, keypoints])
        pose = one.cam_from_world
        made.add_image_with_trivial_frame(
            pycolmap.Image(
                name=one.name, keypoints=keypoints, camera_id=number, image_id=number
            ),
            pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(pose[:3, :3])), pose[:3, 3]),
        )  # fmt: skip
    for index, point in enumerate(POINTS):
        places = [(n, index + (len(before) if n == 5 else 0)) for n in range(5, 5 + len(views))]
        track = pycolmap.Track([pycolmap.TrackElement(*place) for place in places])
        made.add_point3D(point, track, np.array([10, 20, 30], np.uint8))
    return made


def scene(
    root: Path,
    views: Sequence[View] = VIEWS,
    *,
    origin: Place = ORIGIN,
    held_out: Sequence[str] = (),
    lost: Sequence[str] = (),
    rendered: Sequence[str] | None = None,
) -> Job:
    """The scene before its export: a wall at depth 2, dropped at the left in b.

    `lost` photos have no pose; `rendered` are the names with views, all posed ones for None.
    """
    job = Job(root, "made", None, "cpu", None, False)
    paths = job.paths
    names = sorted([*(one.name for one in views), *lost])
    for name in names:
        keep_mask = np.ones((HEIGHT, WIDTH), bool)
        keep_mask[:, :20] = name != "b.png"
        write_image(paths.images / name, np.full((HEIGHT, WIDTH, 3), WET))
        write_keep_mask(paths.masks / name, keep_mask)
    records = [
        ImageRecord(n, n, "", WIDTH, HEIGHT, None, "test" if n in held_out else "train", 0)
        for n in names
    ]
    write_images_json(paths.images, records)
    shifted = [replace(one, origin=origin) for one in views]
    write_transforms(paths.poses / "transforms.json", shifted)
    write_sparse(model(views), paths.poses / "sparse")
    for name in [one.name for one in views] if rendered is None else rendered:
        write_image(paths.views / "composite" / name, np.full((HEIGHT, WIDTH, 3), CLEAN))
        kind = "test" if name in held_out else "input"
        write_image(paths.views / kind / name, np.full((HEIGHT, WIDTH, 3), CLEAN))
        (paths.views / "depth").mkdir(exist_ok=True)
        depth = np.full((HEIGHT, WIDTH), 2.0)
        write_depth(paths.views / f"depth/{Path(name).stem}.exr", depth)
        write_inputs(paths.views, paths)
    return job


def exported(job: Job, **values: object) -> Path:
    """The folder `export/` of a scene, written with PARAMS but for `values`."""
    export.main(job, PARAMS.model_copy(update=values))
    return job.paths.out / "export"
