"""What a capture brought along, poses and masks, made to fit the images that its photos become."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from pipeline.io.capture import Capture
from pipeline.io.given import SAME_SHAPE, GivenView, Straightener, straightened
from pipeline.io.images import turn, unmirrored
from pipeline.io.lenses import lens_of
from pipeline.io.masks import fit_mask, read_foreign_mask, read_rain_mask, write_keep_mask
from pipeline.io.photos import Photo, Plan
from pipeline.io.scene import ImageRecord
from pipeline.io.transforms import View, near_origin

SUSPECT = 0.6  # a set of masks that drops more than this is likely upside down
FEW = 12  # photos; a rule of thumb: docs/capture.md advises 20 to 40


def enough(plan: Plan, photos: Mapping[str, Photo], at_least: int) -> Plan:
    """`plan` itself; UserError when it uses fewer than `at_least` of the photos."""
    if len(plan.turns) < at_least:
        raise UserError(
            f"{len(plan.turns)} of {len(photos)} photos can be used: {'; '.join(plan.said)}.",
            f"A scene needs at least {at_least} photos of one shape, taken from different places.",
        )
    return plan


def few_said(records: Sequence[ImageRecord]) -> list[str]:
    """What the user should hear of so few images that drops may hide the same spot in most of them."""
    if len(records) >= FEW:
        return []
    held_out = sum(record.split == "test" for record in records)
    kept_back = f", and {held_out} of them held out to judge the fit by" if held_out else ""
    return [
        f"{len(records)} images are few{kept_back}: twenty or more, from different places, work best"
    ]


def given_turns(
    photos: Mapping[str, Photo], views: Mapping[str, GivenView]
) -> dict[str, int] | None:
    """Degrees ccw by which each photo's stored pixels become those of its camera; None without views.

    Programs disagree on whether a photo's metadata turns it; the cameras' sizes tell. A photo without a
    pose is turned as its neighbours are, or made upright where it has another shape than they. UserError
    when a camera has the size of neither.
    """
    if not views:
        return None
    turns = {}
    some = next(iter(views.values()))
    for name, photo in photos.items():
        view = views.get(name, some)
        degrees = view.turn_for((photo.width, photo.height), photo.upright_turn)
        if degrees is None and name not in views:
            degrees = photo.upright_turn
        if degrees is None:
            raise UserError(
                f"{view.photo} has {photo.width}x{photo.height} pixels, its camera "
                f"{view.width}x{view.height}: the shapes differ.",
                "Poses and photos do not belong together, or the photos were cropped.",
            )
        turns[name] = degrees
    return turns


def straighteners(views: Mapping[str, GivenView]) -> dict[str, Straightener]:
    """By name, what takes away the distortion of the views that the project's camera cannot carry."""
    return {
        name: Straightener(view, straightened(view))
        for name, view in views.items()
        if not view.carried
    }


def photo_records(
    capture: Capture,
    photos: Mapping[str, Photo],
    plan: Plan,
    size: tuple[int, int],
    folder: Path,
    straighten: Mapping[str, Straightener],
) -> list[ImageRecord]:
    """The records, in name order, of the images (of `size`) that the photos in `folder` become."""
    records = []
    for name in sorted(plan.turns):
        source = capture.photos[name].relative_to(folder).as_posix()
        record = photos[name].record(name, source, plan.turns[name], size)
        if name in straighten:  # the metadata tells of the lens as it was
            straight = straighten[name].straight
            focal_px = round(straight.fx * size[0] / straight.width, 3)
            record = replace(record, lens=lens_of(straighten[name]), focal_px=focal_px)
        records.append(record)
    return records


def given_views(
    capture: Capture, plan: Plan, size: tuple[int, int], straighten: Mapping[str, Straightener]
) -> list[View]:
    """The capture's views for the images (of `size`) that its photos become, in name order.

    Those far from the origin are moved to one in their midst.
    """
    views = [
        (straighten[name].straight if name in straighten else view).view(name, size)
        for name, view in sorted(capture.views.items())
        if name in plan.turns
    ]
    return near_origin(views) if views else []


def given_masks(capture: Capture) -> Iterator[tuple[str, np.ndarray]]:
    """The capture's keep masks (H, W), True = use, by image name, at the size they have there."""
    if capture.rain_mask is not None:
        order = sorted(capture.photos, key=lambda name: capture.photos[name].name)
        masks = read_rain_mask(capture.rain_mask, len(order))
        yield from zip(order, masks, strict=True)
        return
    for name, path in sorted(capture.masks.items()):
        yield name, read_foreign_mask(path)


def write_given_masks(
    folder: Path,
    capture: Capture,
    photos: Mapping[str, Photo],
    plan: Plan,
    size: tuple[int, int],
    straighten: Mapping[str, Straightener],
) -> float | None:
    """Writes the capture's keep masks as the images' into `folder`; their dropped share, None without.

    UserError when a mask has another shape than its photo.
    """
    shares = []
    for name, keep_mask in given_masks(capture):
        if name not in plan.turns:
            continue
        turned = _turned_as_its_photo(name, keep_mask, photos[name], plan.turns[name])
        if name in straighten:
            turned = straighten[name](turned.astype(np.uint8)) > 0
        fitted = fit_mask(turned, size)
        write_keep_mask(folder / name, fitted)
        shares.append(1.0 - float(fitted.mean()))
    return float(np.mean(shares)) if shares else None


def _turned_as_its_photo(
    name: str, keep_mask: np.ndarray, photo: Photo, degrees: int
) -> np.ndarray:
    """A mask drawn over the pixels as stored, or over the upright ones, turned as the image is."""
    ratio = keep_mask.shape[1] / keep_mask.shape[0]
    for already in (0, photo.upright_turn):
        if abs(ratio / photo.ratio_after(already) - 1) < SAME_SHAPE:
            if photo.mirrored and already == 0:
                keep_mask = unmirrored(keep_mask, photo.upright_turn)
            return turn(keep_mask, degrees - already)
    raise UserError(
        f"the mask of {Path(name).stem} has {keep_mask.shape[1]}x{keep_mask.shape[0]} pixels, its "
        f"photo {photo.width}x{photo.height}: the shapes differ.",
        "A mask covers its whole photo.",
    )


def masks_said(masked: str, share: float | None, photos: Mapping[str, Photo]) -> list[str]:
    """What the user should hear of masks that came along, which drop `share` of the pixels; None: no masks."""
    if share is None:
        return []
    said = [f"masks came along ({masked}): {100 * share:.1f} % of the pixels are dropped"]
    if share > SUSPECT:
        said.append(
            "the masks drop most of the photos: are they upside down? black is dropped here"
        )
    turned = [photo for photo in photos.values() if photo.upright_turn or photo.mirrored]
    unsure = sum(photo.ratio_after(0) == photo.ratio_after(photo.upright_turn) for photo in turned)
    if unsure:
        said.append(
            f"the metadata turns or mirrors {unsure} photos so that their masks' shape does not tell whether "
            "these are too: they are taken as drawn over the photos as stored"
        )
    return said
