"""What a user's folder holds: photos or a video, with or without poses and masks of their own."""

from __future__ import annotations

import filecmp
import logging
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import filelock

from pipeline.errors import UserError
from pipeline.io.atomic import disk_faults, publish_dir, read_json
from pipeline.io.given import GivenView, read_nerfstudio
from pipeline.io.images import PHOTO_SUFFIXES
from pipeline.io.llff import read_poses_bounds
from pipeline.io.photos import VIDEO_SUFFIXES, by_image_name, list_photos
from pipeline.io.scene import image_name

log = logging.getLogger(__name__)

TRANSFORMS = "transforms.json"
POSES_BOUNDS = "poses_bounds.npy"
RAIN_MASK = "rainMask.npy"
MASKS = "masks"
TRUTH = "truth"
CLUTTER = frozenset({"Thumbs.db", "desktop.ini"})  # of file managers; hidden files are too
COLMAP_PLACES = ("sparse/*", "sparse", "colmap/sparse/*", ".")  # *: models are numbered
ColmapReader = Callable[[Path, Sequence[Path]], list[GivenView]]


@dataclass(frozen=True)
class Capture:
    """A folder understood.

    `photos` by image name, in name order; empty for a `video`. `posed_by` names the format of the poses
    that came along, `views` holds them by image name. `masks` are keep-mask pictures by image name,
    `rain_mask` is DerainNeRF's array of all masks. `model` is the folder of a COLMAP model.
    """

    photos: dict[str, Path] = field(default_factory=dict)
    video: Path | None = None
    posed_by: str = ""
    views: dict[str, GivenView] = field(default_factory=dict)
    masks: dict[str, Path] = field(default_factory=dict)
    rain_mask: Path | None = None
    model: Path | None = None

    @property
    def masked_by(self) -> str:
        """Which masks came along, "" for none."""
        if self.rain_mask is not None:
            return self.rain_mask.name
        return "mask pictures" if self.masks else ""


def find_capture(folder: Path, at_least: int, read_colmap: ColmapReader) -> Capture:
    """What `folder` holds. A video alone; else photos with what lies beside them.

    Poses are taken from transforms.json, poses_bounds.npy or a COLMAP model, in this order; photos then
    may lie in `images/`. Masks are those that transforms.json names, rainMask.npy, or `masks/` with a
    picture for every photo. UserError for folders that cannot be used, saying why.
    """
    videos = _videos(folder)
    if videos:
        return Capture(video=_only_video(folder, videos))
    if (folder / TRANSFORMS).is_file():
        views = read_nerfstudio(folder / TRANSFORMS)
        photos, posed_by, model = by_image_name(view.photo for view in views), "nerfstudio", None
        _enough(folder, photos, at_least)
    else:
        model = find_model(folder)
        posed = model is not None or (folder / POSES_BOUNDS).is_file()
        photos = list_photos(_photo_folder(folder) if posed else folder, at_least)
        views, posed_by = [], ""
        if (folder / POSES_BOUNDS).is_file():
            views, posed_by = read_poses_bounds(folder / POSES_BOUNDS, _files(photos)), "LLFF"
        elif model is not None:
            model, views = _fullest_model(folder, _files(photos), read_colmap)
            posed_by = "COLMAP"
    masks, rain_mask = _masks(folder, photos, views), folder / RAIN_MASK
    return Capture(
        photos=dict(sorted(photos.items())),
        posed_by=posed_by,
        views={image_name(view.photo): view for view in views},
        masks=masks,
        rain_mask=rain_mask if rain_mask.is_file() and not masks else None,
        model=model,
    )


def _videos(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")
    ]


def _only_video(folder: Path, videos: list[Path]) -> Path:
    """The video; UserError beside another, photos, or poses, which are those of photos."""
    others = [path for path in folder.iterdir() if path.suffix.lower() in PHOTO_SUFFIXES]
    others += [path for name in (TRANSFORMS, POSES_BOUNDS) if (path := folder / name).is_file()]
    if model := find_model(folder):
        others.append(min(path for path in model.iterdir() if path.stem == "cameras"))
    if len(videos) > 1 or others:
        more = videos[1] if len(videos) > 1 else min(others)
        raise UserError(
            f"{folder} holds {videos[0].name} and {more.name}.",
            "A scene is one video, or photos; move the others away.",
        )
    return videos[0]


def _enough(folder: Path, photos: dict[str, Path], at_least: int) -> None:
    if len(photos) < at_least:
        raise UserError(
            f"{folder / TRANSFORMS} names {len(photos)} photos; a scene needs at least {at_least}."
        )


