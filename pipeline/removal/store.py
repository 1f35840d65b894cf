"""Removers to files: weights in half precision, and how they were trained."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from pipeline.io.tensors import save_tensors
from pipeline.removal import record
from pipeline.removal.recipes import QuanRecipe, WenRecipe, weights_of


def save_remover(path: Path, recipe: nn.Module, method: str) -> None:
    """Writes a recipe's networks as safetensors in float16, under their published names.

    The metadata tell the method, and what restoring wants to know of the training; see `record`.
    """
    about = {"model": method}
    if isinstance(recipe, QuanRecipe):
        about[record.EDGES] = record.WORDS[recipe.published_edges]
    elif isinstance(recipe, WenRecipe):
        about[record.MENDED] = record.WORDS[recipe.added.wen_mended > 0]
    halves = {name: value.half().cpu().numpy() for name, value in weights_of(recipe).items()}
    save_tensors(path, halves, about)
