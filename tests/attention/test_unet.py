"""The small U-Net: sizes, reach, tiles, and what fusing keeps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from pipeline.attention.inference import attend
from pipeline.attention.unet import WIDTHS, DropUNet


@pytest.fixture
def network() -> DropUNet:
    """Drawn weights, and statistics of normalisation as training would leave them."""
    made = DropUNet()
    made.initialise(seed=2)
    generator = torch.Generator().manual_seed(3)
    for module in made.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            assert module.running_mean is not None and module.running_var is not None
            module.running_mean.normal_(0, 0.1, generator=generator)
            module.running_var.uniform_(0.3, 0.8, generator=generator)
            module.weight.data.uniform_(0.5, 1.5, generator=generator)
    made.last.weight.data.sub_(made.last.weight.data.mean()).mul_(5)
    return made.eval()


def _image(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height * 1000 + width).random((height, width, 3), np.float32)


def test_its_size(network: DropUNet) -> None:
    convolutions = sum(9 * (a * b + b * b) for a, b in pairwise((3, *WIDTHS)))
    upwards = [(b + a, a) for a, b in pairwise(WIDTHS)]
    convolutions += sum(9 * (a * b + b * b) for a, b in upwards) + WIDTHS[0] + 1
    norms = 4 * sum(WIDTHS) + 4 * sum(WIDTHS[:-1])
    assert sum(p.numel() for p in network.parameters()) == convolutions + norms == 495_169


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 2), (17, 33), (31, 1), (48, 64)])
def test_any_size_is_kept(network: DropUNet, height: int, width: int) -> None:
    found = attend(network, _image(height, width), scales=(0.5, 1.0))
    assert found.shape == (height, width) and found.dtype == np.float32
    assert found.min() >= 0 and found.max() <= 1


def test_fused_it_computes_the_same(network: DropUNet) -> None:
    bgr = torch.rand(1, 3, 40, 56, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        before = network(bgr)
        after = network.for_inference()(bgr)
    assert not any(isinstance(m, torch.nn.BatchNorm2d) for m in network.modules())
    assert before.std() > 0.1
    torch.testing.assert_close(before, after, atol=1e-4, rtol=1e-4)


def test_it_sees_no_further_than_it_says_and_nearly_as_far(network: DropUNet) -> None:
    reach = network.reach()
    assert reach % network.grid == 0
    bgr = torch.rand(1, 3, 16, 512, generator=torch.Generator().manual_seed(0)).requires_grad_()
    network(bgr)[0, 0, 8, 256].backward()
    assert bgr.grad is not None
    seen = bgr.grad[0].abs().sum((0, 1)).nonzero().flatten()
    assert seen.min() >= 256 - reach and seen.max() <= 256 + reach
    assert seen.max() - seen.min() > reach


@pytest.mark.parametrize("tile", [64, 100])
def test_tiles_give_the_map_of_the_whole(network: DropUNet, tile: int) -> None:
    image = _image(50, 451)
    whole, tiled = attend(network, image, tile=4096), attend(network, image, tile=tile)
    assert np.abs(whole - tiled).max() <= 3e-5
    assert whole.std() > 0.01


def test_the_same_bytes_every_time(network: DropUNet) -> None:
    image = _image(33, 147)
    first, second = (attend(network, image, tile=64) for _ in range(2))
    assert first.tobytes() == second.tobytes()
