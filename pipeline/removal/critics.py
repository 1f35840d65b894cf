"""The discriminators that AttGAN and Wen et al. train against; no weights of theirs are needed later."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.removal.losses import adversarial_map_loss, least_squares

SIDE = 224  # the only size that the attentive discriminator reads
MAP_WEIGHT = 0.05


class Verdict(NamedTuple):
    """probability (N,1) that a picture is a true dry photo; attention (N,1,224,224), raw."""

    probability: Tensor
    attention: Tensor


class AttentiveCritic(nn.Module):
    """The attentive discriminator of Qian et al. (CVPR 2018): 7,737,746 numbers, 224x224 pixels.

    Products of 5x5 and two dense layers without anything between them, as in the released code; that
    code applies conv7 twice, which cannot run, and here it is applied once.
    """

    weight = 0.01  # of the generator's loss

    def __init__(self) -> None:
        super().__init__()
        widths = (3, 8, 16, 64, 128, 128, 128)
        for number in range(1, 7):
            self.add_module(f"conv{number}", _conv(widths[number - 1], widths[number]))
        self.conv_mask = nn.Sequential(nn.Conv2d(128, 1, 5, 1, 2))
        self.conv7 = _conv(128, 64, stride=4, padding=1)
        self.conv8 = _conv(64, 32, stride=4, padding=1)
        self.fc = nn.Sequential(nn.Linear(32 * 14 * 14, 1024), nn.Linear(1024, 1), nn.Sigmoid())

    def forward(self, bgr: Tensor) -> Verdict:
        """bgr (N,3,224,224), 0-1, blue first."""
        x = bgr
        for number in range(1, 7):
            x = self.get_submodule(f"conv{number}")(x)
        attention = self.conv_mask(x)
        x = self.conv8(self.conv7(x * attention))
        return Verdict(self.fc(x.flatten(1)), attention)

    def fooled(self, fake: Tensor) -> Tensor:
        """log(1 - D(O)), which the generator lowers; equation 8 of the paper."""
        return torch.log(1 - self(fake).probability + 1e-6).mean()

    def loss(self, fake: Tensor, real: Tensor, attention: Tensor) -> Tensor:
        """-log D(R) - log(1 - D(O)) + 0.05 map loss; the paper's equations 8 and 9."""
        false, true = self(fake), self(real)
        told = torch.log(true.probability + 1e-6) + torch.log(1 - false.probability + 1e-6)
        maps = adversarial_map_loss(false.attention, true.attention, attention)
        return MAP_WEIGHT * maps - told.mean()


class PatchCritic(nn.Module):
    """Three discriminators of patches, each at half the size of the one before, for five frames.

    The frames lie on the channels (N,15,H,W). As in Wen et al. (ICRA 2023): 4x4 products from 64
    channels on, batch normalisation, least squares. Three strided layers as in pix2pixHD (Wang et
    al., CVPR 2018), where such discriminators come from.
    """

    weight = 1.0

    def __init__(self, channels: int = 15, scales: int = 3) -> None:
        super().__init__()
        self.scales = nn.ModuleList(_patches(channels) for _ in range(scales))

    def forward(self, frames: Tensor) -> list[Tensor]:
        """One map of verdicts per scale, 1 = true."""
        verdicts = []
        for scale in self.scales:
            verdicts.append(scale(frames))
            frames = F.avg_pool2d(frames, 3, 2, 1, count_include_pad=False)
        return verdicts

    def fooled(self, fake: Tensor) -> Tensor:
        return least_squares(self(fake), 1.0)

    def loss(self, fake: Tensor, real: Tensor, attention: Tensor) -> Tensor:
        return 0.5 * (least_squares(self(fake), 0.0) + least_squares(self(real), 1.0))


Critic = AttentiveCritic | PatchCritic


def _conv(inputs: int, outputs: int, stride: int = 1, padding: int = 2) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 5, stride, padding), nn.ReLU())


def _patches(channels: int) -> nn.Sequential:
    layers: list[nn.Module] = [nn.Conv2d(channels, 64, 4, 2, 2), nn.LeakyReLU(0.2)]
    for inputs, outputs, stride in ((64, 128, 2), (128, 256, 2), (256, 512, 1)):
        layers += [
            nn.Conv2d(inputs, outputs, 4, stride, 2),
            nn.BatchNorm2d(outputs),
            nn.LeakyReLU(0.2),
        ]
    return nn.Sequential(*layers, nn.Conv2d(512, 1, 4, 1, 2))
