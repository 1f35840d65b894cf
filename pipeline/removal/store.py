"""Removers to files: weights in half precision."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from pipeline.io.tensors import save_tensors
from pipeline.removal.recipes import weights_of


def save_remover(path: Path, recipe: nn.Module, method: str) -> None:
    """Writes a recipe's networks as safetensors in float16, under their published names."""
    halves = {name: value.half().cpu().numpy() for name, value in weights_of(recipe).items()}
    save_tensors(path, halves, {"model": method})
