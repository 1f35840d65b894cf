"""Crops made on the device: what the ones made beside it are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.attention import lures, pools, samples
from pipeline.attention.resident import (
    at_night,
    defocused,
    draw_resident,
    lure,
    photographed,
    visibility,
)
from pipeline.attention.samples import Pool
from pipeline.attention.training import Phase, Trainer
from pipeline.attention.unet import DropUNet
from pipeline.geometry.crops import resident
from tests.answers import answers


def _pool(size: int = 64) -> Pool:
    rng = np.random.default_rng(0)
    clean = [rng.integers(60, 180, (size, size, 3), dtype=np.uint8) for _ in range(3)]
    cover = np.zeros((size, size), np.uint8)
    cover[20:40, 20:40] = 255
    wet = [np.where(cover[..., None] > 0, 255, each).astype(np.uint8) for each in clean]
    return Pool(wet, clean, [cover] * 3)


def _planes(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)


def _picture(planes: torch.Tensor) -> np.ndarray:
    return planes.permute(1, 2, 0).numpy()


def test_batches_are_bgr_in_range_and_repeatable() -> None:
    stacks = resident([_pool()], "cpu")
    first, second = (
        draw_resident(stacks, np.random.default_rng(4), 6, 32, 0.2, 0.5) for _ in range(2)
    )
    assert first[0].shape == (6, 3, 32, 32)
    assert first[1].shape == first[2].shape == (6, 1, 32, 32)
    assert all(t.min() >= 0 and t.max() <= 1 for t in first)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    red = [np.tile(np.array([255, 0, 0], np.uint8), (40, 40, 1))]
    stacks = resident([Pool(red, red, [np.zeros((40, 40), np.uint8)])], "cpu")
    images = draw_resident(stacks, np.random.default_rng(0), 20, 32, 0.0)[0]
    assert images[:, 2].mean() > 0.7 and images[:, 0].mean() < 0.2


def test_dry_crops_show_no_drop_and_only_they_are_made_to_look_wet() -> None:
    stacks = resident([_pool()], "cpu")

    def drawn(clean_share: float, share: float) -> list[torch.Tensor]:
        return list(draw_resident(stacks, np.random.default_rng(4), 8, 32, clean_share, share))

    _, cover, weight = drawn(1.0, 1.0)
    assert cover.max() == 0 and weight.min() == 1
    assert torch.equal(drawn(0.0, 1.0)[0], drawn(0.0, 0.0)[0])
    assert not torch.equal(drawn(1.0, 1.0)[0], drawn(1.0, 0.0)[0])


def test_lenses_and_weights_are_those_of_the_other_way() -> None:
    image = np.random.default_rng(0).random((40, 50, 3), dtype=np.float32)
    inner = slice(8, -8)  # borders are continued one pixel apart
    found = _picture(defocused(_planes(image), 4.3))
    assert np.allclose(found[inner, inner], lures.defocused(image, 4.3)[inner, inner], atol=1e-4)
    pool = _pool()
    parts = [np.float32(part[0]) / 255 for part in (pool.rainy, pool.clean, pool.coverage)]
    tensors = [torch.from_numpy(np.atleast_3d(part)).permute(2, 0, 1)[None] for part in parts]
    weight = visibility(*tensors)[0, 0].numpy()
    assert np.array_equal(weight[4:-4, 4:-4], samples.visibility(*parts)[4:-4, 4:-4])


def test_the_same_draws_out_of_focus_or_overexposed_make_the_same_picture() -> None:
    image = np.random.default_rng(0).random((60, 70, 3), dtype=np.float32)
    inner = (slice(13, -13), slice(13, -13))  # borders are continued one pixel apart
    for seed in range(30):
        found = lure(_planes(image), np.random.default_rng(seed))
        assert found.shape == (3, 60, 70) and 0 <= found.min() <= found.max() <= 1
        if (
            not 0.25 <= np.random.default_rng(seed).random() < 0.4
        ):  # lights are drawn in other orders
            beside = lures.lure(image, np.random.default_rng(seed))
            assert np.allclose(_picture(found)[inner], beside[inner], atol=1e-4), seed


@pytest.mark.parametrize("place", [0.25, 0.5, 0.75])
def test_lightsat_night_have_the_same_place_size_and_colour_but_for_their_rims(
    place: float,
) -> None:
    image = np.full((40, 60, 3), 0.8, np.float32)
    beside = lures.at_night(image, answers(place))
    found = _picture(at_night(_planes(image), answers(place)))
    y, x = np.mgrid[:40, :60]
    away, radius = np.hypot(y - 40 * place, x - 60 * place), 1 + int(3 * place)
    core, rim = away <= radius - 0.5, abs(away - radius) < 0.5
    assert np.allclose(found[~rim], beside[~rim], atol=1e-6)
    assert np.allclose(beside[core], beside[core][0]) and (beside[core] != beside[0, 0]).all()
    assert np.allclose(beside[away >= radius + 0.5], 0.8 * (0.15 + 0.35 * place))


@pytest.mark.parametrize(
    ("place", "changed"), [(0.05, True), (0.2, True), (0.4, True), (0.6, True), (0.9, False)]
)
def test_a_camera_set_otherwise_makes_the_same_of_a_picture(
    place: float, changed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The smaller `place`, the more is done: light and colour, then grain, a soft lens, swapped colours."""
    monkeypatch.setattr(torch, "randn", lambda shape, **_: torch.ones(shape))
    image = np.random.default_rng(0).random((40, 50, 3), dtype=np.float32)
    beside = samples.photographed(image, answers(place))
    found = photographed(_planes(image)[None], answers(place), torch.Generator())[0]
    inner = (slice(5, -5), slice(5, -5))
    assert np.allclose(_picture(found)[inner], beside[inner], atol=1e-4)
    assert bool((beside != image).any()) == changed


@pytest.mark.parametrize("target", ["coverage", "difference"])
def test_what_is_to_be_found_is_the_water_or_what_it_changes(target: str) -> None:
    clean = np.full((20, 20, 3), 100, np.uint8)
    cover = np.zeros((20, 20), np.uint8)
    cover[:, 4:16] = 128
    wet = clean.copy()
    wet[:, 4:10] += 60
    wet[:, 10:16] += 20
    wet[:, 18:] += 90  # no water: another thing that changed
    found = pools.aimed(([wet], [clean], [cover]), target)[2][0]
    if target == "coverage":
        assert np.array_equal(found, cover)
    else:
        assert (found[:, 5:9] == 255).all()
        assert not found[:, 11:].any() and not found[:, :3].any()


def test_training_on_the_device_learns_and_ends_alike_after_an_interruption() -> None:
    def fresh() -> Trainer:
        network = DropUNet()
        network.initialise(0)
        return Trainer(network, [_pool()], [Phase(1, 24, 4, 32, 0.02)], seed=1, clean_share=0.1,
                       lures=0.5, on_device=True)  # fmt: skip

    whole, trainer, losses = fresh(), fresh(), []
    while not whole.finished:
        losses.append(whole.advance())
        if not trainer.finished:
            trainer.advance()
        if trainer.done == 3:
            state, trainer = trainer.state(), fresh()
            trainer.restore(state)
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])
    for a, b in zip(whole.average.parameters(), trainer.average.parameters(), strict=True):
        assert torch.equal(a, b)
