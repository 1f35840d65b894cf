"""Losses are zero at the truth, starts copy the photo, and interrupted trainings end like others."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import TypeAdapter
from torch.nn import functional as F

from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.attention.training import attention_loss
from pipeline.errors import UserError
from pipeline.geometry.crops import resident
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.removal import clips, training
from pipeline.removal.autoencoder import Scales, multi_scale_loss
from pipeline.removal.critics import AttentiveCritic, PatchCritic, Verdict
from pipeline.removal.losses import PerceptualLoss, adversarial_map_loss, least_squares, wen_loss
from pipeline.removal.recipes import Added, AnyRecipe, recipe_of, weights_of
from pipeline.removal.samples import Pairs, draw_batch, draw_resident, drop_map
from pipeline.removal.store import save_remover
from pipeline.removal.training import Phase, Plan, Trainer, fit
from pipeline.removal.wen import Frames, mend
from tests.answers import answers


def recipe(method: str) -> AnyRecipe:
    attention = AttentiveRecurrentNet()
    attention.initialise(0)
    return recipe_of(
        method, 3, attention=attention, map_loss=attention_loss,
        train_attention=True, steps=1, published_edges=True,
    )  # fmt: skip


def pictures(frames: int = 1, size: int = 40) -> Pairs:
    """Noise, a square of which is brighter where it is wet."""
    rng = np.random.default_rng(0)
    shape = (size, size, 3) if frames == 1 else (frames, size, size, 3)
    clean = [rng.integers(20, 150, shape, dtype=np.uint8) for _ in range(2)]
    cover = np.zeros((size, size), np.uint8)
    cover[8:20, 8:20] = 255
    rainy = [np.where(cover[..., None] > 0, each + 90, each).astype(np.uint8) for each in clean]
    return Pairs(rainy, clean, [cover, cover])


def plan(kind: str, iterations: int = 2, crop: int = 32, adversarial: float = 0.0) -> Plan:
    phase = Phase(kind, iterations, 1, crop, 1e-3, None)  # type: ignore[arg-type]
    return Plan((0.9, 0.99), adversarial, 1e-4, [phase])


@pytest.mark.parametrize(("method", "near"), [("attgan", 1e-5), ("quan", 0.1), ("wen", 0.1)])
def test_a_remover_starts_by_copying_its_photo(method: str, near: float) -> None:
    """Quan's faint other channels come on top; Wen's way up shows smooth pictures only."""
    ramps = torch.linspace(0.2, 0.8, 64).expand(64, 64)
    rainy = torch.stack([ramps, ramps.t(), 1 - ramps])[None, None]
    with torch.inference_mode():
        found = recipe(method).eval().restored(rainy)
    inner = (..., slice(16, 48), slice(16, 48))
    assert float((found - rainy[:, 0])[inner].abs().mean()) < near / 2
    assert torch.allclose(found[inner], rainy[:, 0][inner], atol=near)


@pytest.mark.parametrize(("method", "frames"), [("quan", 1), ("wen", 5)])
def test_the_first_gradient_reaches_every_layer(method: str, frames: int) -> None:
    """AttGAN's passes its last two layers from the second iteration on only, and its heads at once."""
    made = recipe(method)
    batch = draw_batch([pictures(frames)], np.random.default_rng(0), 1, 32)
    made.train().outcome(batch, None).loss.backward()
    for name, values in made.named_parameters():
        if name.endswith("weight") and not name.startswith("guides"):
            assert values.grad is not None and bool((values.grad != 0).any()), name


def test_the_way_down_of_wen_starts_with_every_pixel_in_a_channel_of_its_own() -> None:
    frame = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        found = recipe("wen").network.main_branch(frame * 2 - 1)[0, :48]
    # Channels: colour, then row and column of the pixel among 2x2, then of those among 2x2.
    blocks = frame[0].view(3, 8, 2, 2, 8, 2, 2) * 2
    expected = blocks.permute(0, 3, 6, 2, 5, 1, 4).reshape(48, 8, 8)
    assert torch.allclose(found, expected, atol=1e-5)


