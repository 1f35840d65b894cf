from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from pipeline.errors import UserError
from pipeline.evaluation.lpips import Lpips, load_lpips, lpips


@pytest.fixture(scope="module")
def backbone(tmp_path_factory):
    """A file with the names and shapes of torchvision's AlexNet, weights drawn at random."""
    generator = torch.Generator().manual_seed(0)
    shapes = {
        0: (64, 3, 11),
        3: (192, 64, 5),
        6: (384, 192, 3),
        8: (256, 384, 3),
        10: (256, 256, 3),
    }
    state = {"classifier.1.weight": torch.zeros(2, 2)}
    for place, (outputs, inputs, kernel) in shapes.items():
        weight = torch.randn(outputs, inputs, kernel, kernel, generator=generator)
        state[f"features.{place}.weight"] = weight / (inputs * kernel * kernel) ** 0.5
        state[f"features.{place}.bias"] = torch.randn(outputs, generator=generator) * 0.1
    path = tmp_path_factory.mktemp("weights") / "alexnet.pth"
    torch.save(state, path)
    return path


def images():
    random = np.random.default_rng(1)
    a = random.uniform(size=(70, 90, 3)).astype(np.float32)
    return a, np.clip(a + random.normal(0, 0.1, a.shape), 0, 1).astype(np.float32)


def by_the_book(path, a, b) -> float:
    """The definition, with torch's own layers in torchvision's order and the published heads."""
    import importlib.util
    from pathlib import Path

    state = torch.load(path, weights_only=True)
    origin = importlib.util.find_spec("torchmetrics").origin
    heads = Path(origin).parent / "functional/image/lpips_models/alex.pth"
    lin = torch.load(heads, map_location="cpu", weights_only=True)
    net = nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip
    net.load_state_dict({k[9:]: v for k, v in state.items() if k.startswith("features.")})
    total, x, y = 0.0, *(torch.from_numpy(i).permute(2, 0, 1)[None] for i in (a, b))
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, y = (((2 * i - 1) - shift.view(3, 1, 1)) / scale.view(3, 1, 1) for i in (x, y))
    layer = 0
    with torch.no_grad():
        for module in net:
            x, y = module(x), module(y)
            if isinstance(module, nn.ReLU):
                unit = [
                    i / (torch.linalg.vector_norm(i, dim=1, keepdim=True) + 1e-10) for i in (x, y)
                ]
                weight = lin[f"lin{layer}.model.1.weight"]
                total += float(nn.functional.conv2d((unit[0] - unit[1]) ** 2, weight).mean())
                layer += 1
    return total


def test_agrees_with_the_definition(backbone):
    a, b = images()
    model = load_lpips(backbone)
    assert lpips(model, a, b) == pytest.approx(by_the_book(backbone, a, b), rel=1e-4)
    assert lpips(model, a, b) > 0
    assert lpips(model, a, a) == 0


def test_the_published_heads_are_read(backbone):
    model = load_lpips(backbone)
    assert [head.shape[1] for head in model.heads] == [64, 192, 384, 256, 256]
    assert all(head.min() >= 0 and head.max() > 0 for head in model.heads)


@pytest.mark.parametrize("content", [None, b"no weights", {"features.0.weight": torch.zeros(1)}])
def test_a_wrong_backbone_is_told(tmp_path, content):
    path = tmp_path / "weights.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(UserError, match=r"weights\.pth") as error:
        load_lpips(path)
    assert "evaluate.lpips_backbone" in error.value.hint


def test_small_and_unequal_images_are_refused():
    small = np.zeros((30, 40, 3), np.float32)
    with pytest.raises(ValueError, match="31 pixels"):
        lpips(Lpips(), small, small)
    with pytest.raises(ValueError, match="different shapes"):
        lpips(Lpips(), small, small[1:])
