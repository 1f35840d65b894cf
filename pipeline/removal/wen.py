"""The network of Wen et al. (2023): drops removed from five frames by spatial and temporal attention."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

MULTIPLE = 32
WIDTH = 256
FRAMES = 5
WEIGHED = 2**25  # pairs of patches whose weights are held at a time: 128 MB, a few times over


class Frames(NamedTuple):
    """quarter and half (B*T,3,h,w), full (B,T,3,H,W), all in [-1,1]; clear (B,T,1,H,W), 0 = drop."""

    quarter: Tensor
    half: Tensor
    full: Tensor
    clear: Tensor


class Features(NamedTuple):
    """What depends on single frames alone: x (N,256,H/4,W/4); clear (N,1,H,W), 0 = drop."""

    x: Tensor
    clear: Tensor


def mend(frames: Tensor, full: Tensor, clear: Tensor) -> Tensor:
    """The frames (...,3,H,W) where the map says that they are clear, and what was found elsewhere.

    The picture that the released training compares once more for single photos; the released program
    gives out `full` as it is.
    """
    return frames * clear + full * (1 - clear)


class _Wrapped(nn.Module):
    """A convolution under the name `conv`, as the released state dict has it."""

    def __init__(self, inputs: int, outputs: int, size: int, bias: bool) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, size, 1, size // 2, bias=bias)


class _Gate(_Wrapped):
    def __init__(self, relu: bool) -> None:
        super().__init__(WIDTH, WIDTH, 1, bias=False)
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.conv(x)) if self.relu else self.conv(x)


class _MaskRise(_Wrapped):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3, bias=True)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.conv(F.interpolate(x, scale_factor=2, mode="nearest")))


class _Sequence(nn.Module):
    """Layers under the name `model`."""

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.model = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return self.model(x)


def _halve(inputs: int, outputs: int) -> _Sequence:
    return _Sequence(nn.Conv2d(inputs, outputs, 3, 2, 1), nn.ReLU())


def _double(inputs: int, outputs: int) -> _Sequence:
    rise = nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)
    return _Sequence(rise, nn.Conv2d(inputs, outputs, 3, 1, 1), nn.ReLU())


class _Residual(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv_block = nn.Sequential(
            nn.ReflectionPad2d(1),
            nn.Conv2d(WIDTH, WIDTH, 3),
            nn.ReLU(),
            nn.Dropout(0.5),
            nn.ReflectionPad2d(1),
            nn.Conv2d(WIDTH, WIDTH, 3),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv_block(x)


class _PatchAttention(nn.Module):
    """Scaled dot-product attention between patches; the channels are shared out among patch sizes."""

    def __init__(self, patches: tuple[int, ...]) -> None:
        super().__init__()
        self.patches = patches
        self.query_embedding = nn.Conv2d(WIDTH, WIDTH, 1)
        self.value_embedding = nn.Conv2d(WIDTH, WIDTH, 1)
        self.key_embedding = nn.Conv2d(WIDTH, WIDTH, 1)
        self.output_linear = nn.Sequential(nn.Conv2d(WIDTH, WIDTH, 3, 1, 1), nn.LeakyReLU(0.2))
        self.softmax = nn.Softmax(dim=-1)

    def forward(self, x: Tensor, groups: int, own: Tensor | None = None) -> Tensor:
        """x (B*T,256,h,w); the patches of the B*T / groups frames of a group attend to each other.

        own: what asks, when that is not all of x: some of its frames, as many of each group.
        """
        own = x if own is None else own
        share = WIDTH // len(self.patches)
        split = [
            embedding(frames).split(share, 1)
            for embedding, frames in (
                (self.query_embedding, own),
                (self.key_embedding, x),
                (self.value_embedding, x),
            )
        ]
        heads = []
        for patch, *parts in zip(self.patches, *split, strict=True):
            q, k, v = (_tokens(part, patch, groups) for part in parts)
            out = self._attended(q, k, v).view(len(own), -1, share * patch * patch)
            heads.append(F.fold(out.transpose(1, 2), own.shape[-2:], patch, stride=patch))
        return self.output_linear(torch.cat(heads, 1))

    def _attended(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """The values that queries (groups,n,C) find: no more of them at a time than WEIGHED allows.

        Each weighs all keys by itself, so that blocks of queries change nothing but the memory,
        which would grow with the square of the picture's size.
        """
        most = max(1, WEIGHED // (k.shape[0] * k.shape[1]))
        found = []
        for part in q.split(most, 1):
            weights = self.softmax(part @ k.transpose(1, 2) / math.sqrt(q.shape[-1]))
            found.append(weights @ v)
        return torch.cat(found, 1)


def _tokens(part: Tensor, patch: int, groups: int) -> Tensor:
    """The patches (groups, patches of all its frames, numbers of one) of frames (N,C,h,w)."""
    unfolded = F.unfold(part, patch, stride=patch)
    return unfolded.unflatten(0, (groups, -1)).transpose(2, 3).flatten(1, 2)


class _FeedForward(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            nn.Conv2d(WIDTH, WIDTH, 3, padding=2, dilation=2),
            nn.LeakyReLU(0.2),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
            nn.LeakyReLU(0.2),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


class _AttentionBlock(nn.Module):
    def __init__(self, patches: tuple[int, ...]) -> None:
        super().__init__()
        self.attention = _PatchAttention(patches)
        self.feed_forward = _FeedForward()

    def forward(self, x: Tensor, groups: int, own: Tensor | None = None) -> Tensor:
        """All frames, or those of x that `own` is, after looking at x."""
        asking = x if own is None else own
        asking = asking + self.attention(x, groups, own)
        return asking + self.feed_forward(asking)


class WenNet(nn.Module):
    """Dry frames and a map of clear pixels from wet frames. 15,826,314 numbers, the released names.

    Source: Q. Wen et al., "Video Waterdrop Removal via Spatio-Temporal Fusion in Driving Scenes",
    ICRA 2023 (doi:10.1109/ICRA48891.2023.10160990), and the layers of its released code.
    """

    def __init__(self) -> None:
        super().__init__()
        self.main_branch = nn.Sequential(
            nn.ReflectionPad2d(3), nn.Conv2d(3, 64, 7), nn.ReLU(), _halve(64, 128), _halve(128, 256)
        )
        self.weight_branch = nn.Sequential(_Gate(relu=True), _Gate(relu=False))
        self.res_branch_1 = nn.Sequential(_Residual(), _Residual())
        self.res_branch_2 = nn.Sequential(_Residual(), _Residual())
        self.spatial_attention = nn.ModuleList([_AttentionBlock((2,))])
        self.temporal_attention = nn.ModuleList(_AttentionBlock((8, 4)) for _ in range(4))
        self.upsample_block = nn.Sequential(
            _double(256, 128),
            _double(128, 64),
            nn.ReflectionPad2d(3),
            nn.Conv2d(64, 3, 7),
            nn.Tanh(),
        )
        self.mask_branch = nn.Sequential(
            nn.ReLU(),
            _MaskRise(256, 128),
            _MaskRise(128, 64),
            nn.Conv2d(64, 1, 3, 1, 1),
            nn.Sigmoid(),
        )
        self.side_branch_1 = nn.Sequential(nn.Conv2d(256, 3, 3, 1, 1), nn.Tanh())
        self.side_branch_2 = nn.Sequential(nn.Conv2d(128, 3, 3, 1, 1), nn.Tanh())

    def forward(self, frames: Tensor) -> Frames:
        """frames (B,T,3,H,W), red first, in [-1,1]; H and W multiples of 32."""
        batch, count, _, height, width = frames.shape
        seen = self.features(frames.flatten(0, 1))
        quarter = self.side_branch_1(seen.x)
        x = self.temporal_attention[-1](self.fused(seen.x, batch), batch)
        x = self.upsample_block[0](x)
        half = self.side_branch_2(x)
        full = self.upsample_block[1:](x)
        return Frames(
            quarter,
            half,
            full.view(batch, count, 3, height, width),
            seen.clear.view(batch, count, 1, height, width),
        )

    def features(self, frames: Tensor) -> Features:
        """The part of `forward` that looks at single frames (N,3,H,W)."""
        x = self.res_branch_1(self.main_branch(frames))
        gate = self.weight_branch(x)
        clear = self.mask_branch(gate)
        x = x * torch.sigmoid(gate)
        for block in self.spatial_attention:
            x = block(x, len(frames))
        return Features(self.res_branch_2(x), clear)

    def fused(self, x: Tensor, groups: int) -> Tensor:
        """Features x of frames (N,256,h,w) before the last block in which those of a group meet."""
        for block in self.temporal_attention[:-1]:
            x = block(x, groups)
        return x

    def picture(self, fused: Tensor, place: int) -> Tensor:
        """`Frames.full` (1,3,H,W) of one frame of a group, from what `fused` gives for all of it."""
        x = self.temporal_attention[-1](fused, 1, fused[place : place + 1])
        full: Tensor = self.upsample_block(x)
        return full
