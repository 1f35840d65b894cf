"""The published losses of the three removers, and the features that two of them compare."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.errors import UserError
from pipeline.io.weights import read_state
from pipeline.removal.wen import Frames, mend

# Channels of VGG's convolutions by its depth; 0 halves the size.
VGG = {
    16: (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512),
    19: (64, 64, 0, 128, 128, 0, *[256] * 4, 0, *[512] * 4, 0, *[512] * 4),
}
DEPTHS = {"attgan": 16, "wen": 19}
# Layers (numbers of torchvision's `features`) that are compared, with their weights.
ATTGAN_TAPS = {1: 0.25, 3: 0.25, 6: 0.25, 8: 0.25}  # relu1_1, 1_2, 2_1, 2_2: their mean
WEN_TAPS = {1: 1 / 32, 6: 1 / 16, 11: 1 / 8, 20: 1 / 4, 29: 1.0}  # relu1_1 to relu5_1


class PerceptualLoss(nn.Module):
    """The distance of two pictures in a frozen VGG: weighted mean squares, or absolutes, of features.

    path: torchvision's state dict of VGG-16 for `attgan` (mean squares) or VGG-19 for `wen`
    (absolutes), of which only the convolutions that are needed are read. Pictures go in as they are,
    without ImageNet's mean and deviation, as in the released codes. UserError for other weights, and
    for `quan`, which has no such loss.
    """

    def __init__(self, path: Path, method: str) -> None:
        super().__init__()
        hint = "Set train_remover.perceptual to VGG-16 (attgan) or VGG-19 (wen), or to nothing."
        if method not in DEPTHS:
            raise UserError(f"{method} is trained without a perceptual loss.", hint)
        depth, state = DEPTHS[method], read_state(path, hint)
        self.taps = ATTGAN_TAPS if depth == 16 else WEN_TAPS
        self.distance = F.mse_loss if depth == 16 else F.l1_loss
        layers: list[nn.Module] = []
        channels = 3
        for width in VGG[depth]:
            if width == 0:
                layers.append(nn.MaxPool2d(2))
                continue
            layers += [nn.Conv2d(channels, width, 3, 1, 1), nn.ReLU()]
            channels = width
        self.features = nn.Sequential(*layers[: max(self.taps) + 1])
        wanted = {f"features.{name}": name for name, _ in self.features.named_parameters()}
        missing = [name for name in wanted if name not in state]
        if missing:
            raise UserError(
                f"{path} is not torchvision's VGG-{depth}: {missing[0]} is missing.", hint
            )
        self.features.load_state_dict({short: state[long] for long, short in wanted.items()})
        self.requires_grad_(False)

    def forward(self, found: Tensor, wanted: Tensor) -> Tensor:
        """found, wanted: (N,3,H,W)."""
        total = found.new_zeros(())
        for number, layer in enumerate(self.features):
            found, wanted = layer(found), layer(wanted)
            if number in self.taps:
                total = total + self.taps[number] * self.distance(found, wanted)
        return total


def wen_loss(
    found: Frames, rainy: Tensor, clean: Tensor, drops: Tensor, perceptual: nn.Module | None = None
) -> Tensor:
    """The generator's loss for clips, but for the part of its discriminator.

    25 MSE + 25 MSE within the drops + 10 perceptual + 50 and 25 MSE at a quarter and half the size
    (of every fourth and second pixel) + 10 cross-entropy of the map of clear pixels. For single
    pictures 5 cross-entropy, and the perceptual loss a second time on the photo where the map found
    says clear and the picture elsewhere; the plain MSE, which they lack there, stays: without a
    backbone nothing else would hold the picture.
    rainy, clean (B,T,3,H,W) in [-1,1]; drops (B,T,1,H,W), 1 = drop.
    Source: Wen et al., ICRA 2023, and the weights in its released code.
    """
    target = clean.flatten(0, 1)
    full, wet = found.full.flatten(0, 1), drops.flatten(0, 1)
    single = clean.shape[1] == 1
    loss = 25 * F.mse_loss(full, target) + 25 * F.mse_loss(full * wet, target * wet)
    loss = loss + 50 * F.mse_loss(found.quarter, target[..., ::4, ::4])
    loss = loss + 25 * F.mse_loss(found.half, target[..., ::2, ::2])
    clear = found.clear.float().flatten(0, 1).clamp(1e-6, 1 - 1e-6)  # 1 - 1e-6 is 1 in bfloat16
    with torch.autocast(clear.device.type, enabled=False):  # a GPU's autocast refuses this one
        map_loss = F.binary_cross_entropy(clear, 1 - wet.float())
    loss = loss + (5 if single else 10) * map_loss
    if perceptual is not None:
        loss = loss + 10 * perceptual(full, target)
        if single:
            mended = mend(rainy, found.full, found.clear)
            loss = loss + 10 * perceptual(mended.flatten(0, 1), target)
    return loss


def adversarial_map_loss(fake_map: Tensor, real_map: Tensor, attention: Tensor) -> Tensor:
    """How far the discriminator's map is from the generator's, and from nothing on a true dry photo.

    Source: Qian et al., CVPR 2018, equation 9.
    """
    return F.mse_loss(fake_map, attention) + F.mse_loss(real_map, torch.zeros_like(real_map))


def least_squares(verdicts: Sequence[Tensor], truth: float) -> Tensor:
    """The sum over scales of the mean (verdict - truth)^2, as in the released code of Wen et al.

    The least-squares GAN: Mao et al., ICCV 2017.
    """
    each = [F.mse_loss(verdict, torch.full_like(verdict, truth)) for verdict in verdicts]
    return torch.stack(each).sum()
