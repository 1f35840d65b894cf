"""Maps of any size, the same in tiles as in one piece."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from pipeline.attention import inference
from pipeline.attention.inference import attend, exact_products
from pipeline.attention.network import AttentiveRecurrentNet


@pytest.fixture
def network() -> AttentiveRecurrentNet:
    made = AttentiveRecurrentNet().eval()
    made.initialise(seed=5)
    return made


def _image(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height * 1000 + width).random((height, width, 3), np.float32)


@pytest.mark.parametrize("steps", [1, 2])
def test_tiles_give_the_map_of_the_whole(network: AttentiveRecurrentNet, steps: int) -> None:
    image = _image(90, 131)
    whole = attend(network, image, tile=4096, steps=steps)
    tiled = attend(network, image, tile=40, steps=steps)
    assert np.abs(whole - tiled).max() <= 5e-6
    assert whole.std() > 0.01


def test_four_steps_see_no_further_than_the_halo(network: AttentiveRecurrentNet) -> None:
    image = _image(64, 150)
    whole, tiled = (attend(network, image, tile=tile) for tile in (4096, 75))
    assert np.abs(whole - tiled).max() <= 5e-6


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 2), (17, 33), (31, 1)])
def test_any_size_is_kept(network: AttentiveRecurrentNet, height: int, width: int) -> None:
    found = attend(network, _image(height, width), scales=(0.5, 1.0), steps=2)
    assert found.shape == (height, width) and found.dtype == np.float32
    assert found.min() >= 0 and found.max() <= 1


def test_the_map_is_that_of_the_bgr_picture_clamped(network: AttentiveRecurrentNet) -> None:
    image = _image(24, 28)
    planes = torch.from_numpy(image[..., ::-1].transpose(2, 0, 1).copy())[None]
    with torch.no_grad():
        raw = network(planes, 4)[-1][0, 0].clamp(0, 1).numpy()
    assert np.allclose(attend(network, image), raw, atol=1e-6)
    assert not np.allclose(attend(network, image[..., ::-1]), raw, atol=1e-3)


def test_with_its_mirror_image_left_and_right_are_told_alike(
    network: AttentiveRecurrentNet,
) -> None:
    image = _image(40, 56)
    turned = np.ascontiguousarray(image[:, ::-1])
    one, other = (attend(network, each, steps=1) for each in (image, turned))
    assert not np.allclose(one, other[:, ::-1], atol=1e-3)
    both = [attend(network, each, steps=1, mirrored=True) for each in (image, turned)]
    assert np.array_equal(both[0], both[1][:, ::-1])
    assert np.allclose(both[0], (one + other[:, ::-1]) / 2, atol=1e-6)


def test_scales_are_averaged(network: AttentiveRecurrentNet) -> None:
    image = _image(32, 40)
    one, half = (attend(network, image, scales=(scale,), steps=1) for scale in (1.0, 0.5))
    both = attend(network, image, scales=(1.0, 0.5), steps=1)
    assert np.allclose(both, (one + half) / 2, atol=1e-6)


def test_the_same_bytes_every_time(network: AttentiveRecurrentNet) -> None:
    image = _image(33, 47)
    first, second = (attend(network, image, tile=20, steps=2) for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_a_gpu_computes_exactly_as_long_as_any_thread_makes_maps(
    network: AttentiveRecurrentNet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flags belong to the process: none is put back while another map is being made."""
    flags = ("benchmark", "deterministic", "allow_tf32")
    loose, exact = (True, False, True), (False, True, False)

    def set_now() -> tuple[bool, ...]:
        return tuple(getattr(torch.backends.cudnn, name) for name in flags)

    for name, value in zip(flags, loose, strict=True):
        monkeypatch.setattr(torch.backends.cudnn, name, value)
    attend(network, _image(8, 8), steps=1)
    assert set_now() == loose  # a processor knows none of them
    monkeypatch.setattr(inference, "exact_products", lambda _: exact_products(torch.device("cuda")))
    during = []
    whole = network.attention
    monkeypatch.setattr(
        network, "attention", lambda *given: (during.append(set_now()), whole(*given))[1]
    )
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda k: attend(network, _image(8 + k, 40), steps=1, tile=8), range(8)))
    assert set(during) == {exact} and set_now() == exact


def test_nonsense_is_refused(network: AttentiveRecurrentNet) -> None:
    with pytest.raises(ValueError):
        attend(network, _image(4, 4), scales=())
    with pytest.raises(ValueError):
        attend(network, np.zeros((4, 4), np.float32))
