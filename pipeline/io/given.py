"""Cameras that come with photos, whoever found them, and nerfstudio's transforms.json.

LLFF's poses_bounds.npy is read in `pipeline.io.llff`, COLMAP models where pycolmap is (`pipeline.sfm`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.errors import UserError
from pipeline.io.atomic import read_json
from pipeline.io.transforms import GL_FROM_CV, ORIGIN, View

SAME_SHAPE = 0.01  # how far the ratios of width to height of a photo and its camera may differ
RIGID = 2e-4  # how far R R^T may be from the identity: as far as four decimals leave it
MOST_BENT = 0.25  # |k1| r^2 in the corner up to which rays through one radial term are exact
COVERED = 0.95  # a straightened picture that is filled less shows a lens model folding back
GLANCE_PX = 160  # longest side of the picture on which that is tried
_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")


@dataclass(frozen=True)
class GivenView:
    """A photo's camera as its capture tells it.

    `cam_from_world` (4, 4), OpenCV axes. `fx, fy, cx, cy` belong to an image of `width` x `height`
    pixels, pixel (0, 0)'s centre at (0.5, 0.5). `distortion` holds OpenCV's coefficients in OpenCV's
    order, of the fisheye model where `fisheye`. `near` and `far` bound the depths; 0 where unknown.
    `mask_path` is the photo's keep mask, if the capture has one.
    """

    photo: Path
    cam_from_world: np.ndarray
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    near: float = 0.0
    far: float = 0.0
    mask_path: Path | None = None

    @property
    def carried(self) -> bool:
        """Whether the project's own camera, one radial term, says the same without resampling."""
        if self.fisheye or any(self.distortion[1:]):
            return False
        x, y = 0.5 * self.width / self.fx, 0.5 * self.height / self.fy
        return not self.distortion or abs(self.distortion[0]) * (x * x + y * y) <= MOST_BENT

    def turn_for(self, stored: tuple[int, int], upright_turn: int) -> int | None:
        """Degrees ccw by which the stored pixels (w, h) become those of this camera; None: neither way."""
        for degrees in (0, upright_turn):
            width, height = stored if degrees % 180 == 0 else stored[::-1]
            if abs(width * self.height / (height * self.width) - 1) < SAME_SHAPE:
                return degrees
        return None

    def view(self, name: str, size: tuple[int, int]) -> View:
        """The project's view of the same camera for an image of `size` (w, h) without bent lines."""
        across, down = size[0] / self.width, size[1] / self.height
        return View(
            name=name,
            cam_from_world=self.cam_from_world,
            fx=self.fx * across,
            fy=self.fy * down,
            cx=self.cx * across,
            cy=self.cy * down,
            k1=self.distortion[0] if self.distortion else 0.0,
            width=size[0],
            height=size[1],
            near=self.near,
            far=self.far,
        )


def of_view(view: View) -> GivenView:
    """The same camera as one that came with photos."""
    return GivenView(
        Path(view.name), view.cam_from_world, view.width, view.height,
        view.fx, view.fy, view.cx, view.cy, (view.k1, 0.0, 0.0, 0.0), near=view.near, far=view.far,
    )  # fmt: skip


@dataclass(frozen=True)
class Straightener:
    """Takes pixels of `bent` to those of the pinhole `straight`; both see (H, W) arrays of one shape."""

    bent: GivenView
    straight: GivenView

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """The straightened picture (H, W, 3) or mask (H, W, nearest pixel)."""
        size = (pixels.shape[1], pixels.shape[0])
        source, target = _matrix(self.bent, size), _matrix(self.straight, size)
        make: Any = cv2.fisheye if self.bent.fisheye else cv2
        coefficients = np.array(self.bent.distortion, np.float64)
        across, down = make.initUndistortRectifyMap(
            source, coefficients, np.eye(3), target, size, cv2.CV_32FC1
        )
        how = cv2.INTER_NEAREST if pixels.ndim == 2 else cv2.INTER_CUBIC
        return cv2.remap(pixels, across, down, how, borderMode=cv2.BORDER_CONSTANT)


def straightened(view: GivenView) -> GivenView:
    """The pinhole without distortion whose picture of the same size is covered by `view`'s wholly.

    UserError when there is none: the lens model folds back within the photo.
    """
    size = (view.width, view.height)
    matrix, coefficients = _matrix(view, size), np.array(view.distortion, np.float64)
    if view.fisheye:
        new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
            matrix, coefficients, size, np.eye(3), balance=0.0
        )
    else:
        new = cv2.getOptimalNewCameraMatrix(matrix, coefficients, size, alpha=0.0)[0]
    # OpenCV puts the centre of pixel (0, 0) at (0, 0).
    straight = replace(
        view,
        fx=float(new[0, 0]),
        fy=float(new[1, 1]),
        cx=float(new[0, 2]) + 0.5,
        cy=float(new[1, 2]) + 0.5,
        distortion=(),
        fisheye=False,
    )
    height, width = (max(2, round(side * GLANCE_PX / max(size))) for side in size[::-1])
    filled = np.isfinite(new).all() and new[0, 0] > 0 and new[1, 1] > 0
    if (
        not filled
        or Straightener(view, straight)(np.ones((height, width), np.uint8)).mean() < COVERED
    ):
        raise UserError(
            f"{view.photo} was taken through a lens that cannot be straightened: its distortion "
            f"{view.distortion} folds the picture back.",
            "Check the distortion in the file of the poses, or undistort the photos first.",
        )
    return straight


