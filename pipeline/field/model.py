"""A field and the few numbers that it takes to build it again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Protocol

import numpy as np
import torch

from pipeline.errors import UserError
from pipeline.field.grid_field import GridConfig, GridField
from pipeline.field.paper_field import PaperConfig, PaperField
from pipeline.geometry.rays import FOLDS, UNDISTORT_STEPS
from pipeline.geometry.spaces import Space, fit_space
from pipeline.io.processor import multiplies_bfloat16

# A contracted space holds all that is around the cameras: what they look at fills about a quarter of its sides,
# and a ray finds the surface with fewer of its samples.
CONTRACTED_FINER = 4
CONTRACTED_SAMPLES = 32
CONTRACTED_BINS = 64
# Most of its table's rows are met by few rays: what these leave there should fade sooner.
CONTRACTED_DECAY = 3.0
# k1 r^2 of a corner; with less, sides reach less than a two hundredth beyond the corners.
BULGES = 0.02


class Camera(Protocol):
    """What a field needs of a view: ``cam_from_world`` ``(4, 4)``, fx, fy, cx, cy, k1, the size."""

    @property
    def cam_from_world(self) -> np.ndarray: ...
    @property
    def intrinsics(self) -> tuple[float, float, float, float, float]: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...


def scene_space(
    kind: str, cams: np.ndarray, intrinsics: np.ndarray, sizes: np.ndarray, near: float, far: float
) -> Space:
    """The :class:`Space` around what cameras see between the depths ``near`` and ``far``.

    ``cams`` ``(V, 4, 4)`` cam_from_world, ``intrinsics`` ``(V, 5)`` fx, fy, cx, cy, k1, ``sizes``
    ``(V, 2)`` width and height; ``kind`` is ndc, contract or auto.
    """
    k1 = intrinsics[:, 4]
    sides = [(sizes * end - intrinsics[:, 2:4]) / intrinsics[:, :2] for end in (0, 1)]
    corners = np.empty((len(cams), 4, 3))
    for i, (right, bottom) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        x, y = sides[right][:, 0], sides[bottom][:, 1]
        # With k1 > 0 a side reaches farthest where it is nearest to the optical axis, not at its ends: these
        # are then the corners of the upright rectangle around all that the camera sees.
        bulges = k1 * (x * x + y * y) > BULGES
        beside_x, beside_y = np.where(bulges, np.clip(0.0, *sides).T, [x, y])
        x, y = x / _gain(x, beside_y, k1), y / _gain(beside_x, y, k1)
        corners[:, i] = np.einsum(
            "vji,vj->vi", cams[:, :3, :3], np.stack([x, y, np.ones_like(x)], -1)
        )
    count = len(cams)
    return fit_space(kind, cams, corners, np.full(count, near), np.full(count, far))


def _gain(x: np.ndarray, y: np.ndarray, k1: np.ndarray) -> np.ndarray:
    """How many times farther from the axis places x, y ``(V,)`` of photos lie than without the lens's k1."""
    gain = 1.0 + k1 * (x * x + y * y)
    # For bounds a thousandth is enough: one step for most lenses.
    for _ in range(UNDISTORT_STEPS):
        better = np.maximum(1.0 + k1 * (x * x + y * y) / gain**2, FOLDS)
        if np.abs(better / gain - 1.0).max() < 1e-3:
            break
        gain = better
    return gain


