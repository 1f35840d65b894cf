"""The network is the published one, and its weights come in safely."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.attention.network import AttentiveRecurrentNet, bgr_from_rgb
from pipeline.attention.unet import DropUNet
from pipeline.attention.weights import load_network, save_network
from pipeline.errors import UserError
from pipeline.io.tensors import save_tensors

SHAPES = {
    "det_conv0.0": (32, 4, 3, 3),
    **{f"det_conv{k}.{j}": (32, 32, 3, 3) for k in range(1, 6) for j in (0, 2)},
    **{f"conv_{gate}.0": (32, 64, 3, 3) for gate in "ifgo"},
    "det_conv_mask.0": (1, 32, 3, 3),
}


@pytest.fixture
def network() -> AttentiveRecurrentNet:
    made = AttentiveRecurrentNet().eval()
    made.initialise(seed=3)
    return made


def test_names_shapes_and_count_are_the_published_ones(network: AttentiveRecurrentNet) -> None:
    state = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    expected = {f"{name}.weight": shape for name, shape in SHAPES.items()}
    expected |= {f"{name}.bias": shape[:1] for name, shape in SHAPES.items()}
    assert state == expected
    assert sum(value.numel() for value in network.parameters()) == 167_809


def test_recurrence_equals_a_loop_written_out(network: AttentiveRecurrentNet) -> None:
    bgr = torch.rand(1, 3, 20, 24, generator=torch.Generator().manual_seed(0))
    conv = {
        name: (network.state_dict()[f"{name}.weight"], network.state_dict()[f"{name}.bias"])
        for name in SHAPES
    }

    def apply(name: str, x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(x, *conv[name], padding=1)

    attention = torch.full((1, 1, 20, 24), 0.5)
    hidden = cell = torch.zeros(1, 32, 20, 24)
    expected = []
    for _ in range(4):
        x = apply("det_conv0.0", torch.cat([bgr, attention], 1)).relu()
        for k in range(1, 6):
            inner = apply(f"det_conv{k}.0", x).relu()
            x = (apply(f"det_conv{k}.2", inner).relu() + x).relu()
        joint = torch.cat([x, hidden], 1)
        i, f, o = (apply(f"conv_{gate}.0", joint).sigmoid() for gate in "ifo")
        cell = f * cell + i * apply("conv_g.0", joint).tanh()
        hidden = o * cell.tanh()
        attention = apply("det_conv_mask.0", hidden)
        expected.append(attention)
    with torch.no_grad():
        found = network(bgr, 4)
    assert len(found) == 4
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)
    assert (found[3] - found[0]).abs().max() > 1e-3


def test_the_door_turns_rgb_into_bgr() -> None:
    red = np.zeros((2, 3, 3), np.float32)
    red[..., 0] = 1
    tensor = bgr_from_rgb(red)
    assert tensor.shape == (1, 3, 2, 3)
    assert tensor[0, 2].min() == 1 and tensor[0, :2].max() == 0


def test_unrolling_keeps_what_one_step_computed(network: AttentiveRecurrentNet) -> None:
    bgr = torch.rand(1, 3, 40, 40, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        before = network(bgr, 1)[-1]
        network.unroll()
        after = network(bgr, 4)
    inside = (..., slice(13, -13), slice(13, -13))
    torch.testing.assert_close(after[0][inside], before[inside], atol=1e-5, rtol=1e-4)
    spread = before.std()
    # What the nearly closed forget gate lets through is small beside the map's own variation.
    assert (after[3] - before)[inside].abs().max() < 0.25 * spread


def test_a_full_generator_fits_and_extra_tensors_are_ignored(
    network: AttentiveRecurrentNet, tmp_path: Path
) -> None:
    state = dict(network.state_dict())
    state["conv1.0.weight"] = torch.zeros(64, 4, 5, 5)
    path = tmp_path / "gen.pkl"
    torch.save(state, path, _use_new_zipfile_serialization=False)
    loaded = load_network(path)
    for name, value in loaded.state_dict().items():
        assert torch.equal(value, network.state_dict()[name])


def test_a_whole_generator_made_here_gives_its_attention_part(
    network: AttentiveRecurrentNet, tmp_path: Path
) -> None:
    """It says that it is for attgan, of which the attentive network is a part, and the U-Net is not."""
    state = {**network.state_dict(), "conv1.0.weight": torch.zeros(64, 4, 5, 5)}
    halves = {name: value.half() for name, value in state.items()}
    save_tensors(tmp_path / "attgan.safetensors", halves, {"model": "attgan"})
    loaded = load_network(tmp_path / "attgan.safetensors").state_dict()
    assert loaded.keys() == network.state_dict().keys()
    assert all(torch.equal(value, halves[name].float()) for name, value in loaded.items())
    with pytest.raises(UserError, match="is for the detector 'attgan', not for 'unet'"):
        load_network(tmp_path / "attgan.safetensors", "unet")


def test_missing_and_misshapen_tensors_are_named(
    network: AttentiveRecurrentNet, tmp_path: Path
) -> None:
    state = dict(network.state_dict())
    del state["conv_f.0.bias"]
    state["det_conv0.0.weight"] = torch.zeros(32, 3, 3, 3)
    state["det_conv_mask.0.bias"] = torch.tensor([float("nan")])
    torch.save(state, tmp_path / "w.pt")
    with pytest.raises(UserError) as caught:
        load_network(tmp_path / "w.pt")
    for part in ("conv_f.0.bias is missing", "det_conv0.0.weight is (32, 3, 3, 3)", "not finite"):
        assert part in caught.value.what


def test_safetensors_round_trip(network: AttentiveRecurrentNet, tmp_path: Path) -> None:
    save_tensors(tmp_path / "w.safetensors", network.state_dict())
    loaded = load_network(tmp_path / "w.safetensors")
    assert isinstance(loaded, AttentiveRecurrentNet)
    assert torch.equal(loaded.conv_g[0].weight, network.conv_g[0].weight)


def test_a_file_says_which_network_it_is_for(
    network: AttentiveRecurrentNet, tmp_path: Path
) -> None:
    unet = DropUNet().eval()
    unet.initialise(1)
    for name, made in (("attentive", network), ("unet", unet)):
        save_network(tmp_path / f"{name}.safetensors", made)
    back = load_network(tmp_path / "unet.safetensors", "unet")
    for name, value in back.state_dict().items():
        assert torch.equal(value, unet.state_dict()[name])
    for file, model in (("attentive", "unet"), ("unet", "attentive")):
        with pytest.raises(UserError, match=f"for the detector '{file}', not for '{model}'"):
            load_network(tmp_path / f"{file}.safetensors", model)
    # Files of before say nothing; the tensors do.
    save_tensors(tmp_path / "old.safetensors", network.state_dict())
    with pytest.raises(UserError, match=r"down\.0\.conv1\.weight is missing"):
        load_network(tmp_path / "old.safetensors", "unet")


class _Harmful:
    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, tuple[str, ...]]:
        return os.mkdir, (str(self.trace),)


@pytest.mark.parametrize("writer", ["pickle", "torch", "legacy torch"])
def test_a_pickle_that_runs_code_is_refused_unrun(tmp_path: Path, writer: str) -> None:
    path, trace = tmp_path / "gen.pkl", tmp_path / "was-run"
    content = {"det_conv0.0.weight": _Harmful(trace)}
    if writer == "pickle":
        path.write_bytes(pickle.dumps(content))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=writer == "torch")
    with pytest.raises(UserError, match="without running code"):
        load_network(path)
    assert not trace.exists()


@pytest.mark.parametrize("content", [b"", b"not weights at all", b"\x80\x02K\x05."])
def test_a_file_that_holds_no_weights_is_a_user_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "w.pt"
    path.write_bytes(content)
    with pytest.raises(UserError):
        load_network(path)


def test_missing_weights_are_a_user_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="do not exist") as error:
        load_network(tmp_path / "none.safetensors")
    assert "attention.weights" in error.value.hint
    with pytest.raises(UserError) as error:
        load_network(tmp_path / "none.safetensors", named_by="train_remover.attention")
    assert "Set train_remover.attention" in error.value.hint