def _matrix(view: GivenView, size: tuple[int, int]) -> np.ndarray:
    """K (3, 3) for an image of `size` in OpenCV's pixel frame."""
    across, down = size[0] / view.width, size[1] / view.height
    return np.array(
        [[view.fx * across, 0, view.cx * across - 0.5], [0, view.fy * down, view.cy * down - 0.5], [0, 0, 1]]
    )  # fmt: skip


def checked_rigid(pose: np.ndarray, whose: str) -> np.ndarray:
    """`pose` (4, 4) with the rotation nearest to its own, which its file has rounded.

    Its transpose is then its inverse; the translation stays, of a camera-to-world pose the place. UserError
    naming `whose` it is when it is no rotation and translation.
    """
    rotation = pose[:3, :3]
    rigid = np.isfinite(pose).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=RIGID)
    if not rigid or np.linalg.det(rotation) < 0:
        raise UserError(f"{whose} is not a rotation and a translation.", "Export the poses again.")
    left, _, right = np.linalg.svd(rotation)
    exact = np.eye(4)
    exact[:3, :3], exact[:3, 3] = left @ right, pose[:3, 3]
    return exact


def inverse_rigid(pose: np.ndarray) -> np.ndarray:
    """The inverse (4, 4) of a rotation and a translation: cam_from_world of a world_from_cam."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def checked_camera(view: GivenView, whose: str) -> GivenView:
    """`view` itself; UserError naming `whose` it is when its numbers are none of a camera's."""
    lens = (view.fx, view.fy, view.cx, view.cy, *view.distortion)
    if not np.isfinite([*lens, view.near, view.far]).all():
        problem = "holds numbers that are not finite"
    elif min(view.fx, view.fy, view.width, view.height) <= 0:
        problem = "has a focal length or size that is not positive"
    else:
        checked_rigid(view.cam_from_world, f"{whose}: the pose of {view.photo.name}")
        return view
    raise UserError(f"{whose}: the camera of {view.photo.name} {problem}.", "Export it again.")


def read_nerfstudio(path: Path) -> list[GivenView]:
    """The cameras of a nerfstudio (or instant-ngp) transforms.json, in the file's order.

    Intrinsics stand at the top or in each frame. A mask is read per frame, all or none. UserError for a
    damaged file, an unknown camera model, photos or masks that do not exist.
    """
    content = read_json(path)
    try:
        views = [_nerfstudio_view(path, content, frame) for frame in content["frames"]]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"{path} is not a list of posed photos ({error!r}).",
            "nerfstudio's format is expected: frames with file_path and transform_matrix.",
        ) from None
    bare = [view.photo.name for view in views if view.mask_path is None]
    if bare and len(bare) < len(views):
        raise UserError(
            f"{path} names no mask for {', '.join(bare)}.", "Give every frame a mask_path, or none."
        )
    return views


def _nerfstudio_view(path: Path, content: dict[str, Any], frame: dict[str, Any]) -> GivenView:
    both = {**content, **frame}
    model = both.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise UserError(f"{path}: the camera model {model} is not known.", f"Known: {_MODELS}.")
    photo = _existing(path, str(frame["file_path"]))
    width, height = int(both.get("w", 0)), int(both.get("h", 0))
    if not (width and height):
        raise UserError(f"{path} does not tell the photos' size.", 'Add "w" and "h" in pixels.')
    focal = float(both["fl_x"]) if "fl_x" in both else _focal(width, float(both["camera_angle_x"]))
    fisheye = model == "OPENCV_FISHEYE" or bool(both.get("is_fisheye"))  # the latter: instant-ngp's
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    world_from_gl = np.asarray(frame["transform_matrix"], np.float64).reshape(4, 4)
    world_from_gl = checked_rigid(world_from_gl, f"{path}: the pose of {photo.name}")
    world_from_gl[:3, 3] += np.asarray(content.get("world_origin", ORIGIN), np.float64).reshape(3)
    mask = frame.get("mask_path")
    view = GivenView(
        photo=photo,
        cam_from_world=inverse_rigid(world_from_gl @ GL_FROM_CV),
        width=width,
        height=height,
        fx=focal,
        fy=float(both.get("fl_y", focal)),
        cx=float(both.get("cx", width / 2)),
        cy=float(both.get("cy", height / 2)),
        distortion=tuple(float(both.get(key, 0.0)) for key in keys),
        fisheye=fisheye,
        near=float(frame.get("near", 0.0)),
        far=float(frame.get("far", 0.0)),
        mask_path=_existing(path, str(mask)) if mask else None,
    )
    return checked_camera(view, str(path))


def _focal(width: int, angle: float) -> float:
    return 0.5 * width / math.tan(0.5 * angle) if 0 < angle < math.pi else math.nan


def _existing(path: Path, relative: str) -> Path:
    """A file named by transforms.json; Blender's exports leave the suffix away."""
    for candidate in (path.parent / relative, path.parent / f"{relative}.png"):
        if candidate.is_file():
            return candidate
    raise UserError(
        f"{path} names {relative}, which does not exist.", "Keep the file beside its photos."
    )
