"""A user's folder of photos, brought to one size and one orientation."""

from __future__ import annotations

import hashlib
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.errors import UserError
from pipeline.io.images import PHOTO_SUFFIXES, can_read, read_photo, resized, turn, write_image
from pipeline.io.scene import ImageRecord, image_name

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v"})
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf"})
SAME_SHAPE = 1.005  # ratios of width to height this far apart are one shape, rounded twice

Straighten = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Photo:
    """What `examine` finds out: stored size, turn to be upright (degrees ccw), focal length, checksum.

    `mirrored`: the file holds the pixels mirrored (`pipeline.io.images.unmirrored`).
    """

    width: int
    height: int
    upright_turn: int
    focal_px: float | None
    sha256: str
    mirrored: bool = False

    def size_after(self, degrees: int) -> tuple[int, int]:
        """(width, height) once turned by `degrees`."""
        return (self.height, self.width) if degrees % 180 else (self.width, self.height)

    def ratio_after(self, degrees: int) -> float:
        """Width over height once turned by `degrees`."""
        width, height = self.size_after(degrees)
        return width / height

    def record(self, name: str, source: str, degrees: int, size: tuple[int, int]) -> ImageRecord:
        """The image `name` of `size` (w, h) made of this photo, turned by `degrees`."""
        scale = max(size) / max(self.width, self.height)
        return ImageRecord(
            name=name,
            source=source,
            sha256=self.sha256,
            width=size[0],
            height=size[1],
            focal_px=round(self.focal_px * scale, 3) if self.focal_px else None,
            split="train",
            turned=(degrees - self.upright_turn) % 360,
        )


def list_photos(folder: Path, at_least: int) -> dict[str, Path]:
    """The photos in `folder` (its top level only) by the name their image will have, in name order.

    UserError when the folder is missing or holds fewer than `at_least` photos, when two photos would get
    one name, and for files that look like photos but are of a kind that cannot be read; a raw file beside
    its JPEG is passed over.
    """
    if not folder.is_dir():
        raise UserError(
            f"{folder} does not exist.", "Put your photos there (JPEG, PNG, TIFF or WebP)."
        )
    files = [
        path
        for path in sorted(folder.iterdir())
        if not path.name.startswith(".") and (path.is_file() or path.is_symlink())
    ]
    developed = {path.stem for path in files if path.suffix.lower() in PHOTO_SUFFIXES}
    for path in files:
        if path.suffix.lower() not in RAW_SUFFIXES or path.stem not in developed:
            _refuse_unreadable_kind(path)
    photos = by_image_name(path for path in files if path.suffix.lower() in PHOTO_SUFFIXES)
    if len(photos) < at_least:
        found = {0: "no photos", 1: "one photo only"}.get(len(photos), f"{len(photos)} photos only")
        raise UserError(
            f"{folder} holds {found}; a scene needs at least {at_least}.",
            _below(folder)
            or "Twenty or more, taken from different places, work best (JPEG, PNG, TIFF or WebP).",
        )
    return photos


def _below(folder: Path) -> str:
    """Where else the photos may be meant to be, as a hint: only the top level is searched."""
    for below in sorted(path for path in folder.iterdir() if path.is_dir()):
        if any(path.suffix.lower() in PHOTO_SUFFIXES for path in below.iterdir()):
            name = shlex.quote(str(below))
            return f"Subfolders are not searched: move the photos up, or name {name} with --from."
    return ""


def by_image_name(paths: Iterable[Path]) -> dict[str, Path]:
    """The photos by the name their image will have; UserError when two would get one name."""
    photos: dict[str, Path] = {}
    for path in paths:
        name = image_name(path)
        if name in photos:
            raise UserError(
                f"{path} and {photos[name]} would both become {name}.", "Rename one of them."
            )
        photos[name] = path
    return photos


def _refuse_unreadable_kind(path: Path) -> None:
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        raise UserError(
            f"{path}: {suffix[1:].upper()} files are not read.", "Convert them to JPEG first."
        )
    if suffix in PHOTO_SUFFIXES and not can_read(suffix):
        raise UserError(
            f"{path}: {suffix[1:].upper()} files need another package.",
            "Install it with `pip install -e '.[heic]'`, or convert them to JPEG first.",
        )


def examine(path: Path) -> Photo:
    """Decodes the whole photo and tells its size, orientation, focal length and SHA-256."""
    pixels, info = read_photo(path)
    height, width = pixels.shape[:2]
    turned, digest = info.upright_turn, file_sha256(path)
    return Photo(width, height, turned, info.focal_px, digest, info.mirrored)


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file, read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class Plan:
    """How photos become images of one size.

    `turns`: degrees counter-clockwise by which the stored pixels of each photo that is used are
    turned. `size`: (width, height) that all then have, before any scaling down. `left_out`: names of
    the photos that are not used. `said`: what the user should hear, as sentences.
    """

    turns: dict[str, int]
    size: tuple[int, int]
    left_out: list[str]
    said: list[str]