def test_losses_are_zero_at_the_truth() -> None:
    dry = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    sizes = [F.interpolate(dry, (n, n), mode="bilinear", antialias=True) for n in (4, 8, 16)]
    assert float(multi_scale_loss(Scales(*sizes), dry)) == pytest.approx(0, abs=1e-9)

    clean = torch.rand(1, 5, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1
    drops = torch.zeros(1, 5, 1, 32, 32)
    drops[..., 4:9, 4:9] = 1
    flat = clean.flatten(0, 1)
    truth = Frames(flat[..., ::4, ::4], flat[..., ::2, ::2], clean, 1 - drops)
    assert float(wen_loss(truth, clean, clean, drops)) < 2e-5  # the map's logarithm is cut at 1e-6
    # Off by 0.1 everywhere: 25 x 0.01, and again where it is wet; nothing at the smaller sizes.
    wrong = truth._replace(full=clean + 0.1)
    wet = float(drops.mean())
    assert float(wen_loss(wrong, clean, clean, drops)) == pytest.approx(0.25 * (1 + wet), rel=1e-3)
    # A map that says the opposite is as wrong as it can be.
    assert float(wen_loss(truth._replace(clear=drops), clean, clean, drops)) > 100


def test_single_pictures_are_compared_once_more_as_their_map_mends_them() -> None:
    """With the map that was found, not the true one, so that it learns from it; clips are compared once."""
    seen: list[torch.Tensor] = []

    class Spy(torch.nn.Module):
        def forward(self, found: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
            seen.append(found)
            return (found - wanted).square().mean()

    for frames in (1, 5):
        clean, drops = torch.zeros(1, frames, 3, 32, 32), torch.zeros(1, frames, 1, 32, 32)
        rainy, full = clean + 0.8, clean + 0.2
        clear = torch.full_like(drops, 0.25, requires_grad=True)
        flat = clean.flatten(0, 1)
        found = Frames(flat[..., ::4, ::4], flat[..., ::2, ::2], full, clear)
        seen.clear()
        plain, whole = (wen_loss(found, rainy, clean, drops, spy) for spy in (None, Spy()))
        added = whole - plain
        again = 10 * 0.35**2 if frames == 1 else 0  # a quarter of 0.8 and three of 0.2
        assert added.item() == pytest.approx(10 * 0.2**2 + again, rel=1e-4)
        added.backward()
        assert clear.grad is not None and bool((clear.grad > 1e-6).all()) == (frames == 1)
        assert len(seen) == (2 if frames == 1 else 1) and torch.equal(seen[0], full.flatten(0, 1))


def test_the_map_of_wen_is_judged_in_full_precision_outside_autocast(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A GPU's autocast region refuses this cross-entropy; a CPU's does not, so a spy refuses it here."""
    real, dtypes = F.binary_cross_entropy, []

    def refuses(found: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        assert not torch.is_autocast_enabled(found.device.type)
        dtypes.extend([found.dtype, wanted.dtype])
        return real(found, wanted)

    made = recipe("wen")
    batch = draw_batch([pictures(5)], np.random.default_rng(0), 1, 32)
    monkeypatch.setattr(F, "binary_cross_entropy", refuses)
    with torch.autocast("cpu", torch.bfloat16):
        loss = made.train().outcome(batch, None).loss
        assert torch.is_autocast_enabled("cpu")
    assert dtypes == [torch.float32] * 2 and loss.dtype == torch.float32
    assert bool(torch.isfinite(loss))


def test_what_is_added_to_the_published_losses_is_added() -> None:
    """Squares of what is off, guides that know nothing yet, and the mended photo, worked out."""
    batch = draw_batch([pictures()], np.random.default_rng(0), 2, 32)
    plain = recipe("quan")
    added = recipe_of("quan", 3, attention=None, map_loss=attention_loss, train_attention=False,
                      steps=1, published_edges=True, added=Added(2, 3))  # fmt: skip
    assert weights_of(added).keys() == plain.network.state_dict().keys()
    first, second = plain.outcome(batch, None), added.outcome(batch, None)
    squares = F.mse_loss(first.fake, first.real)
    change = torch.cat([batch.clean - batch.rainy, batch.drops], 2)[:, 0]
    guides = sum(F.avg_pool2d(change, size).square().mean() for size in (2, 4))
    assert torch.allclose(second.loss - first.loss, 2 * squares + 3 * guides, rtol=1e-3)
    with pytest.raises(ValueError, match="0 or more"):
        Added(-1)

    frames, full = torch.zeros(1, 1, 3, 2, 2), torch.ones(1, 1, 3, 2, 2)
    clear = torch.tensor([[1.0, 0.0], [0.25, 0.5]]).view(1, 1, 1, 2, 2)
    mended = mend(frames, full, clear)
    assert mended[0, 0, 0].tolist() == [[0, 1], [0.75, 0.5]]


def test_weights_say_how_they_were_trained(tmp_path: Path) -> None:
    """Which edges quan saw, and whether wen's photo was mended; attgan has neither."""
    how = {"attention": None, "map_loss": attention_loss, "train_attention": False, "steps": 1}
    told = []
    for method, edges, mended in (
        ("quan", True, 0), ("quan", False, 0), ("wen", True, 0), ("wen", True, 50),
    ):  # fmt: skip
        made = recipe_of(method, 0, published_edges=edges, added=Added(0, 0, mended), **how)  # type: ignore[arg-type]
        save_remover(tmp_path / "w.safetensors", made, method)
        told.append(load_tensors(tmp_path / "w.safetensors")[1])
    assert told == [
        {"model": "quan", "published_edges": "true"},
        {"model": "quan", "published_edges": "false"},
        {"model": "wen", "mended": "false"},
        {"model": "wen", "mended": "true"},
    ]
    save_remover(tmp_path / "w.safetensors", recipe("attgan"), "attgan")
    assert load_tensors(tmp_path / "w.safetensors")[1] == {"model": "attgan"}


def test_the_discriminators_maps_are_to_be_the_generators_and_nothing() -> None:
    attention = torch.rand(1, 1, 8, 8)
    nothing = torch.zeros(1, 1, 8, 8)
    assert float(adversarial_map_loss(attention, nothing, attention)) == 0
    assert float(adversarial_map_loss(nothing, nothing + 2, attention * 0)) == 4


def test_attentive_discriminator_is_the_published_one() -> None:
    critic = AttentiveCritic()
    assert sum(value.numel() for value in critic.parameters()) == 7_737_746
    dense = sum(value.numel() for value in critic.fc.parameters())
    assert 7_737_746 - dense == 1_313_169
    verdict = critic(torch.rand(1, 3, 224, 224))
    assert verdict.probability.shape == (1, 1) and verdict.attention.shape == (1, 1, 224, 224)


def test_the_attentive_discriminators_loss_is_nothing_where_it_is_right() -> None:
    critic = AttentiveCritic()
    attention, nothing = torch.rand(1, 1, 4, 4), torch.zeros(1, 1, 4, 4)
    right = {
        "fake": Verdict(torch.zeros(1, 1), attention),
        "real": Verdict(torch.ones(1, 1), nothing),
    }
    critic.forward = lambda kind: right[kind]  # type: ignore[method-assign,assignment]
    assert float(critic.loss("fake", "real", attention)) == pytest.approx(0, abs=1e-5)  # type: ignore[arg-type]
    # A wrong map costs 0.05 of its square, and the generator gains nothing from what is seen through.
    wrong = attention + 2
    assert float(critic.loss("fake", "real", wrong)) == pytest.approx(0.2, abs=1e-5)  # type: ignore[arg-type]
    assert float(critic.fooled("fake")) == pytest.approx(0, abs=1e-5)  # type: ignore[arg-type]
    assert float(critic.fooled("real")) < -10  # type: ignore[arg-type]


def test_patches_are_judged_at_three_scales_and_squares_vanish_at_the_truth() -> None:
    critic = PatchCritic()
    sides = [verdict.shape[-1] for verdict in critic(torch.rand(1, 15, 64, 64))]
    assert len(sides) == 3 and sides[0] > sides[1] > sides[2]
    critic.forward = lambda frames: [frames]  # type: ignore[method-assign]
    assert float(critic.fooled(torch.ones(2, 2))) == 0
    assert float(critic.loss(torch.zeros(2, 2), torch.ones(2, 2), torch.zeros(1))) == 0
    assert float(critic.loss(torch.ones(2, 2), torch.zeros(2, 2), torch.zeros(1))) == 1
    # Of several scales, each a mean over its patches, the sum: 1 + 4 + 9.
    scales = [
        torch.full((1, 1, size, size), value) for size, value in ((8, 1.0), (4, 2.0), (2, 3.0))
    ]
    assert float(least_squares(scales, 0.0)) == 14
    critic.forward = lambda frames: [scale * frames for scale in scales]  # type: ignore[method-assign]
    assert float(critic.fooled(torch.zeros(1))) == 3
    assert float(critic.loss(torch.ones(1), torch.ones(1), torch.zeros(1))) == 0.5 * (
        14 + 0 + 1 + 4
    )


@pytest.mark.parametrize(("method", "depth"), [("attgan", (64, 64, 0, 128, 128)),
                         ("wen", (64, 64, 0, 128, 128, 0, *[256] * 4, 0, *[512] * 4, 0, 512))])  # fmt: skip
def test_features_of_a_vgg_tell_pictures_apart(
    tmp_path: Path, method: str, depth: tuple[int, ...]
) -> None:
    torch.manual_seed(0)
    state, layer, channels = {}, 0, 3
    for width in depth:  # torchvision counts products, cuts and halvings alike
        if width:
            state[f"features.{layer}.weight"] = (
                torch.randn(width, 1, 3, 3).expand(-1, channels, -1, -1) * 0.05
            )
            state[f"features.{layer}.bias"] = torch.zeros(width)
            channels = width
        layer += 2 if width else 1
    path = tmp_path / "vgg.safetensors"
    save_tensors(path, state)
    loss = PerceptualLoss(path, method)
    x = torch.rand(1, 3, 32, 32)
    assert float(loss(x, x)) == 0
    assert float(loss(x, 1 - x)) > 0
    assert not any(value.requires_grad for value in loss.parameters())
    first = F.relu(F.conv2d(x, state["features.0.weight"], padding=1))
    assert torch.allclose(loss.features[:2](x), first, atol=1e-6)
    with pytest.raises(UserError, match="without a perceptual loss"):
        PerceptualLoss(path, "quan")
    save_tensors(path, {"features.0.weight": state["features.0.weight"]})
    with pytest.raises(
        UserError, match=r"is not torchvision's VGG-\d+: features.0.bias is missing"
    ):
        PerceptualLoss(path, method)


def test_crops_cut_on_the_device_hold_the_same_things() -> None:
    for frames in (1, 5):
        stacks = resident([pictures(frames)], "cpu")
        found, again = (draw_resident(stacks, np.random.default_rng(0), 3, 32) for _ in range(2))
        beside = draw_batch([pictures(frames)], np.random.default_rng(0), 3, 32)
        for one, two, other in zip(found, again, beside, strict=True):
            assert torch.equal(one, two) and one.shape == other.shape and one.dtype == other.dtype
        assert torch.equal(found.drops, drop_map(found.rainy, found.clean))
        assert float(found.rainy.min()) >= 0 and 0 < float(found.drops.mean()) < 1


@pytest.mark.parametrize("place", [0.1, 0.4, 0.6])
def test_a_camera_set_otherwise_makes_the_same_of_both_partners_there(place: float) -> None:
    """Of even pictures: where a crop is taken from, and at which scale, makes no difference."""
    clean = np.full((40, 40, 3), (90, 120, 150), np.uint8)
    pool = Pairs([clean + 60], [clean], [np.full((40, 40), 255, np.uint8)])
    beside = draw_batch([pool], answers(place), 1, 32)
    found = draw_resident(resident([pool], "cpu"), answers(place), 1, 32)
    for one, other in zip(found, beside, strict=True):
        assert torch.allclose(one, other, atol=1e-5)
    as_it_was = bool(
        torch.allclose(beside.clean[0, 0, :, 0, 0] * 255, torch.tensor([90.0, 120, 150]))
    )
    assert as_it_was == (place > 0.5)


def test_batches_hold_both_partners_alike_and_clips_their_frames() -> None:
    found = draw_batch([pictures()], np.random.default_rng(0), 3, 32)
    assert found.rainy.shape == found.clean.shape == (3, 1, 3, 32, 32)
    assert found.drops.shape == (3, 1, 1, 32, 32)
    assert torch.equal(found.drops, drop_map(found.rainy, found.clean))
    dry = (found.drops == 0).expand_as(found.rainy)
    assert float((found.rainy - found.clean)[dry].abs().max()) <= 30 / 255
    assert 0 < float(found.drops.mean()) < 1
    assert draw_batch([pictures(5)], np.random.default_rng(0), 1, 32).rainy.shape == (
        1,
        5,
        3,
        32,
        32,
    )


def test_more_than_thirty_is_a_drop() -> None:
    clean = torch.zeros(1, 3, 1, 2)
    rainy = clean.clone()
    rainy[0, 1] = torch.tensor([29.9 / 255, 30.1 / 255])
    assert drop_map(rainy, clean).flatten().tolist() == [0, 1]


def test_clips_move_behind_drops_that_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clips, "CHUNK", 2)
    monkeypatch.setattr(clips, "SIZE", 48)
    path = tmp_path / "0.npy"
    clips.paint_chunk(path, 4, 0)
    rainy, clean, coverage = clips.read_chunk(path)
    assert len(rainy) == 2 and rainy[0].shape == clean[0].shape == (5, 48, 48, 3)
    assert coverage[0].shape == (48, 48)
    assert all(np.abs(clip[0].astype(int) - clip[4]).mean() > 1 for clip in clean)
    for wet, dry, cover in zip(rainy, clean, coverage, strict=True):
        change = np.abs(wet.astype(int) - dry).mean(-1)
        spread = change[:, cover == 0].mean()  # of the codec
        assert spread < 8 and spread < change[:, cover > 0].mean()
    written = path.read_bytes()
    path.unlink()
    clips.paint_chunk(path, 4, 0)
    assert path.read_bytes() == written


def test_a_still_picture_passes_by_at_the_speed_of_the_camera() -> None:
    """A ramp's brightness tells where each view looks: equal steps, none beyond its border."""
    ramp = np.repeat(np.linspace(0, 1, 200, dtype=np.float32)[None, :, None], 200, 0)
    views = clips.pan(np.random.default_rng(3), np.repeat(ramp, 3, 2), 40)
    assert views.shape == (5, 40, 40, 3)
    middles = views[:, 20, 19:21, 0].mean(1)
    steps = np.diff(middles)
    assert np.allclose(steps, steps.mean(), atol=2e-3) and abs(steps.mean()) > 1e-3
    assert views[:, 20, :, 0].min() > 0 and views[:, 20, :, 0].max() < 1


@pytest.mark.parametrize(
    ("method", "kind", "frames", "adversarial"),
    [
        ("attgan", "pairs", 1, 0.0),
        ("quan", "pairs", 1, 0.0),
        ("wen", "clips", 5, 1.0),
        ("wen", "carry", 1, 0.0),
    ],
)
def test_interrupted_and_resumed_is_the_same(
    method: str, kind: str, frames: int, adversarial: float
) -> None:
    def trainer() -> Trainer:
        pool = [pictures(frames)]
        return Trainer(recipe(method), pool, pool, plan(kind, adversarial=adversarial), seed=1,
                       on_device=method == "wen")  # fmt: skip

    whole, first, second = trainer(), trainer(), trainer()
    before = {name: value.clone() for name, value in whole.recipe.state_dict().items()}
    for _ in range(2):
        loss = whole.advance()
    assert math.isfinite(loss) and whole.finished
    first.advance()
    second.restore(first.state())
    assert second.advance() == loss
    for name, value in whole.average.state_dict().items():
        assert torch.equal(value, second.average.state_dict()[name]), name
    changed = sum(not torch.equal(v, before[n]) for n, v in whole.recipe.state_dict().items())
    assert changed > 10


def test_attgan_learns_with_all_its_losses(tmp_path: Path) -> None:
    """Maps of two steps, three scales, features and the attentive discriminator."""
    torch.manual_seed(0)
    state = {}
    for layer, (into, width) in {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128)}.items():
        state[f"features.{layer}.weight"] = torch.randn(width, into, 3, 3) * 0.05
        state[f"features.{layer}.bias"] = torch.zeros(width)
    save_tensors(tmp_path / "vgg.safetensors", state)
    made = recipe_of("attgan", 3, attention=recipe("attgan").attention, map_loss=attention_loss,
                     train_attention=True, steps=2, published_edges=True)  # fmt: skip
    trainer = Trainer(made, [pictures(size=224)], [], plan("pairs", 1, 224, adversarial=1.0),
                      seed=1, perceptual=PerceptualLoss(tmp_path / "vgg.safetensors", "attgan"))  # fmt: skip
    assert trainer.critic is not None
    parts = (trainer.recipe.attention, trainer.recipe.autoencoder, trainer.critic)
    before = [{k: v.clone() for k, v in part.state_dict().items()} for part in parts]
    assert math.isfinite(trainer.advance()) and trainer.finished
    for part, old in zip(parts, before, strict=True):
        new = part.state_dict()
        assert all(bool(value.isfinite().all()) for value in new.values())
        assert sum(not torch.equal(value, old[name]) for name, value in new.items()) > 10


def test_a_few_steps_lower_the_loss_on_what_they_see() -> None:
    phases = [Phase("pairs", 8, 1, 32, 1e-3, 0.0)]
    trainer = Trainer(
        recipe("quan"), [pictures()], [], Plan((0.9, 0.99), 0.0, 1e-4, phases), seed=1
    )
    seen: list[float] = []
    fit(trainer, 4, {"all": pictures(size=33)}, lambda loss, found: seen.append(loss))
    assert len(seen) == 2 and seen[1] < seen[0]


def test_the_attention_stays_as_it_is_unless_it_is_to_learn() -> None:
    made = recipe("attgan")
    frozen = recipe_of("attgan", 3, attention=AttentiveRecurrentNet(), map_loss=attention_loss,
                       train_attention=False, steps=1, published_edges=True)  # fmt: skip
    for each, learns in ((made, True), (frozen, False)):
        before = {k: v.clone() for k, v in each.state_dict().items()}
        Trainer(each, [pictures()], [], plan("pairs", 1), seed=0).advance()
        same = [torch.equal(v, before[k]) for k, v in each.state_dict().items() if "attention" in k]
        assert all(same) != learns


@pytest.mark.parametrize(
    ("method", "wrong", "told"),
    [
        ("attgan", plan("pairs", crop=34), "no multiple of 4"),
        ("wen", plan("clips", crop=48), "no multiple of 32"),
        ("attgan", plan("pairs", crop=64, adversarial=1), "reads 224x224 pixels, not 64"),
        ("quan", plan("pairs", adversarial=1), "without a discriminator"),
        ("quan", plan("clips"), "Only wen looks at several frames"),
        ("wen", plan("clips"), "There are no clips to train on"),
    ],
)
def test_what_cannot_be_trained_is_told_in_a_sentence(method: str, wrong: Plan, told: str) -> None:
    with pytest.raises(UserError, match=told):
        Trainer(recipe(method), [pictures()], [], wrong, seed=0)


def test_single_pictures_between_clips_need_pairs() -> None:
    with pytest.raises(UserError, match="There are no pairs to train on"):
        Trainer(recipe("wen"), [], [pictures(5)], plan("clips"), seed=0, single_share=0.1)


def test_a_training_that_broke_down_ends_with_a_sentence() -> None:
    trainer = Trainer(recipe("quan"), [pictures()], [], plan("pairs"), seed=0)
    with torch.no_grad():
        next(trainer.recipe.parameters()).fill_(math.nan)
    with pytest.raises(UserError, match="broke down near step 1"):
        fit(trainer, 5, {}, lambda loss, found: None)


def test_numbers_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="0 or more"):
        Phase("pairs", 1, 1, 32, 0.1, -0.3)
    with pytest.raises(ValueError, match="finite"):
        TypeAdapter(Plan).validate_python({"betas": (0, 0), "adversarial": math.inf, "critic_rate": 1,
                                           "phases": [Phase("pairs", 1, 1, 32, 0.1, None)]})  # fmt: skip
    for values in (("pairs", 0, 1, 32, 0.1, None), ("pairs", 1, 1, 32, 0.0, None)):
        with pytest.raises(ValueError, match="the rate lies in"):
            Phase(*values)  # type: ignore[arg-type]
    phases = [Phase("pairs", 1, 1, 32, 0.1, None)]
    for betas, adversarial, given in (
        ((1.0, 0.9), 0, phases),
        ((0.9, 0.9), -1, phases),
        ((0, 0), 0, []),
    ):
        with pytest.raises(ValueError, match=r"lie in|is 0 or more"):
            Plan(betas, adversarial, 1e-4, given)


@pytest.mark.parametrize("known", [True, False])
def test_half_precision_where_the_processor_has_it(
    known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Elsewhere it would be slower: the steps are those of float32."""
    monkeypatch.setattr(training, "multiplies_bfloat16", lambda device: known)
    exact, half = (
        Trainer(recipe("quan"), [pictures()], [], plan("pairs"), seed=0, bfloat16=wish).advance()
        for wish in (False, True)
    )
    assert (exact != half) is known
