"""A fitted field on disk, and a fit that was interrupted."""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import UserError
from pipeline.field.buffer import PosedPhoto
from pipeline.field.grid_field import GridField
from pipeline.field.model import describe, restore
from pipeline.field.paper_field import PaperField
from pipeline.io.atomic import clear_torn, read_json, write_json
from pipeline.io.code import code_key
from pipeline.io.tensors import load_tensors, save_tensors

log = logging.getLogger(__name__)


class Fitted(NamedTuple):
    """A field, the depths between which it was fitted, and how bright (3,) each fitted photo is beside it."""

    field: GridField | PaperField
    near: float
    far: float
    gains: Mapping[str, np.ndarray]


def save_field(
    folder: Path, field: GridField | PaperField, near: float, far: float, about: Mapping[str, Any]
) -> None:
    """Writes `field.safetensors` and `field.json`, which also holds ``about``, into a folder."""
    tensors = {name: value.detach().cpu() for name, value in field.state_dict().items()}
    save_tensors(folder / "field.safetensors", tensors)
    bounds = {"bounds": {"near": near, "far": far}}
    write_json(folder / "field.json", describe(field) | bounds | dict(about))


def load_field(folder: Path, device: str) -> Fitted:
    """What :func:`save_field` wrote, on ``device``; UserError when missing or damaged.

    The last one stays in memory until its files change: many views are rendered from one field.
    """
    files = (folder / "field.safetensors", folder / "field.json")
    written = tuple(file.stat().st_mtime_ns if file.is_file() else 0 for file in files)
    return _load_field(folder, device, written)


@functools.lru_cache(maxsize=1)
def _load_field(folder: Path, device: str, written: tuple[int, ...]) -> Fitted:
    about = read_json(folder / "field.json", made_by="nerf")
    tensors, _ = load_tensors(folder / "field.safetensors", "Run `python -m stages.nerf` first.")
    field = restore(about, tensors).to(device)
    try:
        near, far = (float(about["bounds"][name]) for name in ("near", "far"))
        if not 0 < near < far < math.inf:
            raise ValueError(f"{near} to {far}")
        gains = {} if about.get("gains") is None else _gains(about["photos"], about["gains"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"{folder / 'field.json'} tells no depths or brightnesses ({error!r}).",
            "Run `python -m stages.nerf` again.",
        ) from None
    return Fitted(field, near, far, gains)


def _gains(names: Sequence[str], values: Sequence[Sequence[float]]) -> dict[str, np.ndarray]:
    """The factors by the photos' names; ValueError when they do not fit."""
    gains = np.array(values, np.float32)
    if gains.shape != (len(names), 3) or not (np.isfinite(gains) & (gains > 0)).all():
        raise ValueError(f"{len(names)} photos with gains of shape {gains.shape}")
    return dict(zip(names, gains, strict=True))


def fit_key(
    field: GridField | PaperField,
    photos: Sequence[PosedPhoto],
    settings: Mapping[str, Any],
    device: str,
) -> str:
    """A hash of everything that decides a fit's result: for :class:`Checkpoint`."""
    about = {"field": describe(field), "settings": dict(settings), "device": device}
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    digest.update(code_key("field", "geometry").encode())
    for photo in photos:
        numbers = [*photo.intrinsics, photo.near, photo.far]
        for array in (photo.image, photo.keep_mask, photo.cam_from_world, np.array(numbers)):
            digest.update(np.ascontiguousarray(array).tobytes())
        if photo.drop_mask is not None:
            digest.update(np.ascontiguousarray(photo.drop_mask).tobytes())
    return digest.hexdigest()


class Checkpoint:
    """The state of one fit in a file, taken up again only by a fit with the same ``key``.

    A damaged file, or one of another fit, counts as none.
    """

    def __init__(self, file: Path, key: str) -> None:
        self.file, self.key = file, key

    def save(self, step: int, state: Mapping[str, Tensor]) -> None:
        """Replaces the file, whole or not at all."""
        tensors = {name: value.cpu() for name, value in state.items()}
        save_tensors(self.file, tensors, {"key": self.key, "step": str(step)})

    def load(self, device: str = "cpu") -> tuple[int, dict[str, Tensor]] | None:
        """Step and state of this very fit, if it was interrupted; what a kill left of a save is gone."""
        clear_torn(self.file)
        if not self.file.is_file():
            return None
        try:
            arrays, about = load_tensors(self.file)
        except UserError as error:
            log.warning("%s The fit starts over.", error.what)
            return None
        step = str(about.get("step", ""))
        if about.get("key") != self.key or not step.isdecimal():
            return None
        state = {name: torch.from_numpy(array).to(device) for name, array in arrays.items()}
        return int(step), state

    def remove(self) -> None:
        """The fit is done."""
        self.file.unlink(missing_ok=True)
