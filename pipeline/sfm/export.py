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

    Equal pinholes are one camera. Observations move to where the straight images show them, and those
    beyond where a lens folds back are left out; points keep what is left of their tracks. All lies in the
    coordinates that the capture came with.
    """
    out = pycolmap.Reconstruction()
    cameras = _add_cameras(out, straight)
    known = {image.name: image for image in model.images.values()}
    moved: dict[tuple[int, int], tuple[int, int]] = {}  # image and keypoint in `out`, by `model`'s
    for number, name in enumerate(sorted(straight), start=1):
        view, image = straight[name], known.get(name)
        keypoints = np.empty((0, 2))
        if image is not None:
            pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            keypoints = straightened_pixels(pixels, image.camera, view)
            seen = np.flatnonzero(np.isfinite(keypoints).all(axis=1))
            keypoints = keypoints[seen]
            for new, old in enumerate(seen.tolist()):
                moved[int(image.image_id), old] = (number, new)
        camera_id, pose = cameras[name], view.cam_from_world
        out.add_image_with_trivial_frame(
            pycolmap.Image(
                name=name, keypoints=keypoints, camera_id=camera_id, image_id=number
            ),
            pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(pose[:3, :3])), pose[:3, 3]),
        )  # fmt: skip
    for key in sorted(model.points3D):
        point = model.points3D[key]
        seen_in = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        track = [pycolmap.TrackElement(*moved[one]) for one in seen_in if one in moved]
        if len(track) >= 2:
            out.add_point3D(point.xyz, pycolmap.Track(track), point.color)
    out.update_point_3d_errors()
    origin = next(iter(straight.values())).origin
    if origin != ORIGIN:
        out.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(origin)))
    folder.mkdir(parents=True, exist_ok=True)
    out.write_binary(str(folder))


def _add_cameras(out: pycolmap.Reconstruction, straight: Mapping[str, View]) -> dict[str, int]:
    """Adds one camera per different pinhole; its id by the names of the views."""
    ids: dict[tuple[float, ...], int] = {}
    found = {}
    for name, view in sorted(straight.items()):
        pinhole = (view.fx, view.fy, view.cx, view.cy)
        if pinhole not in ids:
            ids[pinhole] = len(ids) + 1
            camera = pycolmap.Camera(
                model="PINHOLE", width=view.width, height=view.height, camera_id=ids[pinhole],
                params=list(pinhole),
            )  # fmt: skip
            out.add_camera_with_trivial_rig(camera)
        found[name] = ids[pinhole]
    return found


def straightened_pixels(pixels: np.ndarray, camera: pycolmap.Camera, straight: View) -> np.ndarray:
    """Where the pinhole `straight` shows what `camera` shows at `pixels` (N, 2); NaN where no ray leads."""
    rays = np.array(camera.cam_from_img(pixels)).reshape(-1, 2)
    return rays * [straight.fx, straight.fy] + [straight.cx, straight.cy]
