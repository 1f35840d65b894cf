"""Crops cut on the device: the pixels that were asked for, from stacks of pictures of one size."""

from __future__ import annotations

import numpy as np
import torch

from pipeline.geometry.crops import cut, draw_crops, stacked


def _pictures(count: int, shape: tuple[int, int], seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 256, (*shape, 3), dtype=np.uint8) for _ in range(count)]


def test_whole_windows_are_the_pictures_own_pixels_mirrored_or_not() -> None:
    picture = torch.rand((2, 3, 20, 30))
    at = [torch.tensor(v) for v in ([3.0, 10.0], [5.0, 1.0], [8.0, 8.0], [0.0, 1.0])]
    found = cut(picture, *at, 8)
    assert torch.allclose(found[0], picture[0, :, 5:13, 3:11], atol=1e-5)
    assert torch.allclose(found[1], picture[1, :, 1:9, 10:18].flip(2), atol=1e-5)


def test_a_window_twice_as_wide_is_read_between_its_pixels() -> None:
    ramp = torch.arange(16.0).expand(1, 1, 16, 16)
    told = [torch.tensor([v]) for v in (4.0, 0.0, 8.0, 0.0)]
    assert torch.allclose(cut(ramp, *told, 4)[0, 0, 0], torch.tensor([4.5, 6.5, 8.5, 10.5]))


def test_stacks_by_size_share_by_number_and_hold_frames_one_after_another() -> None:
    wide, high = _pictures(3, (8, 12), 0), _pictures(1, (12, 8), 1)
    cover = [picture[..., 0] for picture in wide + high]
    stacks = stacked([wide + high, cover], 0.8, "cpu")
    assert [tuple(each.pixels.shape) for each in stacks] == [(3, 8, 12, 4), (1, 12, 8, 4)]
    assert np.allclose([each.share for each in stacks], [0.6, 0.2])
    assert np.array_equal(stacks[0].pixels[2, ..., :3], wide[2])
    assert np.array_equal(stacks[1].pixels[0, ..., 3], cover[3])
    clip = np.stack(_pictures(5, (8, 12), 2))
    frames = stacked([[clip], [cover[0]]], 1.0, "cpu")[0].pixels
    assert np.array_equal(frames[0, ..., 3:6], clip[1]) and frames.shape == (1, 8, 12, 16)


def test_crops_of_all_stacks_repeatable_and_from_the_wetter_place() -> None:
    cover = np.zeros((64, 64), np.uint8)
    cover[:, :32] = 255
    pictures = [np.full((64, 64, 3), 200, np.uint8)]
    stacks = stacked([pictures, [cover]], 1.0, "cpu") + stacked([pictures, [cover]], 1.0, "cpu")

    def drawn(second: float) -> torch.Tensor:
        rng = np.random.default_rng(3)
        return draw_crops(stacks, rng, 60, 16, zoom=(0.5, 2.0), second=second)

    crops = drawn(1.0)
    assert crops.shape == (60, 4, 16, 16) and torch.equal(crops, drawn(1.0))
    assert torch.allclose(crops[:, :3], torch.tensor(200 / 255))
    assert crops[:, 3].mean() > drawn(0.0)[:, 3].mean() + 0.1
