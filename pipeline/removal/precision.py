"""Where the removers multiply bfloat16 numbers, and what stays in float32 to be seen nowhere."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from pipeline.io.processor import multiplies_bfloat16

# What carries the photo itself into the result, or writes it: 8 bits of a number are too few there. AttGAN's
# attention is computed outside (`clean.clean_attgan`): its map decides what is mended.
EXACT = {
    "attgan": ("conv1", "conv10", "output"),
    "quan": ("enc1_1", "dec1_0"),
    "wen": ("main_branch", "upsample_block.1", "upsample_block.3"),
}


def in_half(precision: str, device: str) -> bool:
    """Whether a remover multiplies bfloat16 numbers on `device`: float32, bfloat16 or auto.

    auto: on a CPU that multiplies them by itself. Nothing was measured on a GPU, where it stays as it is.
    """
    if precision == "auto":
        return device == "cpu" and multiplies_bfloat16()
    return precision == "bfloat16"


def keep_exact(network: nn.Module, method: str) -> None:
    """Lets the layers EXACT of a remover, softmax and factors of channels compute in float32 always.

    For restoring: training in bfloat16 has all its layers in it.
    """
    for name, layer in network.named_modules():
        if name in EXACT[method] or isinstance(layer, (nn.Softmax, nn.Linear)):
            layer.forward = partial(_in_float32, layer.forward)


def products(device: torch.device, half: bool) -> torch.autocast:
    """The context in which products are of bfloat16 numbers, or of float32 as they are."""
    return torch.autocast(device.type, torch.bfloat16, enabled=half)


def _in_float32(forward: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    with torch.autocast(x.device.type, enabled=False):
        return forward(x.float())
