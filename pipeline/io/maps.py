"""Float maps as OpenEXR: attention in half precision, depth in single."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from pipeline.errors import UserError


def _write(
    path: Path, values: np.ndarray, channel: str, kind: str, attributes: Mapping[str, str | float]
) -> None:
    if values.ndim != 2:
        raise ValueError(f"a map is two-dimensional, got shape {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{path}: the map holds NaN or infinity")
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], 1, kind)
    spec.channelnames = (channel,)
    spec.attribute("compression", "zip")
    # The library writes the time of day otherwise, and equal maps would differ in their bytes.
    spec.attribute("DateTime", "1970:01:01 00:00:00")
    for key, value in attributes.items():
        spec.attribute(key, value)
    out = oiio.ImageOutput.create(str(path))
    if out is None:
        raise OSError(oiio.geterror())
    pixels = np.ascontiguousarray(values[..., None], np.float32)
    if not (out.open(str(path), spec) and out.write_image(pixels) and out.close()):
        raise OSError(out.geterror())


def _told(by: Any) -> str:
    """What the library says of its last failure: it quotes a damaged header, which may be no text."""
    try:
        return str(by.geterror())
    except UnicodeDecodeError:
        return "its header is damaged"


def _read(path: Path, made_by: str, size: tuple[int, int] | None) -> np.ndarray:
    if not path.is_file():
        raise UserError(f"{path} does not exist.", f"Run `python -m stages.{made_by}` first.")
    file = oiio.ImageInput.open(str(path))
    pixels = file.read_image("float") if file is not None else None
    problem = _told(file if file is not None else oiio)
    if pixels is None:
        raise UserError(
            f"{path} cannot be read ({problem}).", f"Run `python -m stages.{made_by}` again."
        )
    if pixels.ndim != 3 or pixels.shape[2] != 1:
        raise UserError(f"{path} should have one channel, it has shape {pixels.shape}.")
    if not np.isfinite(pixels).all():
        raise UserError(
            f"{path} holds NaN or infinity.", f"Run `python -m stages.{made_by}` again."
        )
    if size is not None and pixels.shape[1::-1] != size:
        raise UserError(
            f"{path} is {pixels.shape[1]}x{pixels.shape[0]}, its image {size[0]}x{size[1]}.",
            f"Run `python -m stages.{made_by}` again.",
        )
    return pixels[..., 0]


def write_map(
    path: Path, values: np.ndarray, attributes: Mapping[str, str | float] | None = None
) -> None:
    """Writes an (H, W) map as a half-precision EXR with one channel `Y`; same values, same bytes.

    `attributes` are stored in the header under their names. Raises ValueError on NaN or infinity.
    """
    _write(path, values, "Y", "half", attributes or {})


def read_map(
    path: Path, made_by: str = "attention", size: tuple[int, int] | None = None
) -> np.ndarray:
    """An (H, W) float32 map; UserError when the file is missing, damaged, or not finite.

    So it is when the map is not of `size` (width, height), its image's.
    """
    return _read(path, made_by, size)


def write_depth(path: Path, depth: np.ndarray) -> None:
    """Writes an (H, W) depth map (world units along the view axis) as a float EXR with channel `Z`."""
    _write(path, depth, "Z", "float", {})


def read_depth(
    path: Path, made_by: str = "render", size: tuple[int, int] | None = None
) -> np.ndarray:
    """An (H, W) float32 depth map; UserError when the file is missing, damaged, or not of `size` (w, h)."""
    return _read(path, made_by, size)
