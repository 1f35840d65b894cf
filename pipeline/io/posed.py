"""A scene's images with their masks and poses, read together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from pipeline.io.images import read_image
from pipeline.io.masks import read_keep_mask
from pipeline.io.memory import free_memory
from pipeline.io.scene import ImageRecord, read_images_json
from pipeline.io.transforms import View

# Per pixel in a fit: colours as float32, a mask, and in the shuffled rays the colours and two orders.
HELD_BYTES = 25
LOOP_BYTES = 36  # and while masks are repaired: attention maps, the rounds' masks, residuals
MOST_PIXELS = 2**31 - 1  # pixels are numbered through in 32 bits


@dataclass(frozen=True)
class PosedImage:
    """One image: `rgb` (H, W, 3) in [0, 1], `keep_mask` (H, W) True = use, and its pose."""

    record: ImageRecord
    view: View
    rgb: np.ndarray
    keep_mask: np.ndarray


def read_posed_images(
    images: Path, keep_masks: Path | None, views: Mapping[str, View], held_bytes: int = HELD_BYTES
) -> list[PosedImage]:
    """The images that have a pose, in name order, held-out ones included.

    Without a folder of `keep_masks` every pixel is kept. UserError when none has a pose, when a file is
    missing or damaged, or when the memory that is free cannot hold what a fit of them holds: `held_bytes`
    per pixel.
    """
    records = posed_records(images, views)
    refuse_too_large(records, held_bytes)
    found = []
    for record in records:
        view = views[record.name]
        rgb = read_image(images / record.name, size=(view.width, view.height))
        keep_mask = np.ones(rgb.shape[:2], bool)
        if keep_masks is not None:
            keep_mask = read_keep_mask(keep_masks / record.name, (view.width, view.height))
        found.append(PosedImage(record, view, rgb, keep_mask))
    return found


def posed_records(
    images: Path, views: Mapping[str, View], *, held_out_alone: bool = False
) -> list[ImageRecord]:
    """The images that have a pose, or the held-out ones among them, in name order.

    UserError for none, or when a pose is for another size.
    """
    records = [record for record in read_images_json(images) if record.name in views]
    if not records:
        raise UserError(
            f"no photo in {images} has a pose.",
            "Run `python -m stages.poses` again; poses/poses.json tells why photos were lost.",
        )
    for record in records:
        view = views[record.name]
        if (view.width, view.height) != record.size:
            raise UserError(
                f"the pose of {record.name} is for {view.width}x{view.height} pixels; it has "
                f"{record.width}x{record.height}.",
                "Run `python -m stages.poses` again.",
            )
    if held_out_alone:
        records = [record for record in records if record.split == "test"]
        if not records:
            raise UserError(
                f"no photo in {images} that has a pose is held out of the fit.",
                "Set render.views: all, or hold photos out (ingest.holdout).",
            )
    return records


def refuse_too_large(records: Sequence[ImageRecord], held_bytes: int = HELD_BYTES) -> None:
    """UserError when the free memory cannot hold what a fit of these images holds.

    Told by their listed sizes, before any is read: else the system would end the fit without a word.
    """
    pixels = sum(record.width * record.height for record in records)
    needed, free = held_bytes * pixels, free_memory()
    if pixels <= MOST_PIXELS and needed <= free:
        return
    width, height = records[0].size
    if pixels > MOST_PIXELS:
        raise UserError(
            f"{len(records)} photos of {width}x{height} have {pixels / 1e9:.1f} thousand million pixels; a "
            f"fit takes {MOST_PIXELS / 1e9:.1f} at most.",
            "Lower ingest.max_size or ingest.frames.",
        )
    raise UserError(
        f"{len(records)} photos of {width}x{height} need about {needed / 1e9:.1f} GB of memory in a "
        f"fit; {free / 1e9:.1f} GB are free.",
        "Lower ingest.max_size or ingest.frames, end other programs, or raise the container's limit.",
    )
