"""What a remover's weights say of how they were trained, in the metadata of their safetensors file."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import UserError
from pipeline.io.tensors import load_tensors

EDGES = "published_edges"  # of quan: which edges it was trained with, see shape_attention.oriented_edges
MENDED = "mended"  # of wen: whether the photo was kept where its map says clear
WORDS = {False: "false", True: "true"}


def edges_of(weights: Path) -> bool | None:
    """Whether weights of quan were trained with the published edges; None where nothing is said.

    Published weights and those of earlier versions say nothing. UserError for a damaged file.
    """
    if weights.suffix != ".safetensors":
        return None
    told = load_tensors(weights)[1].get(EDGES)
    return {word: value for value, word in WORDS.items()}.get(str(told))


def check_edges(weights: Path, published: bool) -> None:
    """UserError where weights of quan say that they were trained with other edges than are asked for."""
    trained = edges_of(weights)
    if trained is not None and trained != published:
        raise UserError(
            f"{weights} was trained with published_edges: {WORDS[trained]}, "
            f"and restore.published_edges is {WORDS[published]}.",
            f"Set restore.published_edges to {WORDS[trained]}, or make weights with "
            f"train_remover.published_edges: {WORDS[published]}.",
        )