def plan_sizes(
    photos: Mapping[str, Photo],
    *,
    mixed: Literal["scale", "refuse"] = "scale",
    fixed_turns: Mapping[str, int] | None = None,
) -> Plan:
    """How to turn and scale the photos so that all have one size.

    All get the turn that most of them ask for: drops fixed to the lens then keep their place in the frame.
    Each is made upright by itself only where that gives one size and the common turn does not. Sizes
    that still differ are scaled to the smallest where their shapes agree; otherwise the photos of the
    most common shape are used and the others left out, as long as they are half of all. UserError when
    they are not, or when sizes differ and `mixed` is "refuse". `fixed_turns` leaves no choice of turns:
    poses that came with the photos hold for one orientation. Of photos that are copies of one file the
    first is used: held out, it would be judged against its own twin.
    """
    originals: dict[str, str] = {}
    for name in sorted(photos):
        originals.setdefault(photos[name].sha256, name)
    copies = sorted(photos.keys() - originals.values())
    if copies and fixed_turns is None:
        rest = {name: photo for name, photo in photos.items() if name not in copies}
        plan = plan_sizes(rest, mixed=mixed)
        said = (
            f"left out as copies of other photos, byte for byte ({len(copies)} of {len(photos)}): "
            f"{', '.join(Path(name).stem for name in copies)}"
        )
        return replace(plan, left_out=sorted([*plan.left_out, *copies]), said=[said, *plan.said])
    choices, why = _choices_of_turns(photos), "so that drops on the lens keep their place"
    if fixed_turns is not None:
        choices, why = [dict(fixed_turns)], "as the cameras that came along see them"
    for turns in choices:
        sizes = {photo.size_after(turns[name]) for name, photo in photos.items()}
        if len(sizes) == 1:
            return Plan(turns, sizes.pop(), [], _said_of_turns(photos, turns, why))
    if mixed == "refuse":
        raise _mixed_sizes(photos, choices[0])
    plans = [_scaled_together(photos, turns, why) for turns in choices]
    best = min(plans, key=lambda plan: len(plan.left_out))
    if 2 * len(best.left_out) > len(photos):
        raise _mixed_sizes(photos, choices[0])
    return best


def _choices_of_turns(photos: Mapping[str, Photo]) -> list[dict[str, int]]:
    """The turn that most photos ask for, given to all, then each upright."""
    upright = {name: photo.upright_turn for name, photo in photos.items()}
    most = Counter(upright.values()).most_common()
    common = min(degrees for degrees, count in most if count == most[0][1])
    return [dict.fromkeys(photos, common), upright]


def _said_of_turns(photos: Mapping[str, Photo], turns: Mapping[str, int], why: str) -> list[str]:
    turned = sum(turns[name] != photos[name].upright_turn for name in turns)
    if not turned:
        return []
    return [f"{turned} of {len(turns)} photos stay turned, {why}"]


def _scaled_together(photos: Mapping[str, Photo], turns: Mapping[str, int], why: str) -> Plan:
    """The largest group of photos whose shapes agree, scaled to the smallest of them."""
    groups: list[list[str]] = []
    for name in sorted(photos, key=lambda name: (photos[name].ratio_after(turns[name]), name)):
        ratio = photos[name].ratio_after(turns[name])
        if groups and ratio <= photos[groups[-1][0]].ratio_after(turns[groups[-1][0]]) * SAME_SHAPE:
            groups[-1].append(name)
        else:
            groups.append([name])
    used = max(groups, key=len)
    kept = {name: turns[name] for name in sorted(used)}
    left_out = sorted(photos.keys() - kept.keys())
    sizes = Counter(photos[name].size_after(turns[name]) for name in kept)
    smallest = min(sizes)
    said = _said_of_turns(photos, kept, why)
    if len(sizes) > 1:
        counts = ", ".join(f"{count} of {w}x{h}" for (w, h), count in sizes.most_common())
        said.append(f"the photos have mixed sizes ({counts}); all are scaled to the smallest")
    if left_out:
        said.append(
            f"{len(left_out)} of {len(photos)} photos have another shape than the rest and are left "
            f"out: {', '.join(Path(name).stem for name in left_out)}"
        )
    return Plan(kept, smallest, left_out, said)


def _mixed_sizes(photos: Mapping[str, Photo], turns: Mapping[str, int]) -> UserError:
    sizes = Counter(photo.size_after(turns[name]) for name, photo in photos.items())
    counts = ", ".join(f"{count} of {w}x{h}" for (w, h), count in sizes.most_common())
    rare = sizes.most_common()[-1][0]
    example = next(name for name, photo in photos.items() if photo.size_after(turns[name]) == rare)
    return UserError(
        f"the photos have mixed sizes: {counts} (one of the last: {Path(example).stem}).",
        "Use photos of one camera and setting, or scale and crop them to one size first.",
    )


def final_size(size: tuple[int, int], longest_side: int) -> tuple[int, int]:
    """`size` (width, height) scaled down until no side exceeds `longest_side`; 0 keeps it."""
    factor = longest_side / max(size) if longest_side else 1.0
    if factor >= 1.0:
        return size
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def convert(
    source: Path,
    target: Path,
    degrees: int,
    size: tuple[int, int],
    straighten: Straighten | None = None,
) -> None:
    """Writes the photo as PNG: turned by `degrees`, through `straighten`, scaled to `size` (w, h).

    `straighten` maps pixels to pixels of the same shape, e.g. takes a lens's distortion away.
    """
    pixels = turn(read_photo(source)[0], degrees)
    if straighten is not None:
        pixels = straighten(pixels)
    write_image(target, resized(pixels, size))
