"""Where a field lives: the whole visible scene mapped into the unit cube.

Points are held components first, ``(3, ...)``: on a CPU the elementwise work of a fit then runs
over contiguous memory.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.geometry.constants import constant

# A corner ray steeper than this against the mean optical axis would leave the frustum that
# normalised device coordinates can hold.
MAX_CORNER_ANGLE_DEG = 65.0
EPS = 1e-6


def ndc(points: Tensor, near: float) -> Tensor:
    """Normalised device coordinates ``(x/z, y/z, 1 - near/z)`` of points in the reference camera.

    ``points`` ``(3, ...)``, OpenCV axes, in front of the camera; the third coordinate is 0 at the
    near plane and 1 at infinity. Straight lines stay straight: the map is projective
    (NeRF, doi:10.1145/3503250, appendix C).
    """
    x, y, z = points.unbind(0)
    inverse = 1.0 / z.clamp_min(EPS)
    return torch.stack([x * inverse, y * inverse, 1.0 - near * inverse])


def contract(points: Tensor) -> Tensor:
    """All of space inside the ball of radius 2: the identity inside the unit ball.

    ``x -> (2 - 1/|x|) x/|x|`` outside (mip-NeRF 360, doi:10.1109/CVPR52688.2022.00539, eq. 10).
    ``points`` ``(3, ...)``. The direction from the origin is kept.
    """
    x, y, z = points.unbind(0)
    norm = (x * x + y * y + z * z).sqrt().clamp_min(1.0)
    return points * ((2.0 - 1.0 / norm) / norm)


@dataclass(frozen=True)
class Space:
    """The map from the world to the unit cube that a fitted field carries with it.

    ``ref_from_world`` (3 rows of 4) is a similarity: the mean camera for ``ndc``, the normalised
    scene for ``contract``. ``low`` and ``high`` bound the scene in the mapped coordinates.
    """

    kind: str
    ref_from_world: tuple[tuple[float, ...], ...]
    near: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def warp(self, points: Tensor) -> Tensor:
        """Coordinates in [0, 1] of world points, both ``(3, ...)``; clamped at the bounds."""
        return self.cube(self.ref(points))

    def along(self, rays_o: Tensor, rays_d: Tensor, t: Tensor) -> Tensor:
        """Coordinates in [0, 1], ``(3, R, K)``, at the depths ``t`` ``(R, K)`` of rays ``(3, R)``."""
        return self.cube(
            torch.addcmul(self.ref(rays_o)[..., None], self.turned(rays_d)[..., None], t)
        )

    def ref(self, points: Tensor) -> Tensor:
        """World points ``(3, ...)`` in the space's own frame."""
        shift = constant(tuple((row[3],) for row in self.ref_from_world), points)
        return self.turned(points) + shift.view(3, *[1] * (points.dim() - 1))

    def turned(self, directions: Tensor) -> Tensor:
        """World directions ``(3, ...)`` in the space's own frame.

        No matrix product: a GPU may round those to ten bits, too few for a place.
        """
        rows = constant(tuple(row[:3] for row in self.ref_from_world), directions)
        return (rows.view(3, 3, *[1] * (directions.dim() - 1)) * directions).sum(1)

    def cube(self, ref: Tensor) -> Tensor:
        """Coordinates in [0, 1] of points ``(3, ...)`` in the space's own frame."""
        mapped = ndc(ref, self.near) if self.kind == "ndc" else contract(ref)
        sides = list(zip(self.low, self.high, strict=True))
        shape = (3, *[1] * (ref.dim() - 1))
        factor = constant(tuple(1.0 / (b - a) for a, b in sides), ref).view(shape)
        offset = constant(tuple(-a / (b - a) for a, b in sides), ref).view(shape)
        return torch.addcmul(offset, mapped, factor).clamp_(0.0, 1.0)

    def to_json(self) -> dict[str, Any]:
        """Plain numbers and lists that :meth:`from_json` takes back."""
        return asdict(self)

    @staticmethod
    def from_json(data: dict[str, Any]) -> Space:
        """The space that :meth:`to_json` described."""
        rows = tuple(tuple(float(v) for v in row) for row in data["ref_from_world"])
        low, high = (tuple(float(v) for v in data[k]) for k in ("low", "high"))
        return Space(data["kind"], rows, float(data["near"]), low, high)  # type: ignore[arg-type]