def find_model(folder: Path) -> Path | None:
    """The folder of a COLMAP model (text or binary) at one of its usual places under `folder`."""
    return next(iter(_models(folder)), None)


def _models(folder: Path) -> list[Path]:
    """All models at the first of the usual places that has any, by number."""
    for place in COLMAP_PLACES:
        found = [folder / place]
        if place.endswith("*"):
            numbered = [path for path in (folder / place).parent.glob("*") if path.name.isdecimal()]
            found = sorted(numbered, key=lambda path: (int(path.name), path.name))
        if models := [path for path in found if _is_model(path)]:
            return models
    return []


def _is_model(folder: Path) -> bool:
    parts = ("cameras", "images", "points3D")
    return any(
        all((folder / (part + suffix)).is_file() for part in parts) for suffix in (".bin", ".txt")
    )


def _fullest_model(
    folder: Path, photos: Sequence[Path], read_colmap: ColmapReader
) -> tuple[Path, list[GivenView]]:
    """Of the models of photos that did not come together the one that places most, and its cameras."""
    models = _models(folder)
    if len(models) == 1:
        return models[0], read_colmap(models[0], photos)
    read: dict[Path, list[GivenView]] = {}
    faults = []
    for model in models:
        try:
            read[model] = read_colmap(model, photos)
        except UserError as fault:
            faults.append(fault)
    if not read:
        raise faults[0]
    fullest = max(read, key=lambda model: len(read[model]))
    log.warning(
        "%s holds %d models; %s is taken, which places most photos: %d of %d",
        fullest.parent, len(models), fullest.name, len(read[fullest]), len(photos),
    )  # fmt: skip
    return fullest, read[fullest]


def _photo_folder(folder: Path) -> Path:
    """Where the photos of a posed capture lie: here, in images/, or in the largest images_<factor>/.

    Where most of them lie: a stray picture above them is not the capture.
    """
    smaller = sorted(
        (path for path in folder.glob("images_*") if path.name[7:].isdigit()),
        key=lambda path: int(path.name[7:]),
    )
    candidates = [path for path in (folder, folder / "images", *smaller) if path.is_dir()]
    counts = [
        sum(path.suffix.lower() in PHOTO_SUFFIXES for path in candidate.iterdir())
        for candidate in candidates
    ]
    if not any(counts):
        raise UserError(
            f"{folder} has poses, but no photos.", f"Put them into {folder / 'images'}."
        )
    return candidates[counts.index(max(counts))]


def _files(photos: dict[str, Path]) -> list[Path]:
    """The photos in the order of their own file names, which is how other programs pair them."""
    return sorted(photos.values(), key=lambda path: path.name)


def _masks(folder: Path, photos: dict[str, Path], views: Iterable[GivenView]) -> dict[str, Path]:
    named = {image_name(view.photo): view.mask_path for view in views}
    if any(named.values()):
        return {name: path for name, path in named.items() if path is not None}
    if not (folder / MASKS).is_dir() or (folder / RAIN_MASK).is_file():
        return {}
    found: dict[str, Path] = {}
    for name, photo in photos.items():
        # COLMAP's way first (IMG_1.jpg.png), then the photo's name, then its stem.
        for candidate in (f"{photo.name}.png", photo.name, f"{photo.stem}.png"):
            if (folder / MASKS / candidate).is_file():
                found[name] = folder / MASKS / candidate
                break
    missing = [photo.name for name, photo in sorted(photos.items()) if name not in found]
    pictures = any(path.suffix.lower() in PHOTO_SUFFIXES for path in (folder / MASKS).iterdir())
    if missing and pictures:
        shown = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if missing[3:] else "")
        raise UserError(
            f"{folder / MASKS} has no mask for {shown}.",
            "Give every photo a mask, named IMG_1.jpg.png, IMG_1.jpg or IMG_1.png for IMG_1.jpg, or none.",
        )
    return found


def adopt(source: Path, data: Path, at_least: int, read_colmap: ColmapReader) -> None:
    """Copies a capture, a folder or a video file, to `data`, which appears whole or not at all.

    What belongs to the capture is copied and nothing else, with its place in the folder kept; `truth/`
    goes along. A copy that is there already and equals the capture stays, as when a run goes on. UserError
    when `data` is anything else, or when the capture cannot be used.
    """
    with suppress(RuntimeError):  # no such home: told below as a path that does not exist
        # make, and some shells behind it, leave FROM=~/photos as it is
        source = source.expanduser()
    source = Path(os.path.normpath(source))
    if not source.exists():
        raise UserError(f"{source} does not exist.", "Look for a slip of the pen in --from.")
    if source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES:
        root, files = source.parent, [source]
    elif source.is_dir():
        capture = find_capture(source, at_least, read_colmap)
        refuse_outside(source, capture)
        _refuse_absolute(source, capture)
        root, files = source, _belonging(source, capture)
    else:
        raise UserError(f"{source} is no folder and no video.", "Name the folder of your photos.")
    _refuse_unnamable(files)
    with _alone(data):
        if data.exists():
            if not data.samefile(root):  # else what lies beside the capture stays there
                _refuse_other(data, root, files)
            return
        _copy(source, root, files, data)


