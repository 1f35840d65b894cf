"""The list of a scene's images: names, sources, focal lengths and the split."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from pipeline.errors import UserError
from pipeline.io.atomic import read_json, write_json

FILE = "images.json"
# Beside the images, where a capture brought its own: poses of the images as they lie here, keep masks.
GIVEN_POSES = "transforms.json"
GIVEN_MASKS = "masks"
# `mean.exr` among the attention maps belongs to the temporal mean.
RESERVED_STEMS = frozenset({"mean"})


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


@dataclass(frozen=True)
class Origin:
    """Where the images came from: `kind` of capture, who `posed` and `masked` it ("" for nobody), the
    photos that were `left_out`, and what the user should know, as sentences (`said`)."""

    kind: Literal["photos", "video"] = "photos"
    posed: str = ""
    masked: str = ""
    left_out: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)


def image_name(photo: Path) -> str:
    """The file name in `images/` of a photo: its stem without blanks and what is no text, as PNG."""
    stem = re.sub(r"[\s/\\:*?\"<>|\ud800-\udfff]+", "_", photo.stem)
    stem = "_" + stem[1:] if stem.startswith(("-", ".")) else stem
    return f"{stem}_.png" if stem in RESERVED_STEMS else f"{stem}.png"


def write_images_json(
    folder: Path, records: Sequence[ImageRecord], origin: Origin | None = None
) -> None:
    """Writes `images.json` into `folder`."""
    images = [asdict(record) for record in records]
    write_json(folder / FILE, {"images": images, "origin": asdict(origin or Origin())})


def read_origin(folder: Path) -> Origin:
    """Where a scene's images came from; UserError when `ingest` has not run or the list is damaged."""
    content = read_json(folder / FILE, made_by="ingest")
    try:
        return Origin(**content.get("origin", {}))
    except (AttributeError, TypeError) as error:
        raise UserError(
            f"{folder / FILE} is not a list of images ({error}).",
            "Run `python -m stages.ingest` again.",
        ) from None


def read_images_json(folder: Path) -> list[ImageRecord]:
    """The images of a scene in name order; UserError when `ingest` has not run or the list is damaged."""
    content = read_json(folder / FILE, made_by="ingest")
    try:
        records = [ImageRecord(**entry) for entry in content["images"]]
        if not records:
            raise ValueError("it names none")
        if not all(isinstance(r.name, str) and Path(r.name).name == r.name for r in records):
            raise ValueError("a name is none of a file")
        if not all(isinstance(side, int) and side > 0 for r in records for side in r.size):
            raise ValueError("a size is not in pixels")
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{folder / FILE} is not a list of images ({error}).",
            "Run `python -m stages.ingest` again.",
        ) from None
    return sorted(records, key=lambda record: record.name)


def with_split(records: Sequence[ImageRecord], every: int) -> list[ImageRecord]:
    """The records with every n-th in name order held out of the fit ("test"), from the first; 0: none."""
    ordered = sorted(records, key=lambda record: record.name)
    return [
        replace(record, split="test" if every > 0 and index % every == 0 else "train")
        for index, record in enumerate(ordered)
    ]
