"""Small constant tensors, made once: each copy of one to a GPU would make the program wait for it."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor


def constant(values: tuple[Any, ...], like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """The numbers as a tensor on the device and, unless it is given, with the dtype of ``like``.

    The same tensor every time: not to be changed in place.
    """
    return _made(values, dtype or like.dtype, like.device)


@functools.lru_cache(maxsize=256)
def _made(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)
