"""The attention part of the published generator (Qian et al., CVPR 2018), layer by layer."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.errors import UserError
from pipeline.io.tensors import load_tensors

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


def network_from_state(state: Mapping[str, object], origin: str) -> AttentiveRecurrentNet:
    """The network with the given weights, in evaluation mode on the CPU.

    state: a state dict of this network or of the whole official generator (what belongs to its
    autoencoder is ignored). origin: where it came from, for the error.
    Raises UserError naming every tensor that is missing, of another shape, or not finite.
    """
    network = AttentiveRecurrentNet()
    wanted = network.state_dict()
    problems, taken = [], {}
    for name, own in wanted.items():
        given = state.get(name, state.get(f"module.{name}"))
        if not isinstance(given, Tensor | np.ndarray):
            problems.append(f"{name} is missing")
            continue
        tensor = torch.as_tensor(given).to(torch.float32)
        if tensor.shape != own.shape:
            problems.append(f"{name} is {tuple(tensor.shape)}, not {tuple(own.shape)}")
        elif not bool(torch.isfinite(tensor).all()):
            problems.append(f"{name} holds numbers that are not finite")
        taken[name] = tensor
    if problems:
        raise UserError(
            f"{origin} does not hold the weights of the drop detector: {'; '.join(problems)}.",
            hint="Give weights of the attentive-recurrent network (Qian et al., CVPR 2018).",
        )
    network.load_state_dict(taken)
    return network.eval()


def load_network(path: Path) -> AttentiveRecurrentNet:
    """The network with the weights of a file: safetensors, or a PyTorch state dict.

    A PyTorch file is a pickle, so it is read with torch's restricted unpickler, which builds
    tensors and containers and runs nothing; whatever needs more is refused.
    Raises UserError for a missing, unreadable, unsafe or unfitting file.
    """
    if not path.is_file():
        raise UserError(
            f"The detector's weights {path} do not exist.",
            hint="Set attention.weights in params.yaml, or restore the file from the repository.",
        )
    if path.suffix == ".safetensors":
        return network_from_state(load_tensors(path)[0], str(path))
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, ValueError, EOFError, KeyError, OSError) as error:
        raise UserError(
            f"{path} is not a PyTorch file that can be read without running code from it"
            f" ({_first_line(error)}).",
            hint="Where you trust it, convert it with safetensors.torch.save_file.",
        ) from error
    for wrapper in ("state_dict", "model"):
        if isinstance(state, Mapping) and isinstance(state.get(wrapper), Mapping):
            state = state[wrapper]
    if not isinstance(state, Mapping):
        raise UserError(
            f"{path} holds a {type(state).__name__}, not a state dict.",
            hint="Save network.state_dict(), not the network.",
        )
    return network_from_state(state, str(path))


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
