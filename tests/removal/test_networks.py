"""The networks are the published ones, and compute what their papers say."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from pipeline.removal import wen
from pipeline.removal.autoencoder import ContextualAutoencoder, Scales, multi_scale_loss
from pipeline.removal.quan import QuanNet, _Same, from_tensorflow, tensorflow_name
from pipeline.removal.shape_attention import KERNELS, oriented_edges, shape_attention, torque
from pipeline.removal.wen import WenNet, _PatchAttention

AUTOENCODER = {
    "conv1": (64, 4, 5, 5),
    "conv2": (128, 64, 3, 3),
    "conv3": (128, 128, 3, 3),
    "conv4": (256, 128, 3, 3),
    **{f"conv{k}": (256, 256, 3, 3) for k in (5, 6, 7, 8)},
    **{f"diconv{k}": (256, 256, 3, 3) for k in (1, 2, 3, 4)},
    "outframe1": (3, 256, 3, 3),
    "deconv1": (256, 128, 4, 4),
    "conv9": (128, 128, 3, 3),
    "outframe2": (3, 128, 3, 3),
    "deconv2": (128, 64, 4, 4),
    "conv10": (32, 64, 3, 3),
    "output": (3, 32, 3, 3),
}


def shapes(network: nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in network.state_dict().items()}


def test_autoencoder_is_the_published_one() -> None:
    found = shapes(ContextualAutoencoder())
    for name, shape in AUTOENCODER.items():
        assert found.pop(f"{name}.0.weight") == shape
        # A transposed product stores its inputs first.
        assert found.pop(f"{name}.0.bias") == (shape[1] if name.startswith("deconv") else shape[0],)
    assert not found
    count = sum(value.numel() for value in ContextualAutoencoder().parameters())
    assert count + 167_809 == 6_244_362  # with the attention part, the whole generator


def test_quan_is_the_published_one() -> None:
    found = {tensorflow_name(name): shape for name, shape in shapes(QuanNet()).items()}
    assert sum(value.numel() for value in QuanNet().parameters()) == 7_271_715
    assert found["g_net/att1_1/weights"] == (32, 1, 5, 5)
    assert found["g_net/enc1_1/weights"] == (32, 9, 5, 5)
    assert found["g_net/enc2_1/biases"] == (64,)
    assert found["g_net/dec1_4/weights"] == (64, 32, 4, 4)
    assert found["g_net/dec1_0/weights"] == (3, 32, 5, 5)
    for channels, level in ((32, 1), (64, 2), (128, 3)):
        for part in ("enc", "dec"):
            block = f"g_net/{part}{level}_2"
            assert found[f"{block}/conv1_1/weights"] == (channels, channels, 5, 5)
            assert found[f"{block}/ch_at/mlp_0/kernel"] == (channels // 2, channels)
            assert found[f"{block}/ch_at/mlp_1/bias"] == (channels,)


def test_wen_is_the_published_one() -> None:
    found = shapes(WenNet())
    assert sum(value.numel() for value in WenNet().parameters()) == 15_826_314
    assert found["main_branch.1.weight"] == (64, 3, 7, 7)
    assert found["main_branch.4.model.0.weight"] == (256, 128, 3, 3)
    assert found["res_branch_2.1.conv_block.5.bias"] == (256,)
    assert found["weight_branch.0.conv.weight"] == (256, 256, 1, 1)
    assert "weight_branch.0.conv.bias" not in found
    assert found["spatial_attention.0.attention.output_linear.0.weight"] == (256, 256, 3, 3)
    assert found["temporal_attention.3.feed_forward.conv.2.weight"] == (256, 256, 3, 3)
    assert found["upsample_block.1.model.1.weight"] == (64, 128, 3, 3)
    assert found["upsample_block.3.weight"] == (3, 64, 7, 7)
    assert found["mask_branch.2.conv.weight"] == (64, 128, 3, 3)
    assert found["mask_branch.3.weight"] == (1, 64, 3, 3)
    assert found["side_branch_2.0.weight"] == (3, 128, 3, 3)


def test_multi_scale_loss_of_a_constant_error() -> None:
    clean = torch.full((1, 3, 8, 8), 0.5)
    pictures = Scales(*(torch.full((1, 3, size, size), 0.5 + 0.1) for size in (2, 4, 8)))
    # An error of 0.1 everywhere: 0.01 * (0.6 + 0.8 + 1.0).
    assert float(multi_scale_loss(pictures, clean)) == pytest.approx(0.024, rel=1e-5)


def test_a_stride_of_two_pads_as_tensorflow_does() -> None:
    layer = _Same(1, 1, stride=2)
    with torch.no_grad():
        layer.weight.zero_()
        layer.weight[0, 0, 1, 1] = 1.0  # of a window that starts one pixel before the picture
        layer.bias.zero_()
    picture = torch.arange(36.0).view(1, 1, 6, 6)
    assert layer(picture)[0, 0].tolist() == picture[0, 0, ::2, ::2].tolist()


def test_tensorflow_arrays_find_their_places() -> None:
    network = QuanNet()
    arrays = {"global_step": torch.zeros(()), "g_net/enc1_1/weights/Adam": torch.zeros(5, 5, 9, 32)}
    for name, value in network.state_dict().items():
        stored = value.permute(2, 3, 1, 0) if value.ndim == 4 else value
        arrays[f"{tensorflow_name(name)}:0"] = stored.t() if stored.ndim == 2 else stored
    state = from_tensorflow(arrays)
    for name, value in network.state_dict().items():
        assert torch.equal(state[name], value), name


def disc(radius: float, inside: float, size: int = 64) -> torch.Tensor:
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
    values = np.where(np.hypot(rows, columns) < radius, inside, 0.5).astype(np.float32)
    return torch.from_numpy(np.repeat(values[None, None], 3, axis=1))


def test_shape_attention_peaks_in_the_middle_of_a_dark_disc() -> None:
    found = shape_attention(disc(10.0, 0.1), published=False)[0, 0]
    row, column = divmod(int(found.argmax()), 64)
    assert abs(row - 31.5) <= 2 and abs(column - 31.5) <= 2
    assert float(found[31, 31]) > 4 * float(found[2:8, 2:8].max())


def test_no_edges_no_attention_and_only_steps_above_ten_count() -> None:
    assert float(shape_attention(torch.full((1, 3, 48, 48), 0.4)).max()) == 0.0
    assert float(oriented_edges(disc(10.0, 0.5 - 9 / 255)).sum()) == 0.0
    assert float(oriented_edges(disc(10.0, 0.5 - 12 / 255)).sum()) > 0.0


def released(rgb: np.ndarray) -> np.ndarray:
    """The released definition for one picture (H,W,3), a pixel at a time: channels (8,H,W)."""
    red, green, blue = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    grey = np.float32(0.299) * red + np.float32(0.587) * green + np.float32(0.114) * blue
    grey = np.pad(grey, 1)  # black around it
    height, width = rgb.shape[:2]
    # Clockwise from above, axial and diagonal ones in turn.
    around = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
    steepest = np.full(
        (*grey.shape, 2), -1
    )  # of the axial ones: most and least; -1 around the picture
    inside = [(y, x) for y in range(1, height + 1) for x in range(1, width + 1)]
    for y, x in inside:
        falls = [grey[y, x] - grey[y + rows, x + columns] for rows, columns in around[::2]]
        steepest[y, x] = int(np.argmax(falls)), int(np.argmin(falls))
    found = np.zeros((8, height, width))
    for y, x in inside:
        for channel, (rows, columns) in enumerate(around):
            fall = grey[y, x] - grey[y + rows, x + columns]
            k, there = channel // 2, steepest[y + rows, x + columns, 1]
            opposite = {0: 2, 1: 3, 2: 4, 3: 1}[k]  # 4 does not exist: it should be 0
            if steepest[y, x, 0] == k and there == opposite and fall > 10 / 255:
                found[channel, y - 1, x - 1] = 1
    return found


@pytest.mark.parametrize("levels", [3, 9, 256])
def test_published_edges_are_those_of_the_released_code(levels: int) -> None:
    """Of few levels too, where several differences are the largest: the first of them counts."""
    rng = np.random.default_rng(levels)
    greys = [(rng.integers(0, levels, (12, 15, 1)) / (levels - 1)).repeat(3, 2) for _ in range(2)]
    smooth = cv2.GaussianBlur(rng.random((12, 15, 3)), (0, 0), 1.5)
    whole = np.zeros(8)
    for picture in (*greys, rng.random((12, 15, 3)), (smooth - smooth.min()) * 2):
        rgb = np.asarray(picture, np.float32)
        edges = oriented_edges(torch.from_numpy(rgb.transpose(2, 0, 1).copy())[None])[0].numpy()
        assert np.array_equal(edges, released(rgb))
        whole += edges.sum((1, 2))
    assert list(np.flatnonzero(whole == 0)) == [4, 5]


def test_published_edges_count_rows_the_other_way() -> None:
    """An edge points at its darker side, to the right as to the left; up and down as released."""
    dark_below = torch.full((1, 3, 8, 8), 0.2)
    dark_below[:, :, :4] = 0.7
    assert oriented_edges(dark_below, published=False)[0, 0, 3, 2:6].tolist() == [1, 1, 1, 1]
    assert float(oriented_edges(dark_below)[0, :, 2:6, 2:6].sum()) == 0  # channel 4, always empty
    dark_above = dark_below.flip(2)
    assert oriented_edges(dark_above, published=False)[0, 4, 4, 2:6].tolist() == [1, 1, 1, 1]
    assert oriented_edges(dark_above)[0, 0, 4, 2:6].tolist() == [1, 1, 1, 1]
    dark_right = dark_below.transpose(2, 3)
    for published in (True, False):
        edges = oriented_edges(dark_right, published=published)
        assert edges[0, 2, 2:6, 3].tolist() == [1, 1, 1, 1]


def test_mended_edges_fill_all_channels() -> None:
    mended = oriented_edges(disc(12.0, 0.0), published=False)[0]
    assert all(float(mended[k].sum()) > 0 for k in range(8))


def test_torque_of_one_edge_is_its_distance_over_the_fourth_power() -> None:
    edges = torch.zeros(1, 8, 81, 81)
    edges[0, 0, 30, 40] = 1.0  # points down, towards larger rows
    found = torque(edges)[0, 0]
    # Five pixels below it, within the smallest square: the arm of the lever over 20^4.
    size = KERNELS[0]
    middle = (size - 1) // 2  # the pixel that an even square is centred on
    assert float(found[35, 40]) == pytest.approx((5 + (size - 1) / 2 - middle) / size**4, rel=1e-5)
    assert float(found[25, 40]) == 0.0  # behind it, it turns the other way


def test_a_single_patch_attends_to_itself_alone() -> None:
    torch.manual_seed(0)
    layer = _PatchAttention((8, 4)).eval()
    x = torch.randn(1, 256, 8, 8)
    heads: list[torch.Tensor] = []
    layer.output_linear.register_forward_pre_hook(lambda _, inputs: heads.append(inputs[0]))
    with torch.inference_mode():
        layer(x, 1)
        value = layer.value_embedding(x)
        # The other head has four patches: written out.
        q, k, v = (
            part[0, 128:].view(128, 2, 4, 2, 4).permute(1, 3, 0, 2, 4).reshape(4, -1)
            for part in (layer.query_embedding(x), layer.key_embedding(x), value)
        )
        mixed = torch.softmax(q @ k.T / math.sqrt(128 * 16), -1) @ v
    expected = mixed.view(2, 2, 128, 4, 4).permute(2, 0, 3, 1, 4).reshape(128, 8, 8)
    assert torch.allclose(heads[0][0, :128], value[0, :128], atol=1e-5)
    assert torch.allclose(heads[0][0, 128:], expected, atol=1e-5)


@pytest.mark.parametrize("most", [1, 100, 1000])
def test_patches_that_ask_in_blocks_find_the_same(
    most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two groups of two frames, of 4 and 16 patches each; the last block is a shorter one."""
    torch.manual_seed(3)
    layer = _PatchAttention((8, 4)).eval()
    x = torch.randn(4, 256, 16, 16)
    held = []
    layer.softmax.register_forward_hook(lambda *call: held.append(call[2].numel()))
    with torch.inference_mode():
        whole, alone = layer(x, 2), layer(x, 2, x[::2])
        assert held == [2 * 8 * 8, 2 * 32 * 32, 2 * 4 * 8, 2 * 16 * 32]
        held.clear()
        monkeypatch.setattr(wen, "WEIGHED", most)
        assert torch.allclose(layer(x, 2), whole, atol=1e-6)
        assert torch.allclose(layer(x, 2, x[::2]), alone, atol=1e-6)
    assert max(held) <= max(most, 2 * 32)  # a single query's at least
    assert len(held) > 4


def test_frames_attend_to_each_other_only_in_the_temporal_blocks() -> None:
    torch.manual_seed(1)
    layer = _PatchAttention((4,)).eval()
    x = torch.randn(2, 256, 4, 4)
    with torch.inference_mode():
        apart = layer(x, 2)
        assert torch.allclose(apart[:1], layer(x[:1], 1), atol=1e-5)
        assert not torch.allclose(layer(x, 1)[:1], apart[:1], atol=1e-3)


def test_a_frame_asked_for_alone_comes_out_as_with_all_others() -> None:
    torch.manual_seed(2)
    network = WenNet().eval()
    frames = torch.rand(1, 3, 3, 32, 64) * 2 - 1
    with torch.inference_mode():
        whole = network(frames)
        seen = [network.features(frame) for frame in frames[0].split(1)]
        fused = network.fused(torch.cat([each.x for each in seen]), 1)
        for place, each in enumerate(seen):
            assert torch.allclose(each.clear, whole.clear[0, place], atol=1e-5)
            picture = network.picture(fused, place)[0]
            assert torch.allclose(picture, whole.full[0, place], atol=1e-5)
