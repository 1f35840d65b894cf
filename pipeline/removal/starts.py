"""Starting weights from which minutes of training get somewhere: each remover first copies its photo.

None of the three networks adds its result to the photo, so that plain random weights must learn to
copy before they can mend. Where a network's own layers can carry the photo to its end, they are set
to do so; everything else is drawn at random, and the layers stay what they were published as.
"""

from __future__ import annotations

import itertools
import math
import re

import torch
from torch import Tensor, nn

from pipeline.removal.autoencoder import ContextualAutoencoder
from pipeline.removal.quan import QuanNet
from pipeline.removal.wen import WenNet

SMALL = 0.1
FAINT = 0.02


def draw(network: nn.Module, seed: int) -> None:
    """He's normal weights for all products of a network, and no biases."""
    generator = torch.Generator().manual_seed(seed)
    for name, values in network.named_parameters():
        if name.endswith("bias"):
            values.zero_()
            continue
        fan = values[0].numel()
        if isinstance(network.get_submodule(name.rpartition(".")[0]), nn.ConvTranspose2d):
            fan = values[:, 0].numel() // 4  # each output meets a quarter of the kernel
        values.normal_(0, math.sqrt(2 / fan), generator=generator)


@torch.no_grad()
def start_attgan(network: ContextualAutoencoder, seed: int) -> None:
    """The photo and the map pass along conv1, the outer skip and conv10 in their own channels."""
    draw(network, seed)
    parts = dict(network.named_parameters())
    _pass(parts["conv1.0.weight"], 4)
    parts["deconv2.0.weight"][:, :4] = 0  # what rises from the middle does not meet them
    _pass(parts["conv10.0.weight"], 3)
    _pass(parts["output.0.weight"], 3)
    for head in ("outframe1.0", "outframe2.0"):
        parts[f"{head}.weight"].mul_(SMALL)
        parts[f"{head}.bias"].fill_(0.4)  # their ends cannot be negative: not from zero


@torch.no_grad()
def start_quan(network: QuanNet, seed: int) -> None:
    """The photo passes along enc1_1, the outer skip and dec1_0; residual branches begin quiet.

    All other channels meet it in dec1_0 through small weights, not through none: with none no
    gradient reaches what lies within the outer skip.
    """
    draw(network, seed)
    parts = dict(network.named_parameters())
    for name, values in parts.items():
        if name.endswith("conv1_2.weight"):
            values.mul_(SMALL)
            values[:3] = 0
    _pass(parts["enc1_1.weight"], 3)
    parts["dec1_4.weight"][:, :3] = 0
    last = parts["dec1_0.weight"]
    others = FAINT * last[:, 3:]
    _pass(last, 3)
    last[:, 3:] = others


# Of Wen's: the last product of each branch that is added to what passes by; gates and heads.
WEN_BRANCHES = re.compile(r"(conv_block\.5|output_linear\.0|feed_forward\.conv\.2)\.weight$")
WEN_HEADS = re.compile(
    r"(weight_branch\.1\.conv|side_branch_[12]\.0|upsample_block\.3|mask_branch\.3)\.weight$"
)


@torch.no_grad()
def start_wen(network: WenNet, seed: int) -> None:
    """Sixteen pixels of each colour go down into 48 channels; residual and attention begin quiet.

    There is no skip to the end, and what rises there is smoothed by the upsampling: the channels go
    up as they are, the last layer takes the mean of their pixels, each from where it lies, and the
    way back up has to be learnt from there (the phase `carry` of training).
    """
    draw(network, seed)
    parts = dict(network.named_parameters())
    _pass(parts["main_branch.1.weight"], 3)
    parts["main_branch.1.bias"][:3] = 1  # [-1,1] becomes [0,2]: what follows cuts at zero
    for name, count in (("main_branch.3.model.0.weight", 3), ("main_branch.4.model.0.weight", 12)):
        down = parts[name]
        down[: 4 * count] = 0
        for k, row, column in itertools.product(range(count), (0, 1), (0, 1)):
            down[4 * k + 2 * row + column, k, 1 + row, 1 + column] = 1
    for name in ("upsample_block.0.model.1.weight", "upsample_block.1.model.1.weight"):
        _pass(parts[name], 48)
    for name, values in parts.items():
        if WEN_BRANCHES.search(name):
            values.mul_(FAINT)
        elif WEN_HEADS.search(name):
            values.mul_(SMALL)
    _gather(parts["upsample_block.3.weight"])
    parts["upsample_block.3.bias"].fill_(-1)
    parts["mask_branch.3.bias"].fill_(1)  # most pixels are clear


def _gather(last: Tensor) -> None:
    """The 7x7 product (3,64,7,7) that takes 2x the mean of the sixteen pixels of each colour.

    Pixel r of four lies 1.5 - r pixels from where its channel stands after two doublings.
    """
    last[:, :48] = 0
    for k, (rows, columns) in itertools.product(
        range(3), itertools.product(itertools.product((0, 1), (0, 1)), repeat=2)
    ):
        channel = 16 * k + 8 * rows[0] + 4 * columns[0] + 2 * rows[1] + columns[1]
        y, x = (2 * second + first for first, second in (rows, columns))
        last[k, channel, 4 - y : 6 - y, 4 - x : 6 - x] = 2 / 16 / 4


def _pass(weight: Tensor, count: int) -> None:
    """The first channels that come in go out unchanged, and nothing else adds to them."""
    weight[:count] = 0
    middle = weight.shape[-1] // 2
    for k in range(count):
        weight[k, k, middle, middle] = 1