@contextmanager
def _alone(data: Path) -> Iterator[None]:
    """Nobody else brings photos to `data` meanwhile: a second run would clear the first one's copies away."""
    try:
        with disk_faults(data):
            data.parent.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(data.parent / f".{data.name}.lock", timeout=0).acquire()
    except filelock.Timeout:
        raise UserError(
            f"photos are being copied to {data} already.", "Wait for that run, or end it first."
        ) from None
    with lock:
        yield


def _copy(source: Path, root: Path, files: Iterable[Path], data: Path) -> None:
    with publish_dir(data) as fresh:
        for folder in sorted({path.relative_to(root).parent for path in files}):
            (fresh / folder).mkdir(parents=True, exist_ok=True)
        for path in files:
            shutil.copyfile(path, fresh / path.relative_to(root))
        if (source / TRUTH).is_dir():
            _copy_folder(source / TRUTH, fresh / TRUTH)


def _refuse_unnamable(files: Iterable[Path]) -> None:
    """UserError for a name that is not UTF-8: DVC cannot list the folder it lies in."""
    for path in files:
        try:
            path.name.encode()
        except UnicodeEncodeError:
            shown = os.fsencode(path).decode(errors="backslashreplace")
            raise UserError(f"{shown}: the name is not UTF-8.", "Rename the file.") from None


def _refuse_other(data: Path, root: Path, files: Iterable[Path]) -> None:
    """UserError unless `data` holds these files of `root`, byte for byte, and nothing besides its truth."""
    wanted = {path.relative_to(root): path for path in files}
    held = {
        path.relative_to(data): path
        for path in data.rglob("*")
        if path.is_file() and not path.name.startswith(".") and path.name not in CLUTTER
    }
    same = wanted.keys() == {path for path in held if path.parts[0] != TRUTH}
    if not same or not all(filecmp.cmp(path, held[p], shallow=False) for p, path in wanted.items()):
        raise UserError(
            f"{data} exists already and holds something else.",
            "Leave --from (FROM) away to use it, remove it to bring the photos in anew, or choose another "
            "scene.",
        )


def _copy_folder(source: Path, target: Path) -> None:
    try:
        shutil.copytree(source, target)
    except shutil.Error as error:  # of all files that failed, the paths and why
        where, _, why = error.args[0][0]
        raise UserError(
            f"{where} cannot be copied ({why}).", f"Correct it, or move {source} away."
        ) from None


def refuse_outside(folder: Path, capture: Capture) -> None:
    """UserError for a photo or mask that transforms.json names outside of its folder.

    It would be missing in a copy of the folder, and a change of it would go unnoticed.
    """
    inside = Path(os.path.normpath(folder))
    for path in (*capture.photos.values(), *capture.masks.values()):
        if not Path(os.path.normpath(path)).is_relative_to(inside):
            raise UserError(
                f"{folder / TRANSFORMS} names {path}, which lies outside of {folder}.",
                "Copy all photos into one folder with it, and name them relative to it.",
            )


def _refuse_absolute(folder: Path, capture: Capture) -> None:
    """UserError for a photo or mask that transforms.json names from the root: a copy would not find its own."""
    if capture.posed_by != "nerfstudio":
        return
    for frame in read_json(folder / TRANSFORMS)["frames"]:
        for name in (frame["file_path"], frame.get("mask_path")):
            if name and Path(name).is_absolute():
                raise UserError(
                    f"{folder / TRANSFORMS} names {name} by an absolute path.",
                    "Name all photos and masks relative to it, so that they are found in a copy too.",
                )


def _belonging(source: Path, capture: Capture) -> list[Path]:
    files = {*capture.photos.values(), *capture.masks.values()}
    if capture.video:
        files.add(capture.video)
    files |= {source / name for name in (TRANSFORMS, POSES_BOUNDS, RAIN_MASK)}
    if capture.model:
        files |= {path for path in capture.model.iterdir() if path.suffix in (".bin", ".txt")}
    if lost := sorted(path for path in capture.photos.values() if not path.exists()):
        raise UserError(f"{lost[0]} is a link to nowhere.", "Copy the photo there, or remove it.")
    return sorted(path for path in files if path.is_file())
