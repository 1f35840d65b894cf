"""LPIPS with AlexNet features, version 0.1, in plain torch and without a download."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.errors import UserError
from pipeline.evaluation.image import as_batch
from pipeline.io.weights import fill, read_state

NET = "AlexNet, LPIPS v0.1"
# The convolutions of torchvision's AlexNet `features`, by their place in it:
# inputs, outputs, kernel, stride, padding; a 3x3 max pooling of stride 2 stands before some.
_LAYERS = {
    0: (3, 64, 11, 4, 2),
    3: (64, 192, 5, 1, 2),
    6: (192, 384, 3, 1, 1),
    8: (384, 256, 3, 1, 1),
    10: (256, 256, 3, 1, 1),
}
_POOLED_BEFORE = (3, 6)
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
SMALLEST_SIDE = 31  # below it the second pooling has nothing to pool


class AlexNet(nn.ModuleDict):
    """Its convolutions, by their place."""

    def __init__(self) -> None:
        super().__init__(
            {str(place): nn.Conv2d(i, o, k, s, p) for place, (i, o, k, s, p) in _LAYERS.items()}
        )


class Lpips(nn.Module):
    """Learned perceptual distance of two images (Zhang et al. 2018, arXiv:1801.03924).

    AlexNet features after each of its five ReLUs, normalised over channels; squared differences are
    weighted by the published linear heads, averaged over the image and summed over layers.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.features = AlexNet()
        self.heads = nn.ParameterList(
            [torch.zeros(1, layer[1], 1, 1) for layer in _LAYERS.values()]
        )
        self.register_buffer("shift", torch.tensor(_SHIFT)[None, :, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE)[None, :, None, None], persistent=False)

    def taps(self, images: Tensor) -> list[Tensor]:
        """Unit-length features of images (N, 3, H, W) in [-1, 1], layer by layer."""
        x, found = (images - self.shift) / self.scale, []
        for place in _LAYERS:
            if place in _POOLED_BEFORE:
                x = F.max_pool2d(x, 3, 2)
            x = F.relu(self.features[str(place)](x))
            found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return found

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Distances (N,) of images (N, 3, H, W) in [-1, 1]."""
        layers = zip(self.taps(a), self.taps(b), self.heads, strict=True)
        return sum(
            (((x - y).square() * head).sum(1).mean((1, 2)) for x, y, head in layers),
            start=torch.zeros(len(a)),
        )


def load_lpips(backbone: Path) -> Lpips:
    """The metric with the AlexNet weights of a file: the state dict that torchvision publishes.

    The linear heads come with the installed torchmetrics. UserError for a file that is missing,
    unsafe to read, or of another network.
    """
    hint = "Set evaluate.lpips_backbone to torchvision's alexnet-owt-*.pth, or to null."
    model = Lpips()
    fill(model.features, read_state(backbone, hint), str(backbone), "features.{}".format, hint)
    heads = read_state(_heads_file())
    for layer, head in enumerate(model.heads):
        head.data.copy_(heads[f"lin{layer}.model.1.weight"])
    return model.eval().requires_grad_(False)


def _heads_file() -> Path:
    # Found, not imported: importing that module asks for torchvision.
    package = importlib.util.find_spec("torchmetrics")
    if package is None or package.origin is None:
        raise UserError("torchmetrics is not installed.", "Run `make setup`.")
    return Path(package.origin).parent / "functional" / "image" / "lpips_models" / "alex.pth"


def lpips(model: Lpips, a: np.ndarray, b: np.ndarray) -> float:
    """LPIPS distance of two images (H, W, 3) in [0, 1]: 0 for identical ones, higher is worse.

    ValueError when shapes differ or a side is shorter than 31 pixels.
    """
    if a.shape != b.shape:
        raise ValueError(f"images of different shapes: {a.shape} and {b.shape}")
    if min(a.shape[:2]) < SMALLEST_SIDE:
        raise ValueError(f"LPIPS needs {SMALLEST_SIDE} pixels each way, got {a.shape}")
    with torch.no_grad():
        return float(model(as_batch(a) * 2 - 1, as_batch(b) * 2 - 1)[0])
