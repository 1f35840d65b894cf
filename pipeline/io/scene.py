"""The list of a scene's images: names, sources, focal lengths and the split."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from pipeline.errors import UserError
from pipeline.io.atomic import read_json, write_json

FILE = "images.json"
# Beside the images, where a capture brought its own: poses of the images as they lie here, keep masks.
GIVEN_POSES = "transforms.json"
GIVEN_MASKS = "masks"
# `mean.exr` among the attention maps belongs to the temporal mean.
RESERVED_STEMS = frozenset({"mean"})
LONGEST = 2**31  # a side in pixels that no picture reaches


@dataclass(frozen=True)
class Pinhole:
    """Focal lengths and principal point in pixels, pixel (0, 0)'s centre at (0.5, 0.5)."""

    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class Lens:
    """A lens whose bending `ingest` took away from a photo: from `bent` to `straight`.

    Both belong to pictures of `width` x `height`, turned as the image is. `distortion` holds OpenCV's
    coefficients, of its fisheye model where `fisheye`.
    """

    width: int
    height: int
    bent: Pinhole
    distortion: tuple[float, ...]
    fisheye: bool
    straight: Pinhole


@dataclass(frozen=True)
class ImageRecord:
    """One image of a scene.

    `name` is its file name in `images/`, `source` the photo's file name, `focal_px` the focal length from
    the photo's metadata at this size or None, `split` "train" or "test" (held out of the fit), `turned`
    the degrees counter-clockwise by which the upright photo was turned so that all images have one size,
    `lens` the lens that was straightened, None for pixels as they were taken.
    """

    name: str
    source: str
    sha256: str
    width: int
    height: int
    focal_px: float | None
    split: Literal["train", "test"]
    turned: int
    lens: Lens | None = None

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
    return Origin(**_known(Origin, _read(folder).get("origin", {})))


def read_images_json(folder: Path) -> list[ImageRecord]:
    """The images of a scene in name order; UserError when `ingest` has not run or the list is damaged."""
    records = [_record(entry) for entry in _read(folder)["images"]]
    problem = "" if records else "it names none"
    for record in records:
        problem = problem or _problem(record)
    names = [record.name for record in records]
    if twice := sorted(name for name in set(names) if names.count(name) > 1):
        problem = f"it names {twice[0]} twice"
    if problem:
        raise UserError(
            f"{folder / FILE} is not a list of images ({problem}).",
            "Run `python -m stages.ingest` again.",
        )
    return sorted(records, key=lambda record: record.name)


def _problem(record: ImageRecord) -> str:
    """What cannot be true of an entry, or nothing."""
    if Path(record.name).name != record.name:
        return f"{record.name!r} is no name of a file"
    if not all(0 < side <= LONGEST for side in record.size):
        return f"{record.name} has a size that is not in pixels"
    if record.focal_px is not None and record.focal_px <= 0:
        return f"{record.name} has a focal length that is not positive"
    if record.turned % 90:
        return f"{record.name} is turned by {record.turned} degrees"
    return ""


def _read(folder: Path) -> dict[str, Any]:
    shape = {"images": list[ImageRecord], "origin?": Origin}
    return read_json(folder / FILE, "ingest", shape)


def _record(entry: Mapping[str, Any]) -> ImageRecord:
    values = _known(ImageRecord, entry)
    if lens := values.get("lens"):
        pinholes = {name: Pinhole(**_known(Pinhole, lens[name])) for name in ("bent", "straight")}
        rest = {"distortion": tuple(lens["distortion"])}
        values["lens"] = Lens(**{**_known(Lens, lens), **pinholes, **rest})
    return ImageRecord(**values)


def _known(kind: type, entry: Mapping[str, Any]) -> dict[str, Any]:
    """What of an entry `kind` has a field for."""
    return {field.name: entry[field.name] for field in fields(kind) if field.name in entry}


def with_split(records: Sequence[ImageRecord], every: int) -> list[ImageRecord]:
    """The records with every n-th in name order held out of the fit ("test"), from the first; 0: none."""
    ordered = sorted(records, key=lambda record: record.name)
    return [
        replace(record, split="test" if every > 0 and index % every == 0 else "train")
        for index, record in enumerate(ordered)
    ]
