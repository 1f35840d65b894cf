"""Whether the files of a binary COLMAP model are whole.

pycolmap does not ask: of a file that is cut short it reads numbers that are not there, now and then a
count of millions of millions that it then waits for. The formats are those of COLMAP 3.12 and later
(`scene/reconstruction_io_binary.cc`); older ones lack rigs.bin and frames.bin.
"""

from __future__ import annotations

import struct
import zlib  # noqa: F401  before pycolmap, see the package
from collections.abc import Callable
from pathlib import Path

import pycolmap

from pipeline.errors import UserError

_POSE = 7 * 8  # a quaternion and a translation
_SENSOR = 4 + 4  # its kind and its number


class _Bytes:
    """The bytes of a file, gone through from the start; EOFError past the end."""

    def __init__(self, content: bytes) -> None:
        self.content, self.at = content, 0

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.content):
            raise EOFError

    def number(self, kind: str) -> int:
        """The next one: "I" of 4 bytes, "i" of 4 with a sign, "Q" of 8, "B" of 1."""
        start = self.at
        self.skip(struct.calcsize(f"<{kind}"))
        return int(struct.unpack_from(f"<{kind}", self.content, start)[0])

    def text(self) -> None:
        """Past the next zero, which ends a name."""
        end = self.content.find(b"\0", self.at)
        if end < 0:
            raise EOFError
        self.at = end + 1


def _camera(file: _Bytes) -> None:
    file.skip(4)
    kind = file.number("i")
    file.skip(2 * 8)
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(kind), 1.0, 1, 1)
    file.skip(8 * len(camera.params))


def _rig(file: _Bytes) -> None:
    file.skip(4)
    sensors = file.number("I")
    file.skip(_SENSOR * min(sensors, 1))
    for _ in range(1, sensors):
        file.skip(_SENSOR)
        file.skip(_POSE * bool(file.number("B")))


def _frame(file: _Bytes) -> None:
    file.skip(4 + 4 + _POSE)
    file.skip((_SENSOR + 8) * file.number("I"))


def _image(file: _Bytes) -> None:
    file.skip(4 + _POSE + 4)
    file.text()
    file.skip((8 + 8 + 8) * file.number("Q"))


def _point(file: _Bytes) -> None:
    file.skip(8 + 3 * 8 + 3 + 8)
    file.skip((4 + 4) * file.number("Q"))


_RECORDS: dict[str, Callable[[_Bytes], None]] = {
    "cameras": _camera,
    "rigs": _rig,
    "frames": _frame,
    "images": _image,
    "points3D": _point,
}


def refuse_cut_short(folder: Path) -> None:
    """UserError for a file of a binary COLMAP model in `folder` that ends before its records do.

    ValueError for a camera model that pycolmap does not know. Of a model in text nothing is asked.
    """
    if not all((folder / f"{part}.bin").is_file() for part in ("cameras", "images", "points3D")):
        return
    for part, record in _RECORDS.items():
        path = folder / f"{part}.bin"
        if not path.is_file():
            continue
        file = _Bytes(path.read_bytes())
        try:
            for _ in range(file.number("Q")):
                record(file)
        except EOFError:
            raise UserError(f"{path} is cut short.", "Copy the model again.") from None
