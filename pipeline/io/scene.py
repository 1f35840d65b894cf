"""The list of a scene's images: names, sources, focal lengths and the split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from pipeline.errors import UserError
from pipeline.io.atomic import read_json, write_json

FILE = "images.json"


@dataclass(frozen=True)
class ImageRecord:
    """One image of a scene.

    `name` is its file name in `images/`, `source` the photo's file name, `focal_px` the focal length from
    the photo's metadata at this size or None, `split` "train" or "test" (held out of the fit), `turned`
    the degrees counter-clockwise by which the upright photo was turned so that all images have one size.
    """

    name: str
    source: str
    sha256: str
    width: int
    height: int
    focal_px: float | None
    split: Literal["train", "test"]
    turned: int

    @property
    def stem(self) -> str:
        return Path(self.name).stem

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height


def write_images_json(folder: Path, records: Sequence[ImageRecord]) -> None:
    """Writes `images.json` into `folder`."""
    write_json(folder / FILE, {"images": [asdict(record) for record in records]})


def read_images_json(folder: Path) -> list[ImageRecord]:
    """The images of a scene in name order; UserError when `ingest` has not run or the list is damaged."""
    content = read_json(folder / FILE, made_by="ingest")
    try:
        records = [ImageRecord(**entry) for entry in content["images"]]
    except (KeyError, TypeError) as error:
        raise UserError(
            f"{folder / FILE} is not a list of images ({error}).",
            "Run `python -m stages.ingest` again.",
        ) from None
    return sorted(records, key=lambda record: record.name)
