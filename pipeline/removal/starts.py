"""Starting weights from which minutes of training get somewhere: each remover first copies its photo.

None of the three networks adds its result to the photo, so that plain random weights must learn to
copy before they can mend. Where a network's own layers can carry the photo to its end, they are set
to do so; everything else is drawn at random, and the layers stay what they were published as.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from pipeline.removal.autoencoder import ContextualAutoencoder
from pipeline.removal.quan import QuanNet
from pipeline.removal.wen import WenNet

SMALL = 0.1


def draw(network: nn.Module, seed: int) -> None:
    """He's normal weights for all products of a network, and no biases."""
    generator = torch.Generator().manual_seed(seed)
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.Linear | nn.ConvTranspose2d):
            fan = module.weight[0].numel()
            if isinstance(module, nn.ConvTranspose2d):  # each output meets a quarter of the kernel
                fan = module.weight.shape[0] * module.weight[0, 0].numel() // 4
            module.weight.normal_(0, math.sqrt(2 / fan), generator=generator)
            if module.bias is not None:
                module.bias.zero_()


@torch.no_grad()
def start_attgan(network: ContextualAutoencoder, seed: int) -> None:
    """The photo and the map pass along conv1, the outer skip and conv10 in their own channels."""
    draw(network, seed)
    _pass(network.conv1[0], range(4), range(4))
    rise = network.deconv2[0]
    rise.weight[:, :4] = 0  # what rises from the middle does not meet them
    _pass(network.conv10[0], range(3), range(3))
    network.output[0].weight *= SMALL
    _pass(network.output[0], range(3), range(3))
    for head in (network.outframe1[0], network.outframe2[0]):
        head.weight *= SMALL
        head.bias.fill_(0.4)  # their ends cannot be negative: not from zero


@torch.no_grad()
def start_quan(network: QuanNet, seed: int) -> None:
    """The photo passes along enc1_1, the outer skip and dec1_0; residual branches begin quiet."""
    draw(network, seed)
    for name, module in network.named_modules():
        if name.endswith("conv1_2"):
            module.weight *= SMALL
            module.weight[:3] = 0
    _pass(network.enc1_1, range(3), range(3))
    network.dec1_4.weight[:, :3] = 0
    network.dec1_0.weight *= SMALL
    _pass(network.dec1_0, range(3), range(3))


@torch.no_grad()
def start_wen(network: WenNet, seed: int) -> None:
    """Sixteen pixels of each colour go down into 48 channels; residual and attention begin quiet.

    There is no skip to the end, and what rises there is smoothed by the upsampling: the way back up
    has to be learnt (`WenNet` at the phase `carry`).
    """
    draw(network, seed)
    first, half, quarter = (network.main_branch[k] for k in (1, 3, 4))
    _pass(first, range(3), range(3))
    first.bias[:3] = 1.0  # [-1,1] becomes [0,2]: what follows cuts at zero
    for layer, count in ((half.model[0], 3), (quarter.model[0], 12)):
        layer.weight[: 4 * count] = 0
        for k in range(count):
            for row in (0, 1):
                for column in (0, 1):
                    layer.weight[4 * k + 2 * row + column, k, 1 + row, 1 + column] = 1
    for block in (*network.res_branch_1, *network.res_branch_2):
        block.conv_block[5].weight *= SMALL
    for block in (*network.spatial_attention, *network.temporal_attention):
        block.attention.output_linear[0].weight *= SMALL
        block.feed_forward.conv[2].weight *= SMALL
    network.weight_branch[1].conv.weight *= SMALL
    for head in (network.side_branch_1[0], network.side_branch_2[0], network.upsample_block[3]):
        head.weight *= SMALL
    network.mask_branch[3].weight *= SMALL
    network.mask_branch[3].bias.fill_(1.0)  # most pixels are clear


def _pass(layer: nn.Module, outputs: range, inputs: range) -> None:
    """Output channels that are input channels, unchanged; nothing else reads or adds to them."""
    weight = layer.weight
    assert isinstance(weight, Tensor)
    weight[list(outputs)] = 0
    middle = weight.shape[-1] // 2
    for output, source in zip(outputs, inputs, strict=True):
        weight[output, source, middle, middle] = 1
