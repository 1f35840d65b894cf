"""A user's folder of photos, brought to one size and one orientation."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import UserError
from pipeline.io.images import PHOTO_SUFFIXES, read_photo, shrink, turn, write_image

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v"})
HEIC_SUFFIXES = frozenset({".heic", ".heif", ".avif"})
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf"})
# `mean.exr` among the attention maps belongs to the temporal mean.
RESERVED_STEMS = frozenset({"mean"})


@dataclass(frozen=True)
class Photo:
    """What `examine` finds out: stored size, turn to be upright (degrees ccw), focal length, checksum."""

    width: int
    height: int
    upright_turn: int
    focal_px: float | None
    sha256: str

    def size_after(self, degrees: int) -> tuple[int, int]:
        """(width, height) once turned by `degrees`."""
        return (self.height, self.width) if degrees % 180 else (self.width, self.height)


def list_photos(folder: Path, at_least: int) -> dict[str, Path]:
    """The photos in `folder` (its top level only) by the name their image will have, in name order.

    UserError when the folder is missing or holds fewer than `at_least` photos, when two photos would get
    one name, and for files that look like photos but are of a kind that cannot be read.
    """
    if not folder.is_dir():
        raise UserError(
            f"{folder} does not exist.", "Put your photos there (JPEG, PNG, TIFF or WebP)."
        )
    photos: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        suffix = path.suffix.lower()
        if path.name.startswith(".") or not (path.is_file() or path.is_symlink()):
            continue
        _refuse_unreadable_kind(path, suffix)
        if suffix in PHOTO_SUFFIXES:
            name = image_name(path)
            if name in photos:
                raise UserError(
                    f"{path} and {photos[name]} would both become {name}.", "Rename one of them."
                )
            photos[name] = path
    if len(photos) < at_least:
        found = {0: "no photos", 1: "one photo only"}.get(len(photos), f"{len(photos)} photos only")
        raise UserError(
            f"{folder} holds {found}; a scene needs at least {at_least}.",
            "Twenty or more, taken from different places, work best (JPEG, PNG, TIFF or WebP).",
        )
    return photos


def _refuse_unreadable_kind(path: Path, suffix: str) -> None:
    if suffix in HEIC_SUFFIXES | RAW_SUFFIXES:
        raise UserError(
            f"{path}: {suffix[1:].upper()} files are not read.", "Convert them to JPEG first."
        )
    if suffix in VIDEO_SUFFIXES:
        raise UserError(
            f"{path}: videos are not read.",
            f"Save frames of it as photos, e.g. `ffmpeg -i {path.name} -vf fps=2 %03d.png`.",
        )


def image_name(path: Path) -> str:
    """The file name in `images/` of the photo at `path`: its stem without blanks, as PNG."""
    stem = re.sub(r"[\s/\\:*?\"<>|]+", "_", path.stem)
    stem = "_" + stem[1:] if stem.startswith(("-", ".")) else stem
    return f"{stem}_.png" if stem in RESERVED_STEMS else f"{stem}.png"


def examine(path: Path) -> Photo:
    """Decodes the whole photo and tells its size, orientation, focal length and SHA-256."""
    pixels, info = read_photo(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return Photo(pixels.shape[1], pixels.shape[0], info.upright_turn, info.focal_px, digest)


def common_turns(photos: Mapping[str, Photo]) -> dict[str, int]:
    """Degrees counter-clockwise by which each photo's stored pixels are turned, so that all sizes agree.

    Upright where that gives one size. Where upright photos would mix portrait and landscape, all get the
    turn that most of them ask for: drops fixed to the lens then keep their place in the frame. UserError
    when the sizes still differ.
    """
    upright = {name: photo.upright_turn for name, photo in photos.items()}
    if len({photo.size_after(upright[name]) for name, photo in photos.items()}) == 1:
        return upright
    most = Counter(upright.values()).most_common()
    common = min(degrees for degrees, count in most if count == most[0][1])
    sizes = Counter(photo.size_after(common) for photo in photos.values())
    if len(sizes) == 1:
        return dict.fromkeys(photos, common)
    counts = ", ".join(f"{count} of {w}x{h}" for (w, h), count in sizes.most_common())
    rare = sizes.most_common()[-1][0]
    example = next(name for name, photo in photos.items() if photo.size_after(common) == rare)
    raise UserError(
        f"the photos have mixed sizes: {counts} (one of the last: {Path(example).stem}).",
        "Use photos of one camera and setting, or scale and crop them to one size first.",
    )


def convert(source: Path, target: Path, degrees: int, longest_side: int) -> tuple[int, int]:
    """Writes the photo turned by `degrees` and scaled down to `longest_side` (0: as it is) as PNG.

    Returns the written (width, height).
    """
    pixels = turn(read_photo(source)[0], degrees)
    if longest_side:
        pixels = shrink(pixels, longest_side)
    write_image(target, pixels)
    return pixels.shape[1], pixels.shape[0]