def mean_camera(cam_from_world: np.ndarray) -> np.ndarray:
    """The mean camera ``(4, 4)`` of cameras ``(V, 4, 4)``: mean centre and orthogonal mean axes."""
    rotation, translation = cam_from_world[:, :3, :3], cam_from_world[:, :3, 3]
    centre = -np.einsum("vji,vj->vi", rotation, translation).mean(0)
    u, _, vt = np.linalg.svd(rotation.mean(0))
    mean = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = mean, -mean @ centre
    return out


def is_forward_facing(cam_from_world: np.ndarray, corners: np.ndarray, near: np.ndarray) -> bool:
    """Whether normalised device coordinates can hold the scene of these cameras.

    ``corners`` ``(V, 4, 3)`` are the world directions of each image's corner rays (length 1 along
    the optical axis) and ``near`` ``(V,)`` the nearest depths: every corner ray must stay within
    65 degrees of the mean axis and every near point in front of the mean camera.
    """
    mean = mean_camera(cam_from_world)
    axis = mean[2, :3]
    unit = corners / np.linalg.norm(corners, axis=-1, keepdims=True)
    if float((unit @ axis).min()) < np.cos(np.radians(MAX_CORNER_ANGLE_DEG)):
        return False
    centres = -np.einsum("vji,vj->vi", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    nearest = centres[:, None] + corners * near[:, None, None]
    depth = nearest @ axis + mean[2, 3]
    return bool(depth.min() > 0.1 * float(np.median(near)))


def fit_space(
    kind: str,
    cam_from_world: np.ndarray,
    corners: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
) -> Space:
    """The space around what the cameras ``(V, 4, 4)`` see between ``near`` and ``far`` ``(V,)``.

    ``kind`` is ``ndc``, ``contract`` or ``auto`` (ndc for forward-facing captures). ValueError for ``ndc``
    when something that is seen lies beside or behind the mean camera.
    """
    if kind == "auto":
        kind = "ndc" if is_forward_facing(cam_from_world, corners, near) else "contract"
    centres = -np.einsum("vji,vj->vi", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    if kind == "contract":
        axes = cam_from_world[:, 2, :3]
        middle = 2.0 / (1.0 / near + 1.0 / far)
        focus = (centres + axes * middle[:, None]).mean(0)
        radius = float(np.linalg.norm(centres - focus, axis=1).max())
        matrix = np.hstack([np.eye(3), -focus[:, None]]) / max(radius, EPS)
        return Space(kind, _rows(matrix), 1.0, (-2.0,) * 3, (2.0,) * 3)
    mean = mean_camera(cam_from_world)
    # Frustum samples between near and far: their extent is what the unit cube has to hold.
    disparity = np.linspace(0, 1, 9)
    depth = 1.0 / ((1 - disparity) / near[:, None] + disparity / far[:, None])
    points = centres[:, None, None] + corners[:, :, None] * depth[:, None, :, None]
    ref = points.reshape(-1, 3) @ mean[:3, :3].T + mean[:3, 3]
    nearest = float(ref[:, 2].min())
    if nearest <= EPS:
        raise ValueError("what the cameras see lies on all sides of the mean camera")
    mapped = ndc(torch.from_numpy(ref.T.copy()), nearest).numpy()
    low, high = mapped.min(1), mapped.max(1)
    high = np.maximum(high, low + EPS)
    return Space("ndc", _rows(mean[:3]), nearest, _triple(low), _triple(high))


def _rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in matrix)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
