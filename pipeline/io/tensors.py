"""Named arrays in safetensors files: no code runs when one is opened."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from pipeline.errors import UserError
from pipeline.io.atomic import whole_file


def save_tensors(
    path: Path, tensors: Mapping[str, Any], metadata: Mapping[str, str] | None = None
) -> None:
    """Writes named arrays (NumPy, or torch on the CPU without gradients) and text metadata."""
    arrays = {name: np.ascontiguousarray(np.asarray(tensors[name])) for name in sorted(tensors)}
    # One entry only: the format's writer keeps several in no fixed order, and the bytes would vary.
    header = {"metadata": json.dumps(dict(metadata), sort_keys=True)} if metadata else None
    with whole_file(path) as fresh:  # not as one string of bytes: a fit's state would be held twice
        safetensors.numpy.save_file(arrays, fresh, metadata=header)


def load_tensors(path: Path, hint: str = "") -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The named arrays of a safetensors file and its metadata; UserError when missing or damaged."""
    if not path.is_file():
        raise UserError(f"{path} does not exist.", hint)
    try:
        with safetensors.safe_open(str(path), framework="numpy") as file:
            header = file.metadata() or {}
            metadata = json.loads(header["metadata"]) if "metadata" in header else header
            if not isinstance(metadata, dict):
                raise ValueError("its metadata are no names with values")
            return {name: file.get_tensor(name) for name in file.keys()}, metadata  # noqa: SIM118
    except (safetensors.SafetensorError, OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is not a readable safetensors file ({error}).", hint.replace("first", "again")
        ) from None
    except (TypeError, AttributeError) as error:  # of a kind that NumPy has no name for
        raise UserError(
            f"{path} holds numbers of a kind that cannot be read ({error}).",
            f"Convert them to float32. {hint.replace('first', 'again')}".strip(),
        ) from None
