"""The scene as a COLMAP model without distortion, for whoever reads COLMAP's files."""

from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, see the package
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.errors import UserError
from pipeline.io.transforms import ORIGIN, View
from pipeline.sfm.model import points_of


def read_sparse(folder: Path) -> pycolmap.Reconstruction:
    """The model that the stage `poses` wrote; UserError when missing or damaged."""
    try:
        return pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, IndexError, KeyError, MemoryError) as error:
        raise UserError(
            f"{folder} is not a readable COLMAP model ({error}).",
            "Run `python -m stages.poses` again.",
        ) from None


def sparse_points(model: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) and colours (N, 3) uint8 of a model."""
    return points_of(model)[:2]


def write_straight(
    model: pycolmap.Reconstruction, straight: Mapping[str, View], folder: Path
) -> None:
    """Writes the images `straight` (pinholes, by name) of `model` with its points, binary, to `folder`.

    Observations move to where the straight images show them; points keep their tracks. Both lie in the
    coordinates that the capture came with.
    """
    out = pycolmap.Reconstruction()
    first = next(iter(straight.values()))
    camera = pycolmap.Camera(
        model="PINHOLE", width=first.width, height=first.height, camera_id=1,
        params=[first.fx, first.fy, first.cx, first.cy],
    )  # fmt: skip
    out.add_camera_with_trivial_rig(camera)
    placed: dict[int, int] = {}  # the id of an image in `model`, by its id in `out`
    images = sorted(model.images.values(), key=lambda image: image.name)
    for image in images:
        if image.name not in straight or not image.has_pose:
            continue
        view = straight[image.name]
        keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        number = len(placed) + 1
        placed[int(image.image_id)] = number
        pose = view.cam_from_world
        out.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name,
                keypoints=straightened_pixels(keypoints, image.camera, view),
                camera_id=1,
                image_id=number,
            ),
            pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(pose[:3, :3])), pose[:3, 3]),
        )
    for key in sorted(model.points3D):
        point = model.points3D[key]
        track = pycolmap.Track(
            [
                pycolmap.TrackElement(placed[element.image_id], element.point2D_idx)
                for element in point.track.elements
                if element.image_id in placed
            ]
        )
        if len(track.elements) >= 2:
            out.add_point3D(point.xyz, track, point.color)
    out.update_point_3d_errors()
    if first.origin != ORIGIN:
        out.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(first.origin)))
    folder.mkdir(parents=True, exist_ok=True)
    out.write_binary(str(folder))


def straightened_pixels(pixels: np.ndarray, camera: pycolmap.Camera, straight: View) -> np.ndarray:
    """Where the pinhole `straight` shows what `camera` shows at `pixels` (N, 2)."""
    rays = np.array(camera.cam_from_img(pixels)).reshape(-1, 2)
    return rays * [straight.fx, straight.fy] + [straight.cx, straight.cy]
