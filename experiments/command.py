"""What the experiments' commands share: faults end them with a sentence, what they draw is there."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UserError
from pipeline.io.atomic import write_bytes

KINDS = (".jpg", ".jpeg", ".png")


@contextmanager
def sentences() -> Iterator[None]:
    """A UserError within ends the program with what it says and exit code 2, as it ends a stage."""
    try:
        yield
    except UserError as error:
        print(f"{error.what}\n  {error.hint}".rstrip(), file=sys.stderr)
        sys.exit(2)


def picture(text: str) -> Path:
    """Where to write a picture, as an argument; argparse tells what can be none."""
    if Path(text).suffix.lower() not in KINDS:
        raise argparse.ArgumentTypeError(f"{text} does not end with {', '.join(KINDS)}")
    return Path(text)


def write_picture(path: Path, bgr: np.ndarray, quality: int) -> None:
    """Writes an (H, W, 3) uint8 picture, channels as OpenCV has them, and its folder if there is none."""
    done, data = cv2.imencode(path.suffix, bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OSError(f"{path}: the picture could not be encoded")
    write_bytes(path, data.tobytes())
