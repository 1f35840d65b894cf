"""Losses, optimiser and a short fit; the shipped weights find a drop."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipeline.attention import training
from pipeline.attention.inference import attend
from pipeline.attention.muon import orthogonalised
from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.attention.pools import read_photo_pairs, read_rendered
from pipeline.attention.samples import Pool, coverage_of_pair, draw_batch, visibility, wetness
from pipeline.attention.training import (
    THRESHOLDS,
    Phase,
    Trainer,
    attention_loss,
    count,
    fit,
    overlap_loss,
    phases_of,
    score,
    scores,
)
from pipeline.attention.unet import DropUNet
from pipeline.attention.weights import load_network
from pipeline.drops.stills import LONGEST
from pipeline.errors import UserError
from pipeline.io.images import write_image
from pipeline.io.tensors import load_tensors

WEIGHTS = Path(__file__).parents[2] / "weights"
SHIPPED = {"detector": "attentive", "unet": "unet", "unet-difference": "unet"}


def _pool(count: int = 6, size: int = 64) -> Pool:
    """Dark discs on bright squares: a caricature of drops that is learnt in seconds."""
    rng = np.random.default_rng(11)
    rainy, clean, coverage = [], [], []
    for _ in range(count):
        coarse = rng.uniform(0.5, 1.0, (8, 8, 3)).astype(np.float32)
        picture = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_NEAREST)
        alpha = np.zeros((size, size), np.float32)
        for _ in range(4):
            place = tuple(int(v) for v in rng.integers(0, size, 2))
            cv2.circle(alpha, place, int(rng.integers(5, 11)), 1.0, -1)
        alpha = cv2.GaussianBlur(alpha, (0, 0), 1.0)
        inside = 0.1 * picture[::-1]
        wet = picture * (1 - alpha[..., None]) + inside * alpha[..., None]
        for kept, values in ((rainy, wet), (clean, picture), (coverage, alpha)):
            kept.append(np.rint(values * 255).astype(np.uint8))
    return Pool(rainy, clean, coverage)


def test_attention_loss_by_hand() -> None:
    target = torch.zeros(1, 1, 2, 2)
    maps = [torch.full_like(target, value) for value in (1.0, 2.0, 3.0, 4.0)]
    # 0.8^3 * 1 + 0.8^2 * 4 + 0.8 * 9 + 16
    assert attention_loss(maps, target).item() == pytest.approx(0.512 + 2.56 + 7.2 + 16)
    assert attention_loss(maps[:1], target).item() == pytest.approx(1.0)


def test_wetness_is_the_root_of_coverage() -> None:
    coverage = torch.tensor([0.0, 0.04, 0.25, 1.0])
    assert torch.allclose(wetness(coverage), torch.tensor([0.0, 0.2, 0.5, 1.0]))


def test_overlap_loss_by_hand_and_best_at_the_target() -> None:
    target = torch.tensor([[[[1.0, 0.0]]]])
    weight = torch.tensor([[[[1.0, 0.5]]]])
    # Map 0.5 everywhere: entropy ln 2 times the mean weight; Dice (2*0.5 + 1) / (1.25 + 0.125 + 1).
    found = overlap_loss(torch.zeros(1, 1, 1, 2), target, weight)
    assert found.item() == pytest.approx(0.75 * np.log(2) + 1 - 2 / 2.375, abs=1e-6)
    soft = torch.tensor([[[[0.3, 0.8]]]])
    losses = [overlap_loss(torch.logit(soft + d), soft, weight).item() for d in (-0.1, 0, 0.1)]
    assert losses[1] < min(losses[0], losses[2])


def test_water_that_changes_nothing_weighs_little() -> None:
    clean = np.full((24, 24, 3), 0.5, np.float32)
    rainy, coverage = clean.copy(), np.zeros((24, 24), np.float32)
    coverage[:, :12] = 0.5
    rainy[:8, :12] += 0.2
    weight = visibility(rainy, clean, coverage)
    assert (weight[:7, :11] == 1).all() and (weight[:, 12:] == 1).all()
    assert np.allclose(weight[12:, :12], 0.1)


def test_coverage_of_a_photo_pair_is_where_it_differs() -> None:
    clean = np.full((20, 20, 3), 100, np.uint8)
    rainy = clean.copy()
    rainy[5:12, 5:12, 1] += 60
    rainy[15, 15] += 25  # noise
    found = coverage_of_pair(rainy, clean)
    assert found[6:11, 6:11].min() == 255 and found[:, 14:].max() == 0 and found[:4].max() == 0
    with pytest.raises(ValueError):
        coverage_of_pair(rainy, clean[:10])


def test_muon_makes_singular_values_alike() -> None:
    matrix = torch.randn(16, 40, generator=torch.Generator().manual_seed(0))
    before, after = (torch.linalg.svdvals(m) for m in (matrix, orthogonalised(matrix)))
    assert before.max() / before.min() > 3
    assert after.min() > 0.6 and after.max() < 1.3
    assert torch.allclose(orthogonalised(matrix.T), orthogonalised(matrix).T, atol=1e-5)


def test_batches_are_bgr_in_range_and_repeatable() -> None:
    pool = _pool()
    first, second = (
        draw_batch([pool], np.random.default_rng(4), 5, 32, clean_share=0.2) for _ in range(2)
    )
    assert first[0].shape == (5, 3, 32, 32)
    assert first[1].shape == first[2].shape == (5, 1, 32, 32)
    assert all(t.min() >= 0 and t.max() <= 1 for t in first)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    dry, cover, _ = draw_batch([pool], np.random.default_rng(4), 5, 32, clean_share=1.0)
    assert cover.max() == 0 and dry.std() > 0.05


def _train(
    make: type[AttentiveRecurrentNet] | type[DropUNet],
    iterations: list[int],
    resume_at: int | None = None,
) -> tuple[list[float], Trainer]:
    def fresh() -> Trainer:
        network = make()
        network.initialise(0)
        attentive = make is AttentiveRecurrentNet
        phases = [
            Phase(k + 1 if attentive else 1, n, 4, 32, 0.02) for k, n in enumerate(iterations)
        ]
        return Trainer(network, [_pool()], phases, seed=1, clean_share=0.1)

    trainer, losses = fresh(), []
    while not trainer.finished:
        losses.append(trainer.advance())
        if trainer.done == resume_at:
            state, trainer = trainer.state(), fresh()
            trainer.restore(state)
    return losses, trainer


@pytest.mark.parametrize("make", [AttentiveRecurrentNet, DropUNet])
def test_some_steps_learn(make: type[AttentiveRecurrentNet] | type[DropUNet]) -> None:
    losses, trainer = _train(make, [25])
    assert len(losses) == 25
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])
    before = make().eval()
    before.initialise(0)
    pool = _pool()
    assert score(trainer.average, pool, 1).f1 > score(before, pool, 1).f1 + 0.05


@pytest.mark.parametrize("make", [AttentiveRecurrentNet, DropUNet])
def test_an_interrupted_fit_ends_like_one_that_was_not(
    make: type[AttentiveRecurrentNet] | type[DropUNet],
) -> None:
    (whole, one), (parts, two) = _train(make, [4, 3]), _train(make, [4, 3], resume_at=3)
    assert whole == parts
    for a, b in zip(
        one.average.state_dict().values(), two.average.state_dict().values(), strict=True
    ):
        assert torch.equal(a, b)


def test_a_fit_that_broke_down_ends_with_a_sentence() -> None:
    network = DropUNet()
    network.initialise(0)
    with torch.no_grad():
        network.last.weight.fill_(float("nan"))
    trainer = Trainer(network, [_pool()], [Phase(1, 2, 2, 32, 0.02)], seed=1, clean_share=0.1)
    with pytest.raises(UserError, match="broke down near step 1"):
        fit(trainer, 5, {}, lambda *_: None)


def _two_steps(bfloat16: bool) -> tuple[list[float], Trainer]:
    network = DropUNet()
    network.initialise(0)
    phases = [Phase(1, 2, 2, 32, 0.02)]
    trainer = Trainer(network, [_pool()], phases, seed=1, clean_share=0.1, bfloat16=bfloat16)
    return [trainer.advance(), trainer.advance()], trainer


def test_half_precision_trains_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "multiplies_bfloat16", lambda device: True)
    losses, trainer = _two_steps(bfloat16=True)
    assert np.isfinite(losses).all() and losses != _two_steps(bfloat16=False)[0]
    assert all(p.dtype == torch.float32 for p in trainer.average.parameters())


def test_a_processor_without_half_precision_trains_in_float32(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(training, "multiplies_bfloat16", lambda device: False)
    assert _two_steps(bfloat16=True)[0] == _two_steps(bfloat16=False)[0]


def test_score_of_a_network_that_marks_everything() -> None:
    network = AttentiveRecurrentNet().eval()
    with torch.no_grad():
        network.det_conv_mask[0].weight.zero_()
        network.det_conv_mask[0].bias.fill_(0.9)
    pool = _pool(2)
    wet = np.mean([cover / 255 > 0.05 for cover in pool.coverage])
    result = score(network, pool, 1)
    assert result.recall == 1 and result.precision == pytest.approx(wet, abs=1e-6)
    assert result.f1 == pytest.approx(2 * wet / (1 + wet), abs=1e-6)
    assert result.iou == pytest.approx(wet, abs=1e-6)


def test_scores_at_each_threshold_by_hand() -> None:
    found = np.array([[0.9, 0.4], [0.4, 0.0]])
    wet = np.array([[True, True], [False, False]])
    low, high = (scores(count(found, wet))[list(THRESHOLDS).index(t)] for t in (0.3, 0.5))
    assert (low.precision, low.recall) == (pytest.approx(2 / 3), 1)
    assert (low.f1, low.iou) == (pytest.approx(0.8), pytest.approx(2 / 3))
    assert (high.precision, high.recall, high.iou) == (1, 0.5, 0.5)


def test_a_single_pixel_is_nothing_to_normalise_over() -> None:
    """At a sixteenth one crop of 16 pixels is one; two crops, or 17 pixels, are more."""

    def told(batch: int, crop: int) -> list[dict[str, float]]:
        return [{"steps": 1, "iterations": 1, "batch": batch, "crop": crop, "rate": 0.01}]

    with pytest.raises(UserError, match="batches of one crop of 16 pixels"):
        phases_of(DropUNet(), told(1, 16))
    for batch, crop in ((2, 16), (1, 17)):
        network = DropUNet()
        network.initialise(0)
        phases = phases_of(network, told(batch, crop))
        trainer = Trainer(network, [_pool(2)], phases, seed=0, clean_share=0.0)
        assert np.isfinite(trainer.advance())
    assert phases_of(AttentiveRecurrentNet(), told(1, 16)) == [Phase(1, 1, 1, 16, 0.01)]


def test_folders_of_pairs(tmp_path: Path) -> None:
    pool = _pool(2, 32)
    for k, (wet, dry, cover) in enumerate(zip(pool.rainy, pool.clean, pool.coverage, strict=True)):
        write_image(tmp_path / "data" / f"{k}_rain.png", wet)
        write_image(tmp_path / "gt" / f"{k}_clean.png", dry)
        for kind, picture in (("rainy", wet), ("clean", dry)):
            write_image(tmp_path / kind / f"{k}.png", picture)
        write_image(tmp_path / "coverage" / f"{k}.png", np.repeat(cover[..., None], 3, axis=2))
    rendered = read_rendered(tmp_path)
    assert all(np.array_equal(a, b) for a, b in zip(rendered[2], pool.coverage, strict=True))
    assert np.array_equal(rendered[0][1], pool.rainy[1])
    photos = read_photo_pairs(tmp_path)
    assert np.array_equal(photos[1][0], pool.clean[0]) and photos[2][0].max() == 255
    (tmp_path / "gt" / "1_clean.png").unlink()
    with pytest.raises(UserError, match="1_clean"):
        read_photo_pairs(tmp_path)
    with pytest.raises(UserError, match="no images"):
        read_rendered(tmp_path / "empty")


def test_large_pairs_are_held_as_small_as_the_photos_that_are_painted_on(tmp_path: Path) -> None:
    """Both partners are shrunk, then compared: one bright pixel of many is no water any more."""
    dry = np.full((60, 2400, 3), 100, np.uint8)
    wet = dry.copy()
    wet[20:40, 400:800] += 60  # even after shrinking
    wet[10, 2000] += 150
    cover = np.zeros_like(dry)
    cover[:, :1200] = 255
    write_image(tmp_path / "data/0_rain.png", wet)
    write_image(tmp_path / "gt/0_clean.png", dry)
    for kind, picture in (("rainy", wet), ("clean", dry), ("coverage", cover)):
        write_image(tmp_path / kind / "0.png", picture)
    for read in (read_rendered, read_photo_pairs):
        for part in read(tmp_path):
            assert part[0].shape[:2] == (30, LONGEST)
    seen = read_photo_pairs(tmp_path)[2][0]
    assert seen[15, 200:400].min() == 255 and seen[:, 410:].max() == 0
    assert (read_rendered(tmp_path)[2][0] == np.repeat([255, 0], 600)).all()
    write_image(tmp_path / "gt/0_clean.png", dry[:, :1200])
    with pytest.raises(UserError, match=r"0_rain\.png and its partners differ in size"):
        read_photo_pairs(tmp_path)


def _bricks_and_a_drop() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A wall without and with a drop before it (96,96,3) in [0,1], and the drop's coverage."""
    from pipeline.drops.painter import paint
    from pipeline.drops.shape import Drop

    y, x = np.mgrid[:96, :96].astype(np.float32)
    mortar = (((y // 8) % 2 * 6 + x) % 12 < 1.5) | (y % 8 < 1.5)
    bricks = np.where(
        mortar[..., None], np.float32([0.75, 0.72, 0.68]), np.float32([0.6, 0.3, 0.2])
    )
    picture = bricks * (0.5 + 0.5 * x / 96)[..., None]
    drop = Drop(center=(6.0, -4.0), radius=9.0, contact_angle=1.1)
    wet, coverage = paint(picture, [drop], focal_px=333, pane_distance=333, aperture_radius=2.5)
    return picture, wet, coverage


@pytest.mark.parametrize(("file", "model"), SHIPPED.items())
def test_shipped_weights_find_a_painted_drop(file: str, model: str) -> None:
    picture, wet, coverage = _bricks_and_a_drop()
    path = WEIGHTS / f"{file}.safetensors"
    assert load_tensors(path)[1].get("model", "attentive") == model
    network = load_network(path, model)
    found = attend(network, wet)
    core, away = coverage > 0.5, coverage == 0
    assert core.sum() > 200
    assert found[core].mean() > 0.4
    assert found[away].mean() < 0.1
    assert attend(network, picture)[core].mean() < 0.1


def test_the_shipped_weights_for_differences_mark_what_differs_and_less_of_the_rim() -> None:
    picture, wet, coverage = _bricks_and_a_drop()
    differs = (
        coverage_of_pair(*(np.rint(each * 255).astype(np.uint8) for each in (wet, picture))) > 0
    )
    faint = (coverage > 0) & ~differs
    found = [
        attend(load_network(WEIGHTS / f"{name}.safetensors", "unet"), wet)
        for name in ("unet", "unet-difference")
    ]
    assert differs.sum() > 100 and found[1][differs].mean() > 0.8
    assert found[1][faint].mean() < found[0][faint].mean() - 0.05
