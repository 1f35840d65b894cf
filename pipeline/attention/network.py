"""The attention part of the published generator (Qian et al., CVPR 2018), layer by layer."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

STEPS = 4
FEATURES = 32
# One step looks this many pixels to each side: conv0, ten residual convolutions, gates, map.
STEP_RADIUS = 13


def _conv(inputs: int, outputs: int = FEATURES) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, 1, 1)


def _residual() -> nn.Sequential:
    return nn.Sequential(_conv(FEATURES), nn.ReLU(), _conv(FEATURES), nn.ReLU())


class AttentiveRecurrentNet(nn.Module):
    """Maps of drops from a photo, refined over steps that share their weights.

    One step reads the photo and the last map, runs five residual blocks and a ConvLSTM, and
    predicts the next map. State-dict names and shapes are those of the first sixteen
    convolutions of the official generator, 167,809 numbers.

    Source: R. Qian et al., "Attentive Generative Adversarial Network for Raindrop Removal from
    a Single Image", CVPR 2018, section 4.1, and the layer shapes of its released code: gates
    read features and hidden state, there are no peepholes, the map has no final activation.
    """

    model = "attentive"
    grid = 1  # tiles may begin at any pixel

    def __init__(self) -> None:
        super().__init__()
        self.det_conv0 = nn.Sequential(_conv(4), nn.ReLU())
        self.det_conv1 = _residual()
        self.det_conv2 = _residual()
        self.det_conv3 = _residual()
        self.det_conv4 = _residual()
        self.det_conv5 = _residual()
        self.conv_i = nn.Sequential(_conv(2 * FEATURES), nn.Sigmoid())
        self.conv_f = nn.Sequential(_conv(2 * FEATURES), nn.Sigmoid())
        self.conv_g = nn.Sequential(_conv(2 * FEATURES), nn.Tanh())
        self.conv_o = nn.Sequential(_conv(2 * FEATURES), nn.Sigmoid())
        self.det_conv_mask = nn.Sequential(_conv(FEATURES, 1))

    def forward(self, bgr: Tensor, steps: int = STEPS) -> list[Tensor]:
        """The raw maps of all steps, first to last, each (N,1,H,W); about [0,1], not clamped.

        bgr: (N,3,H,W), 0-1, blue first. The map starts at 0.5, hidden and cell state at 0.
        """
        attention = torch.full_like(bgr[:, :1], 0.5)
        state: tuple[Tensor, Tensor] | None = None
        maps = []
        for _ in range(steps):
            features = self.features(torch.cat([bgr, attention], 1))
            state = self.recur(features, state)
            attention = self.det_conv_mask(state[0])
            maps.append(attention)
        return maps

    def attention(self, bgr: Tensor, steps: int = STEPS) -> Tensor:
        """The last map (N,1,H,W), clamped to [0,1], which the network's last layer does not do."""
        return self(bgr, steps)[-1].clamp(0, 1)

    def reach(self, steps: int = STEPS) -> int:
        """No pixel of the map depends on the photo further away than this."""
        return STEP_RADIUS * steps

    def for_inference(self) -> AttentiveRecurrentNet:
        """This network in evaluation mode."""
        return self.eval()

    def initialise(self, seed: int) -> None:
        """Draws starting weights from which a few minutes of training get somewhere.

        The first layer reads differences (each of its kernels sums to zero over the photo) four
        times as strongly as usual, because drops show in contrast, not in brightness. The gates
        start open and, like the residual branches, quiet, so that nothing is saturated. From plain
        starting values nothing was learnt in the same time.
        """
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for module in self.modules():
                if isinstance(module, nn.Conv2d):
                    deviation = math.sqrt(2 / module.weight[0].numel())
                    module.weight.normal_(0, deviation, generator=generator)
                    bias_of(module).zero_()
            first = first_layer(self.det_conv0).weight
            first[:, :3] -= first[:, :3].mean((2, 3), keepdim=True)
            first[:, :3] *= 4
            first[:, 3:] *= 0.1
            for block in self.residual_blocks():
                last_layer(block).weight *= 0.3
            for gate in (self.conv_i, self.conv_f, self.conv_g, self.conv_o):
                first_layer(gate).weight *= 0.5
            bias_of(first_layer(self.conv_i)).fill_(1)
            bias_of(first_layer(self.conv_o)).fill_(1)
            last = first_layer(self.det_conv_mask)
            last.weight *= 0.3
            bias_of(last).fill_(0.2)

    def unroll(self) -> None:
        """Prepares weights that were trained with one step for several, keeping what they compute.

        At one step the map is a constant 0.5 and the state zero. The constant is absorbed into the
        first layer's bias, the weights that read map and hidden state become zero, and the forget
        gate is nearly closed: every further step then repeats the first one (but for what the
        closed gate lets through), and training goes on from there instead of unlearning.
        """
        gates = (self.conv_i, self.conv_f, self.conv_g, self.conv_o)
        with torch.no_grad():
            first, forget = first_layer(self.det_conv0), first_layer(self.conv_f)
            bias_of(first).add_(0.5 * first.weight[:, 3].sum((1, 2)))
            first.weight[:, 3].zero_()
            for gate in gates:
                first_layer(gate).weight[:, FEATURES:].zero_()
            forget.weight.mul_(0.1)
            bias_of(forget).fill_(-3)

    def features(self, stacked: Tensor) -> Tensor:
        """Features (N,32,H,W) of photo and map, (N,4,H,W): five residual blocks."""
        x = self.det_conv0(stacked)
        for block in self.residual_blocks():
            x = F.relu(block(x) + x)
        return x

    def residual_blocks(self) -> tuple[nn.Sequential, ...]:
        """The five residual blocks, in their order."""
        return (
            self.det_conv1,
            self.det_conv2,
            self.det_conv3,
            self.det_conv4,
            self.det_conv5,
        )

    def recur(self, features: Tensor, state: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
        """The next (hidden, cell) state, each (N,32,H,W); state None means both are 0.

        At the first step the hidden half of the gates meets zeros and the forget gate
        multiplies zero, so neither is computed: the same result for half the work.
        """
        gates = [first_layer(gate) for gate in (self.conv_i, self.conv_g, self.conv_o)]
        if state is None:
            joint = torch.cat([gate.weight[:, :FEATURES] for gate in gates])
            bias = torch.cat([bias_of(gate) for gate in gates])
            i, g, o = F.conv2d(features, joint, bias, padding=1).chunk(3, 1)
            cell = torch.sigmoid(i) * torch.tanh(g)
        else:
            gates = [*gates, first_layer(self.conv_f)]
            joint = torch.cat([gate.weight for gate in gates])
            bias = torch.cat([bias_of(gate) for gate in gates])
            stacked = torch.cat([features, state[0]], 1)
            i, g, o, f = F.conv2d(stacked, joint, bias, padding=1).chunk(4, 1)
            cell = torch.sigmoid(f) * state[1] + torch.sigmoid(i) * torch.tanh(g)
        return torch.sigmoid(o) * torch.tanh(cell), cell


def first_layer(block: nn.Sequential) -> nn.Conv2d:
    """The convolution at the start of a block."""
    layer = block[0]
    if not isinstance(layer, nn.Conv2d):
        raise TypeError(f"a block starts with a convolution, not {type(layer).__name__}")
    return layer


def last_layer(block: nn.Sequential) -> nn.Conv2d:
    """The second convolution of a residual block."""
    layer = block[2]
    if not isinstance(layer, nn.Conv2d):
        raise TypeError(f"a residual block has a second convolution, not {type(layer).__name__}")
    return layer


def bias_of(layer: nn.Conv2d) -> Tensor:
    """The bias of a convolution, which all of this network's have."""
    if layer.bias is None:
        raise TypeError("this convolution has no bias")
    return layer.bias


def bgr_from_rgb(image: np.ndarray) -> Tensor:
    """The network's input (1,3,H,W), blue first, from an RGB image (H,W,3) in [0,1].

    The released weights were trained on OpenCV's channel order without mean subtraction; this
    is the only place where the order changes.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"expected an image (H,W,3), got {image.shape}")
    planes = np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1), dtype=np.float32)
    return torch.from_numpy(planes)[None]
