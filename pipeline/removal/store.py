"""Removers to files: weights in half precision, and checkpoints of a training under way."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from pipeline.io.atomic import write_bytes
from pipeline.io.tensors import save_tensors
from pipeline.removal.recipes import weights_of
from pipeline.removal.training import Trainer

Rows = list[list[float | str]]


def save_remover(path: Path, recipe: nn.Module, method: str) -> None:
    """Writes a recipe's networks as safetensors in float16, under their published names."""
    halves = {name: value.half().cpu().numpy() for name, value in weights_of(recipe).items()}
    save_tensors(path, halves, {"model": method})


def training_key(told: Mapping[str, Any], *files: Path | None) -> str:
    """A name for one training: its parameters and the bytes of the files that it starts from."""
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    for file in files:
        digest.update(file.read_bytes() if file else b"")
    return digest.hexdigest()[:16]


def save_checkpoint(path: Path, trainer: Trainer, rows: Rows) -> None:
    """Writes all that `load_checkpoint` needs to go on from here."""
    buffer = io.BytesIO()
    torch.save({"trainer": trainer.state(), "rows": rows}, buffer)
    write_bytes(path, buffer.getvalue())


def load_checkpoint(path: Path, trainer: Trainer) -> Rows:
    """Takes the trainer back to where it was saved; the curve's rows so far, none without a file."""
    if not path.is_file():
        return []
    saved = torch.load(path, map_location="cpu", weights_only=True)
    trainer.restore(saved["trainer"])
    rows: Rows = saved["rows"]
    return rows
