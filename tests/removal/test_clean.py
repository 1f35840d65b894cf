"""Photos of any size pass through the networks, and the stage refuses what it cannot use."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from pipeline.io.images import read_image, write_image
from pipeline.io.processor import multiplies_bfloat16
from pipeline.io.scene import ImageRecord, write_images_json
from pipeline.io.tensors import save_tensors
from pipeline.removal import starts
from pipeline.removal.autoencoder import ContextualAutoencoder
from pipeline.removal.clean import (
    clean_attgan,
    clean_quan,
    clean_wen,
    clean_wen_run,
    too_large,
    window_around,
    windows_of,
)
from pipeline.removal.precision import in_half, keep_exact, products
from pipeline.removal.quan import QuanNet
from pipeline.removal.record import edges_of
from pipeline.removal.wen import WenNet
from stages import restore


def photo(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3), np.float32)


def test_windows_stay_within_the_sequence() -> None:
    assert [window_around(k, 7) for k in (0, 1, 3, 6)] == [
        (range(0, 5), 0),
        (range(0, 5), 1),
        (range(1, 6), 2),
        (range(2, 7), 4),
    ]
    assert window_around(1, 3) == (range(0, 3), 1)


def test_attgan_sees_blue_first_and_sides_of_four() -> None:
    seen = []

    def attend(bgr: torch.Tensor) -> torch.Tensor:
        seen.append(bgr)
        return torch.zeros_like(bgr[:, :1])

    image = photo(30, 41)
    done = clean_attgan(ContextualAutoencoder().eval(), image, attend)
    assert done.shape == image.shape and done.dtype == np.float32
    assert done.min() >= 0.0 and done.max() <= 1.0
    assert tuple(seen[0].shape) == (1, 3, 32, 44)
    assert np.array_equal(seen[0][0, 0, :30, :41].numpy(), image[..., 2])


@pytest.mark.parametrize("size", [(33, 50), (5, 5)])
def test_quan_and_wen_keep_the_size(size: tuple[int, int]) -> None:
    image = photo(*size)
    assert clean_quan(QuanNet().eval(), image).shape == image.shape
    frames = [photo(*size, seed) for seed in range(3)]
    assert clean_wen(WenNet().eval(), frames, 1).shape == image.shape


def test_what_wens_map_calls_clear_stays_the_photo() -> None:
    """The map is one number here: the mean of photo and network at one half, the photo at one."""
    network, frames = WenNet().eval(), [photo(24, 32, seed) for seed in range(3)]
    last = network.mask_branch[3]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(0)
        plain = clean_wen(network, frames, 1)
        half = clean_wen(network, frames, 1, keep_clear=True)
        last.bias.fill_(50)
        clear = clean_wen(network, frames, 1, keep_clear=True)
    assert np.allclose(half, (plain + frames[1]) / 2, atol=1e-5)
    assert np.allclose(clear, frames[1], atol=1e-5)
    assert np.array_equal(clean_wen(network, frames, 1), plain)


def test_a_sequence_is_the_same_bytes_however_it_is_cut() -> None:
    """Each frame's features are computed once in a run, and the pictures do not show in which."""
    torch.manual_seed(0)
    network = WenNet().eval()
    frames = [photo(24, 32, seed) for seed in range(7)]
    read: list[int] = []

    def reader(index: int) -> np.ndarray:
        read.append(index)
        return frames[index]

    def restored(*runs: range) -> list[np.ndarray]:
        windows = [windows_of(range(7), run) for run in runs]
        return [each for run in windows for each in clean_wen_run(network, run, reader)]

    whole = restored(range(7))
    assert read == list(range(7))
    for runs in ([range(3), range(3, 7)], [range(k, k + 1) for k in range(7)]):
        assert all(map(np.array_equal, restored(*runs), whole))
    alone = clean_wen(network, frames[1:6], 2)
    assert np.array_equal(alone, whole[3])


