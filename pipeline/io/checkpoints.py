"""Checkpoints of a training under way: an interrupted one goes on from the last."""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

import torch

from pipeline.io.atomic import clear_torn, write_bytes
from pipeline.io.code import code_key

Rows = list[list[float | str]]
log = logging.getLogger(__name__)


class Resumable(Protocol):
    """A trainer that tells all that it needs to go on, and goes on from there."""

    def state(self) -> dict[str, Any]: ...

    def restore(self, state: dict[str, Any]) -> None: ...


def training_key(told: Mapping[str, Any], sources: Iterable[Path], *code: str) -> str:
    """A name for one training: its parameters, the bytes of what it starts and learns from, and its code.

    sources: files, and folders of which every file counts under its name; what is not there counts as
    nothing, since who needs it says so. code: rooms of `pipeline/`.
    """
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    digest.update(code_key(*code).encode())
    for source in sources:
        if source.is_file():
            digest.update(source.read_bytes())
        for file in sorted(path for path in source.rglob("*") if path.is_file()):
            digest.update(file.relative_to(source).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def save_checkpoint(path: Path, trainer: Resumable, rows: Rows) -> None:
    """Writes all that `load_checkpoint` needs to go on from here."""
    buffer = io.BytesIO()
    torch.save({"trainer": trainer.state(), "rows": rows}, buffer)
    write_bytes(path, buffer.getvalue())


def load_checkpoint(path: Path, trainer: Resumable) -> Rows:
    """Takes the trainer back to where it was saved; the curve's rows so far.

    Without a file there are none, and the trainer stays as it is; a damaged one counts as none. What a kill
    left of a save is gone.
    """
    clear_torn(path)
    if not path.is_file():
        return []
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        state, rows = saved["trainer"], list(saved["rows"])
    except Exception as error:  # what a damaged pickle raises has no common kind
        told = (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
        log.warning("%s cannot be read (%s); the training starts over.", path, told)
        return []
    trainer.restore(state)
    return rows