def grid_sizes(space: Space, fine: int) -> dict[str, tuple[int, int, int]]:
    """``coarse``, ``fine`` and ``proposal`` vertices per axis.

    ``fine`` along the longer side of what the cameras look at, which in a contracted space is a quarter of
    the cube.
    """
    if space.kind == "contract":
        return {
            "coarse": (24,) * 3,
            "fine": (CONTRACTED_FINER * fine,) * 3,
            "proposal": (96,) * 3,
        }
    width, height = (space.high[i] - space.low[i] for i in range(2))
    longest = max(width, height)

    def across(count: int, depth: int) -> tuple[int, int, int]:
        return (
            max(2, round(count * width / longest)),
            max(2, round(count * height / longest)),
            depth,
        )

    return {
        "coarse": across(24, 16),
        "fine": across(fine, max(16, fine // 12)),
        "proposal": across(64, 48),
    }


def half_is_fast(model: str, device: str) -> bool:
    """Whether products of bfloat16 numbers make steps of ``model`` faster on ``device``.

    The fast field's where the processor multiplies them by itself; on a GPU products are the least of
    its step, and converting costs more. The paper's, all products, on a GPU alone.
    """
    if model == "paper":
        return device != "cpu" and multiplies_bfloat16(device)
    return device == "cpu" and multiplies_bfloat16()


def build(model: str, config: Mapping[str, Any], space: Space, seed: int) -> GridField | PaperField:
    """A fresh field: ``fast`` or ``paper``. ``config`` overrides fields of its config class."""
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in config.items()}
    if model == "paper":
        return PaperField(PaperConfig(**values), space, seed)
    return GridField(GridConfig(**values), space, seed)


def build_around(
    model: str,
    cameras: Sequence[Camera],
    near: float,
    far: float,
    *,
    space: str = "auto",
    seed: int = 0,
    resolution: int = 512,
    precision: str = "auto",
    device: str = "cpu",
    **config: Any,
) -> GridField | PaperField:
    """A fresh field around what ``cameras`` see between the depths ``near`` and ``far``.

    ``space`` as in :func:`scene_space`; ``resolution`` vertices of the fast field's finest grid
    along the longer side; ``precision`` of the products is float32, bfloat16 (the paper's on a
    GPU alone) or auto: :func:`half_is_fast` on ``device``, on which the field lies. ``config``
    overrides fields of GridConfig (the paper's has none here); samples and bins are raised to what a
    contracted space needs, and its ``decay`` is a multiple of what is given.
    """
    cams = np.stack([camera.cam_from_world for camera in cameras])
    intrinsics = np.array([camera.intrinsics for camera in cameras])
    sizes = np.array([(camera.width, camera.height) for camera in cameras])
    try:
        around = scene_space(space, cams, intrinsics, sizes, near, far)
    except ValueError as error:
        raise UserError(
            f"nerf.space: {space} cannot hold this scene: {error}.", "Use auto or contract."
        ) from None
    half = half_is_fast(model, device) if precision == "auto" else precision == "bfloat16"
    if model == "paper":
        half = half and device != "cpu"
        return build("paper", {"half": half}, around, seed).to(device)
    config = config | grid_sizes(around, resolution) | {"half": half}
    if around.kind == "contract":
        config["samples"] = max(config.get("samples", GridConfig.samples), CONTRACTED_SAMPLES)
        config["bins"] = max(config.get("bins", GridConfig.bins), CONTRACTED_BINS)
        config["decay"] = CONTRACTED_DECAY * config.get("decay", GridConfig.decay)
    return build("fast", config, around, seed).to(device)


def describe(field: GridField | PaperField) -> dict[str, Any]:
    """What :func:`restore` needs beside the tensors: model, config and space, as plain numbers."""
    name = "paper" if isinstance(field, PaperField) else "fast"
    return {"model": name, "config": asdict(field.config), "space": field.space.to_json()}


def _checked(space: Space) -> Space:
    """``space`` itself; ValueError when its numbers bound nothing."""
    rows, sides = space.ref_from_world, list(zip(space.low, space.high, strict=True))
    if space.kind not in ("ndc", "contract") or [len(row) for row in rows] != [4] * 3:
        raise ValueError("its space is of no known kind")
    numbers = np.array([space.near, *space.low, *space.high, *(v for row in rows for v in row)])
    if not np.isfinite(numbers).all() or space.near <= 0:
        raise ValueError("its space has no bounds")
    if len(sides) != 3 or not all(low < high for low, high in sides):
        raise ValueError("its space holds nothing")
    return space


def restore(
    description: Mapping[str, Any], tensors: Mapping[str, np.ndarray]
) -> GridField | PaperField:
    """The field that :func:`describe` described, with its fitted tensors."""
    try:
        space = _checked(Space.from_json(description["space"]))
        field = build(description["model"], description["config"], space, 0)
        if not all(np.isfinite(array).all() for array in tensors.values()):
            raise ValueError("its numbers are not all finite")
        field.load_state_dict({name: torch.from_numpy(a.copy()) for name, a in tensors.items()})
    except (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        RuntimeError,
    ) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise UserError(
            f"The fitted field cannot be read back: {reason}.",
            hint="Run `python -m stages.nerf` again.",
        ) from None
    return field