@pytest.mark.parametrize("method", ["attgan", "quan", "wen"])
def test_bfloat16_stays_within_a_level_of_float32(method: str) -> None:
    """With starting weights, which carry the photo through, and noise on all of them."""
    network: Any = {"attgan": ContextualAutoencoder, "quan": QuanNet, "wen": WenNet}[method]()
    getattr(starts, f"start_{method}")(network, 0)
    torch.manual_seed(0)
    with torch.no_grad():
        for weights in network.parameters():
            weights += 1e-3 * torch.randn_like(weights)
    network.eval()
    keep_exact(network, method)
    image = cv2.GaussianBlur(photo(48, 64), (0, 0), 2)

    def restored(half: bool) -> np.ndarray:
        if method == "attgan":
            return clean_attgan(network, image, lambda bgr: bgr[:, :1], half=half)
        if method == "quan":
            return clean_quan(network, image, half=half)
        return clean_wen(network, [image, image[::-1], image], 1, half=half)

    exact, half = restored(False), restored(True)
    assert exact.std() > 0.01
    assert 0 < np.abs(half - exact).max() < 1 / 255


def test_layers_that_would_show_and_each_softmax_compute_in_float32() -> None:
    network = WenNet().eval()
    keep_exact(network, "wen")
    kinds = {}
    for name, layer in network.named_modules():
        layer.register_forward_hook(lambda *call, name=name: kinds.update({name: call[2].dtype}))
    with torch.inference_mode(), products(torch.device("cpu"), True):
        seen = network.features(torch.rand(1, 3, 32, 32))
        network.picture(network.fused(seen.x, 1), 0)
    found = {name for name, kind in kinds.items() if kind == torch.float32}
    assert {"main_branch", "upsample_block.3", "temporal_attention.3.attention.softmax"} <= found
    assert kinds["temporal_attention.3.feed_forward.conv.0"] == torch.bfloat16


def test_a_precision_that_is_asked_for_is_taken_and_auto_is_for_processors() -> None:
    assert in_half("bfloat16", "cpu") and not in_half("float32", "cpu")
    assert in_half("auto", "cpu") == multiplies_bfloat16()
    assert not in_half("auto", "cuda")


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    images = tmp_path / "artifacts/glass/images"
    images.mkdir(parents=True)
    records = []
    for name in ("a.png", "b.png"):
        write_image(images / name, photo(24, 32))
        records.append(ImageRecord(name, name, "0" * 64, 32, 24, None, "train", 0))
    write_images_json(images, records)
    monkeypatch.setattr(
        sys, "argv", ["restore", "--scene", "glass", "--params", str(tmp_path / "p")]
    )
    return tmp_path


def run_stage(
    root: Path, weights: str, method: str = "attgan", precision: str = "auto", edges: str = "true"
) -> int:
    (root / "p").write_text(
        f"scenes: {{glass: {{}}}}\n"
        f'restore: {{method: {method}, weights: "{weights}", published_edges: {edges}, '
        f"keep_clear: true, precision: {precision}}}\n"
    )
    with pytest.raises(SystemExit) as stop:
        restore.run("restore", restore.Params, restore.main)
    code = stop.value.code
    assert isinstance(code, int)
    return code


def test_every_photo_is_restored(scene: Path) -> None:
    torch.manual_seed(0)
    whole = {**ContextualAutoencoder().state_dict(), **restore.AttentiveRecurrentNet().state_dict()}
    save_tensors(scene / "gen.safetensors", whole)
    torch.save({"state_dict": whole}, scene / "gen.pkl")
    assert run_stage(scene, "gen.safetensors") == 0
    out = scene / "artifacts/glass/restored"
    assert sorted(path.name for path in out.iterdir()) == [
        "a.png", "b.png", "images.json", "restored.json",
    ]  # fmt: skip
    first = read_image(out / "a.png")
    assert first.shape == (24, 32, 3)
    assert run_stage(scene, "gen.pkl") == 0
    assert np.array_equal(read_image(out / "a.png"), first)
    save_tensors(scene / "weights/removers/attgan.safetensors", whole)
    assert run_stage(scene, "") == 0  # where no weights are named: our own
    assert np.array_equal(read_image(out / "a.png"), first)


