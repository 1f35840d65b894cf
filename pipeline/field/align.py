"""Cameras aligned to their photos through a fitted field: Lucas and Kanade's step in six numbers.

Features give poses to a fraction of a pixel; what is left of their error blurs the field. The rendering of
a field fitted with these poses is a picture of all photos together, and laying it onto one photo uses
every dry pixel of it instead of a few hundred features (Lucas and Kanade, IJCAI 1981; through rendered
depth: Kerl et al. 2013, doi 10.1109/ICRA.2013.6631104).
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from pipeline.field.render import Intrinsics, RenderedView

RIM = 3  # pixels along the picture's edge without a say: slopes there are one-sided
BLUR = 0.7  # pixels; slopes of single pixels are mostly noise
OUTLIER = 3.0  # times the median error, from which a pixel's say falls

View = Callable[[np.ndarray], RenderedView]


def moved(cam_from_world: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """The pose (4, 4) followed by a small motion of the world in the camera's axes.

    ``twist`` (6,): a translation in the poses' unit, then a rotation vector in radians.
    """
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(np.asarray(twist[3:], float))[0], twist[:3]
    return motion @ cam_from_world


def lay_on_photo(
    photo: np.ndarray, keep_mask: np.ndarray, seen: RenderedView, intrinsics: Intrinsics
) -> np.ndarray:
    """The twist (6,) for :func:`moved` that lays a rendering onto its photo; one Gauss-Newton step.

    ``photo`` (H, W, 3) in [0, 1] and ``seen``, the field at the photo's pose, have equal size.
    A surface at x in the camera's frame moves by v + w x x, its pixel by the projection's derivative of
    that, the colour there by its slope along it. Weights are Cauchy's, so that what the field cannot show
    counts little; pixels outside ``keep_mask`` (H, W) and beside it do not count.
    """
    use = cv2.erode(keep_mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    use[:RIM], use[-RIM:], use[:, :RIM], use[:, -RIM:] = False, False, False, False
    use &= seen.depth > 0
    if np.count_nonzero(use) < 6:
        return np.zeros(6)
    soft = [cv2.GaussianBlur(one, (0, 0), BLUR) for one in (photo, seen.rgb)]
    down, right = np.gradient(0.5 * (soft[0] + soft[1]), axis=(0, 1))
    unit = float(np.median(seen.depth[use]))  # so that metres and radians weigh alike
    along_x, along_y = _flow(seen.depth[use] / unit, np.nonzero(use), intrinsics)
    jacobian = right[use][..., None] * along_x[:, None] + down[use][..., None] * along_y[:, None]
    j, error = jacobian.reshape(-1, 6), (soft[1] - soft[0])[use].ravel()
    weight = 1.0 / (1.0 + (error / (OUTLIER * np.median(np.abs(error)) + 1e-6)) ** 2)
    normal = (j * weight[:, None]).T @ j
    twist = np.linalg.solve(normal + 1e-9 * np.eye(6), (j * weight[:, None]).T @ error)
    twist[:3] *= unit
    return twist


def _flow(
    depth: np.ndarray, pixels: tuple[np.ndarray, ...], intrinsics: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """How pixels (N) at ``depth`` move in x and in y per unit of each of the six motions (N, 6)."""
    fx, fy, cx, cy, _ = intrinsics  # the radial term bends the picture, but hardly its motion
    y, x = (pixels[0] + 0.5 - cy) / fy, (pixels[1] + 0.5 - cx) / fx
    none, near = np.zeros_like(x), 1.0 / depth
    along_x = fx * np.stack([near, none, -x * near, -x * y, 1 + x * x, -y], -1)
    along_y = fy * np.stack([none, near, -y * near, -(1 + y * y), x * y, x], -1)
    return along_x, along_y


def aligned(
    photo: np.ndarray,
    keep_mask: np.ndarray,
    cam_from_world: np.ndarray,
    intrinsics: Intrinsics,
    view: View,
    steps: int,
) -> np.ndarray:
    """The pose (4, 4) at which what ``view`` renders lies best on the photo, after ``steps`` steps.

    ``view`` maps a pose to the field's rendering with the photo's size. Of all poses on the way the one
    with the least median error over ``keep_mask`` is taken: the first, if no step helps.
    """
    pose, found = cam_from_world, []
    for step in range(steps + 1):
        seen = view(pose)
        error = np.abs(seen.rgb - photo)[keep_mask]
        found.append((float(np.median(error)) if error.size else 0.0, step, pose))
        if step < steps:
            pose = moved(pose, lay_on_photo(photo, keep_mask, seen, intrinsics))
    return min(found)[2]
