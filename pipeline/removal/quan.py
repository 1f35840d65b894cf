"""The network of Quan et al. (ICCV 2019): shape-driven attention and channel re-calibration."""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.removal.shape_attention import shape_attention

MULTIPLE = 4
SCOPE = "g_net"


class _Same(nn.Conv2d):
    """A 5x5 product with TensorFlow's SAME padding: for a stride, the odd pixel comes after."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(inputs, outputs, 5, stride)

    def forward(self, x: Tensor) -> Tensor:
        pads = []
        for length in (x.shape[-1], x.shape[-2]):
            step = self.stride[0]
            total = max((-(-length // step) - 1) * step + 5 - length, 0)
            pads += [total // 2, total - total // 2]
        return super().forward(F.pad(x, pads))


class _Calibration(nn.Module):
    """One factor in (0,1) per channel, from its mean and its maximum through a shared network."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mlp_0 = nn.Linear(channels, channels // 2)
        self.mlp_1 = nn.Linear(channels // 2, channels)

    def forward(self, x: Tensor) -> Tensor:
        pooled = (x.mean((2, 3)), x.amax((2, 3)))
        mean, most = (self.mlp_1(F.relu(self.mlp_0(values))) for values in pooled)
        return torch.sigmoid(mean + most)[:, :, None, None]


class _Block(nn.Module):
    """A residual block whose branch is scaled per channel and per pixel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1_1 = _Same(channels, channels)
        self.conv1_2 = _Same(channels, channels)
        self.ch_at = _Calibration(channels)

    def forward(self, x: Tensor, shape: Tensor) -> Tensor:
        branch = self.conv1_2(F.relu(self.conv1_1(x)))
        scaled = branch * self.ch_at(branch)
        return F.relu(scaled + shape.mean(1, keepdim=True) * scaled + x)


class QuanNet(nn.Module):
    """A dry photo from a wet one. 7,271,715 numbers; names follow the released TensorFlow scopes.

    Source: Y. Quan et al., "Deep Learning for Seeing Through Window With Raindrops", ICCV 2019
    (doi:10.1109/ICCV.2019.00255), and the layers of its released code. There the channel-scaled
    branch is used with and without the shape factor: (1 + s) c F.
    """

    def __init__(self) -> None:
        super().__init__()
        self.att1_1, self.att2_1, self.att3_1 = _Same(1, 32), _Same(32, 64, 2), _Same(64, 128, 2)
        self.enc1_1, self.enc2_1, self.enc3_1 = _Same(9, 32), _Same(32, 64, 2), _Same(64, 128, 2)
        for level, channels in ((1, 32), (2, 64), (3, 128)):
            for number in (2, 3, 4):
                self.add_module(f"enc{level}_{number}", _Block(channels))
            for number in (3, 2, 1):
                self.add_module(f"dec{level}_{number}", _Block(channels))
        self.dec2_4 = nn.ConvTranspose2d(128, 64, 4, 2, 1)
        self.dec1_4 = nn.ConvTranspose2d(64, 32, 4, 2, 1)
        self.dec1_0 = _Same(32, 3)

    def forward(self, rgb: Tensor, *, published: bool = True) -> Tensor:
        """The dry pictures (N,3,H,W), not clamped, of rgb (N,3,H,W) in [0,1]; sides multiples of 4."""
        return self.dec1_0(self.decoded(rgb, published=published)[-1])

    def decoded(self, rgb: Tensor, *, published: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        """What the decoder holds at a quarter (128 channels), half (64) and full size (32)."""
        attention = shape_attention(rgb, published=published)
        shape1 = F.relu(self.att1_1(attention))
        shape2 = F.relu(self.att2_1(shape1))
        shape3 = F.relu(self.att3_1(shape2))
        x = F.relu(self.enc1_1(torch.cat([rgb, rgb * attention, rgb.detach()], 1)))
        skip1 = self._blocks("enc1", (2, 3, 4), x, shape1)
        skip2 = self._blocks("enc2", (2, 3, 4), F.relu(self.enc2_1(skip1)), shape2)
        x = self._blocks("enc3", (2, 3, 4), F.relu(self.enc3_1(skip2)), shape3)
        quarter = self._blocks("dec3", (3, 2, 1), x, shape3)
        half = self._blocks("dec2", (3, 2, 1), F.relu(self.dec2_4(quarter)) + skip2, shape2)
        full = self._blocks("dec1", (3, 2, 1), F.relu(self.dec1_4(half)) + skip1, shape1)
        return quarter, half, full

    def _blocks(self, level: str, numbers: tuple[int, ...], x: Tensor, shape: Tensor) -> Tensor:
        for number in numbers:
            x = self.get_submodule(f"{level}_{number}")(x, shape)
        return x


def tensorflow_name(name: str) -> str:
    """The released checkpoint's name of this network's tensor `name`."""
    scope, kind = name.rsplit(".", 1)
    dense = scope.endswith(("mlp_0", "mlp_1"))
    words = {"weight": "kernel" if dense else "weights", "bias": "bias" if dense else "biases"}
    return f"{SCOPE}/{scope.replace('.', '/')}/{words[kind]}"


def from_tensorflow(arrays: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state dict of QuanNet out of a released checkpoint's arrays, by their TensorFlow names.

    Products there are stored (rows, columns, in, out), transposed ones (rows, columns, out, in) and
    dense ones (in, out). Optimiser slots and counters are passed over.
    """
    ours = {tensorflow_name(name): name for name in QuanNet().state_dict()}
    state = {}
    for name, array in arrays.items():
        plain = re.sub(r":0$", "", name)
        if plain not in ours:
            continue
        if array.ndim == 4:
            array = array.permute(3, 2, 0, 1)
        elif array.ndim == 2:
            array = array.t()
        state[ours[plain]] = array.contiguous()
    return state