def test_weights_that_say_their_edges_are_not_used_with_others(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Files that say nothing pass: the published ones, and those of before."""
    state = QuanNet().state_dict()
    save_tensors(scene / "silent.safetensors", state, {"model": "quan"})
    save_tensors(scene / "meant.safetensors", state, {"model": "quan", "published_edges": "false"})
    torch.save(state, scene / "silent.pt")
    for weights in ("silent.safetensors", "silent.pt", "meant.safetensors"):
        assert run_stage(scene, weights, "quan", edges="false") == 0
    assert run_stage(scene, "silent.safetensors", "quan", edges="true") == 0
    capsys.readouterr()
    assert run_stage(scene, "meant.safetensors", "quan", edges="true") == 2
    told = capsys.readouterr().err
    assert "meant.safetensors was trained with published_edges: false, and" in told
    assert "Set restore.published_edges to false" in told
    assert edges_of(scene / "meant.safetensors") is False
    assert edges_of(scene / "silent.safetensors") is edges_of(scene / "silent.pt") is None


def test_wen_restores_runs_and_names_the_photo_that_fails(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(0)
    save_tensors(scene / "wen.safetensors", WenNet().state_dict())
    out = scene / "artifacts/glass/restored"
    found = []
    for workers in (1, 2):
        monkeypatch.setattr(restore, "cores", lambda workers=workers: workers)
        assert run_stage(scene, "wen.safetensors", "wen", "float32") == 0
        found.append([(out / name).read_bytes() for name in ("a.png", "b.png")])
        assert json.loads((out / "restored.json").read_text())["bfloat16"] is False
    assert found[0] == found[1]
    assert run_stage(scene, "wen.safetensors", "wen", "bfloat16") == 0
    assert json.loads((out / "restored.json").read_text())["bfloat16"] is True
    monkeypatch.setattr(restore, "cores", lambda: 1)
    (scene / "artifacts/glass/images/b.png").write_text("no photo")
    assert run_stage(scene, "wen.safetensors", "wen") == 2
    assert "b.png is not a readable image" in capsys.readouterr().err


@pytest.mark.parametrize(
    "fault", [lambda: torch.empty(2**60), lambda: np.empty(2**50), torch.OutOfMemoryError]
)
def test_photos_too_large_for_the_memory_are_told_in_a_sentence(
    scene: Path,
    fault: Callable[[], Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def cleaned(*_: Any, **__: Any) -> np.ndarray:
        made = fault()
        raise made if isinstance(made, Exception) else AssertionError

    save_tensors(scene / "quan.safetensors", QuanNet().state_dict())
    monkeypatch.setattr(restore, "clean_quan", cleaned)
    assert run_stage(scene, "quan.safetensors", "quan") == 2
    told = capsys.readouterr().err
    assert ".png is too large to be restored" in told and "ingest.max_size" in told


def test_other_faults_stay_faults_of_the_program() -> None:
    assert too_large(RuntimeError("shapes do not match"), "a.png") is None


@pytest.mark.parametrize(
    ("weights", "told"),
    [
        ("", "train_remover --scene glass --method attgan"),
        ("none.pkl", "do not exist"),
        ("bad.pkl", "is not a PyTorch"),
    ],
)
def test_weights_that_cannot_be_used_are_told_in_a_sentence(
    scene: Path, weights: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (scene / "bad.pkl").write_bytes(b"text")
    assert run_stage(scene, weights) == 2
    assert told in capsys.readouterr().err
    assert not (scene / "artifacts/glass/restored").exists()


def test_weights_of_another_network_name_what_is_missing(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_tensors(scene / "other.safetensors", QuanNet().state_dict())
    assert run_stage(scene, "other.safetensors") == 2
    assert "det_conv0.0.weight is missing" in capsys.readouterr().err
