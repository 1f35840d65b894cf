"""The contextual autoencoder of AttGAN (Qian et al., CVPR 2018): a photo and its map in, a dry photo out."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

MULTIPLE = 4  # sides of its input
DILATIONS = (2, 4, 8, 16)


class Scales(NamedTuple):
    """The pictures (N,3,h,w) at a quarter, half and the whole of the input's size; not clamped."""

    quarter: Tensor
    half: Tensor
    full: Tensor


def _conv(
    inputs: int, outputs: int, size: int = 3, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    padding = dilation * (size // 2)
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, padding, dilation), nn.ReLU(inplace=True)
    )


def _rise(inputs: int, outputs: int) -> nn.Sequential:
    """Twice the size; the mean over 2x2 evens out what the stride of the transposed product leaves."""
    return nn.Sequential(
        nn.ConvTranspose2d(inputs, outputs, 4, 2, 1),
        nn.ReflectionPad2d((1, 0, 1, 0)),
        nn.AvgPool2d(2, stride=1),
        nn.ReLU(inplace=True),
    )


class ContextualAutoencoder(nn.Module):
    """Removes the drops that the map of the attentive-recurrent network shows.

    State-dict names and shapes are those of the official generator without its sixteen attention
    convolutions: 6,076,553 numbers here, 6,244,362 in the whole generator. Source: R. Qian et al.,
    "Attentive Generative Adversarial Network for Raindrop Removal from a Single Image", CVPR 2018,
    section 4.1, and the layer shapes of its released code.
    """

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = _conv(4, 64, size=5)
        self.conv2 = _conv(64, 128, stride=2)
        self.conv3 = _conv(128, 128)
        self.conv4 = _conv(128, 256, stride=2)
        self.conv5 = _conv(256, 256)
        self.conv6 = _conv(256, 256)
        for number, dilation in enumerate(DILATIONS, 1):
            self.add_module(f"diconv{number}", _conv(256, 256, dilation=dilation))
        self.conv7 = _conv(256, 256)
        self.conv8 = _conv(256, 256)
        self.deconv1 = _rise(256, 128)
        self.conv9 = _conv(128, 128)
        self.deconv2 = _rise(128, 64)
        self.conv10 = _conv(64, 32)
        self.outframe1 = _conv(256, 3)
        self.outframe2 = _conv(128, 3)
        self.output = nn.Sequential(nn.Conv2d(32, 3, 3, 1, 1))

    def forward(self, bgr: Tensor, attention: Tensor) -> Scales:
        """bgr (N,3,H,W), 0-1, blue first; attention (N,1,H,W), raw; H and W multiples of 4."""
        whole = self.conv1(torch.cat([bgr, attention], 1))
        half = self.conv3(self.conv2(whole))
        x = self.conv6(self.conv5(self.conv4(half)))
        for number in range(1, len(DILATIONS) + 1):
            x = self.get_submodule(f"diconv{number}")(x)
        x = self.conv8(self.conv7(x))
        quarter = self.outframe1(x)
        x = self.conv9(self.deconv1(x) + half)
        middle = self.outframe2(x)
        x = self.conv10(self.deconv2(x) + whole)
        return Scales(quarter, middle, self.output(x))


def multi_scale_loss(scales: Scales, clean: Tensor) -> Tensor:
    """0.6, 0.8 and 1.0 times the mean squared error at a quarter, half and the whole of the size.

    clean (N,3,H,W), blue first. Source: Qian et al., CVPR 2018, equation 7.
    """
    weights = (0.6, 0.8, 1.0)
    total = clean.new_zeros(())
    for weight, picture in zip(weights, scales, strict=True):
        target = clean
        if picture.shape != clean.shape:
            target = F.interpolate(
                clean, picture.shape[-2:], mode="bilinear", align_corners=False, antialias=True
            )
        total = total + weight * F.mse_loss(picture, target)
    return total
