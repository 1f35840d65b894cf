"""Coloured points as binary PLY, which every viewer of point clouds opens."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from pipeline.io.atomic import write_bytes
from pipeline.io.transforms import ORIGIN, Place

_COLOURS = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *_COLOURS])
_FAR_POINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), *_COLOURS])


def write_ply(path: Path, xyz: np.ndarray, rgb: np.ndarray, origin: Place = ORIGIN) -> None:
    """Writes points (N, 3) in world units, counted from `origin`, and their colours (N, 3) uint8.

    Places are floats; around an origin of their own doubles, as 32 bits do not reach that far.
    """
    if xyz.shape != rgb.shape or rgb.dtype != np.uint8:
        raise ValueError(f"points {xyz.shape} need as many uint8 colours, got {rgb.shape}")
    kind, number = (_POINT, "float") if origin == ORIGIN else (_FAR_POINT, "double")
    points = np.empty(len(xyz), kind)
    places = xyz if origin == ORIGIN else xyz + np.array(origin)
    for index, axis in enumerate("xyz"):
        points[axis] = places[:, index]
    for index, colour in enumerate(("red", "green", "blue")):
        points[colour] = rgb[:, index]
    fields = "".join(
        f"property {number if name in 'xyz' else 'uchar'} {name}\n" for name in kind.names or ()
    )
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{fields}end_header\n"
    write_bytes(path, head.encode("ascii") + points.tobytes())


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) float32 or float64 and colours (N, 3) uint8 of a file that `write_ply` wrote."""
    data = path.read_bytes()
    head, end, body = data.partition(b"end_header\n")
    words = head.split()
    if not end or b"vertex" not in words:
        raise UserError(f"{path} is not a PLY file of points.")
    kind = _FAR_POINT if b"double" in words else _POINT
    points = np.frombuffer(body, kind, int(words[words.index(b"vertex") + 1]))
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1)
    return xyz, np.stack([points[colour] for colour in ("red", "green", "blue")], axis=1)
