"""A small U-Net that sees a drop whole: the second detector, many times cheaper per pixel."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval

WIDTHS = (16, 32, 48, 64, 96)


class _Block(nn.Module):
    """Two 3x3 convolutions, each normalised and rectified."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, 1, 1, bias=False)
        self.norm1: nn.Module = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.norm2: nn.Module = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(N,inputs,H,W) to (N,outputs,H,W)."""
        x = F.relu(self.norm1(self.conv1(x)))
        return F.relu(self.norm2(self.conv2(x)))

    def fuse(self) -> None:
        """Takes the normalisations into the convolutions: the same in evaluation, but faster."""
        for k in "12":
            norm = getattr(self, f"norm{k}")
            if isinstance(norm, nn.BatchNorm2d):
                conv = getattr(self, f"conv{k}").eval()
                setattr(self, f"conv{k}", fuse_conv_bn_eval(conv, norm.eval()))
                setattr(self, f"norm{k}", nn.Identity())


class DropUNet(nn.Module):
    """A map of drops from a photo, seen at five scales from full size to a sixteenth.

    Halving by maxima, doubling by repetition, skip connections; 138 pixels in view to each side. Any size:
    the photo is continued by its border to multiples of 16 and the map cut back.

    Source: O. Ronneberger et al., "U-Net: Convolutional Networks for Biomedical Image
    Segmentation", MICCAI 2015; normalised, with padding, and much narrower.
    """

    model = "unet"
    grid = 2 ** (len(WIDTHS) - 1)

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.ModuleList(_Block(a, b) for a, b in pairwise((3, *WIDTHS)))
        self.up = nn.ModuleList(_Block(b + a, a) for a, b in reversed(list(pairwise(WIDTHS))))
        self.last = nn.Conv2d(WIDTHS[0], 1, 1)

    def forward(self, bgr: Tensor) -> Tensor:
        """Log-odds (N,1,H,W) of the map. bgr: (N,3,H,W), 0-1, blue first."""
        height, width = bgr.shape[-2:]
        x = F.pad(bgr, (0, -width % self.grid, 0, -height % self.grid), mode="replicate") - 0.5
        kept: list[Tensor] = []
        for block in self.down:
            x = block(F.max_pool2d(x, 2) if kept else x)
            kept.append(x)
        for block, skip in zip(self.up, reversed(kept[:-1]), strict=True):
            x = block(torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), skip], 1))
        return self.last(x)[..., :height, :width]

    def attention(self, bgr: Tensor, steps: int = 1) -> Tensor:
        """The map (N,1,H,W) in [0,1]; there are no steps to repeat."""
        return torch.sigmoid(self(bgr))

    def reach(self, steps: int = 1) -> int:
        """No pixel of the map depends on the photo further away, in multiples of `grid`."""
        levels = len(WIDTHS)
        down = sum(2 * 2**k + 2**k for k in range(levels))  # two convolutions, half a window
        up = sum(2 * 2**k + 2**k for k in range(levels - 1))
        return math.ceil((down + up) / self.grid) * self.grid

    def initialise(self, seed: int) -> None:
        """Draws starting weights: for rectifiers, and a map that starts at a drop in ten pixels."""
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for module in self.modules():
                if isinstance(module, nn.Conv2d):
                    deviation = math.sqrt(2 / module.weight[0].numel())
                    module.weight.normal_(0, deviation, generator=generator)
            self.last.weight.mul_(0.1)
            assert self.last.bias is not None
            self.last.bias.fill_(math.log(0.1 / 0.9))

    def for_inference(self) -> DropUNet:
        """This network in evaluation mode with its normalisations taken into the convolutions."""
        self.eval()
        for module in self.modules():
            if isinstance(module, _Block):
                module.fuse()
        return self
