"""The fit learns, repeats to the byte, survives a kill and says when it breaks down."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from pipeline.errors import UserError
from pipeline.field.base import Part
from pipeline.field.buffer import Batch, PosedPhoto, RayBuffer
from pipeline.field.fit import Stepper, _row, fit, refuse_large
from pipeline.field.grid_field import GridConfig, GridField
from pipeline.field.model import build_around, describe, half_is_fast, restore, scene_space
from pipeline.field.render import render_view
from pipeline.field.store import Checkpoint

sys.path.insert(0, str(Path(__file__).parent))
from scene import camera, photograph

ROOT = Path(__file__).resolve().parents[2]
SIZE, FOCAL, NEAR, FAR = (40, 30), 38.0, 2.5, 20.0
INTRINSICS = (FOCAL, FOCAL, 20.0, 15.0, 0.0)
SMALL = GridConfig(
    levels=2, features=4, table_log2=12, coarse=(12, 10, 8), fine=(48, 36, 16), hidden=16,
    samples=6, bins=16, proposal=(24, 18, 16),
)  # fmt: skip


@pytest.fixture(scope="module")
def photos() -> list[PosedPhoto]:
    out = []
    for i in range(6):
        pose = camera(i, 6)
        image, _ = photograph(pose, *SIZE, FOCAL)
        keep = np.ones((30, 40), bool)
        keep[5:9, 5:9] = False
        out.append(PosedPhoto(f"{i}", image, keep, pose, INTRINSICS, NEAR, FAR))
    return out


def field(photos: list[PosedPhoto], seed: int = 0) -> GridField:
    cams = np.stack([p.cam_from_world for p in photos])
    count = len(photos)
    space = scene_space(
        "auto", cams, np.tile(INTRINSICS, (count, 1)), np.tile(SIZE, (count, 1)), NEAR, FAR
    )
    return GridField(SMALL, space, seed)


def same(a: torch.nn.Module, b: torch.nn.Module) -> bool:
    pairs = zip(a.parameters(), b.parameters(), strict=True)
    return all(torch.equal(x, y) for x, y in pairs)


def test_covered_pixels_are_never_drawn(photos: list[PosedPhoto]) -> None:
    marked = []
    for p in photos:
        image = np.zeros_like(p.image)
        image[~p.keep_mask] = 1.0
        marked.append(_with(p, image))
    buffer = RayBuffer(marked, 0)
    assert buffer.count == 6 * (1200 - 16)
    drawn = [buffer.batch(step, 512)[1] for step in range(buffer.count // 512)]
    assert float(torch.cat(drawn).max()) == 0.0


def _with(photo: PosedPhoto, image: np.ndarray) -> PosedPhoto:
    return PosedPhoto(**{**vars(photo), "image": image})


def test_an_epoch_draws_every_kept_pixel_once(photos: list[PosedPhoto]) -> None:
    buffer = RayBuffer(photos[:1], 0)
    size = buffer.count // 8
    rays = torch.cat([buffer.batch(step, size)[0].rays_d for step in range(8)], dim=1)
    assert len(torch.unique(rays, dim=1).t()) == size * 8


def test_everything_masked_is_said(photos: list[PosedPhoto]) -> None:
    dark = PosedPhoto(**{**vars(photos[0]), "keep_mask": np.zeros((30, 40), bool)})
    with pytest.raises(UserError, match="masked"):
        RayBuffer([dark], 0)


def test_the_fit_learns_and_a_view_renders_close_to_the_photo(photos: list[PosedPhoto]) -> None:
    model = field(photos)
    record = fit(model, RayBuffer(photos, 0), steps=100, batch_rays=512, seed=0)
    assert record.rows[-1][0] == 100
    spread = float(np.mean([p.image.reshape(-1, 3).var(0).mean() for p in photos]))
    grey = -10 * np.log10(spread)  # what the mean colour of each photo reaches
    assert record.rows[-1][2] > grey + 2.0
    view = render_view(model, photos[1].cam_from_world, INTRINSICS, SIZE, NEAR, FAR)
    error = float(((view.rgb - photos[1].image) ** 2).mean())
    assert -10 * np.log10(error) > grey + 2.0
    assert view.depth.min() >= NEAR * 0.999 and view.depth.max() <= FAR * 1.001
    again = restore(describe(model), {k: v.numpy() for k, v in model.state_dict().items()})
    twice = render_view(again, photos[1].cam_from_world, INTRINSICS, SIZE, NEAR, FAR)
    assert np.array_equal(view.rgb, twice.rgb)


def test_same_seed_same_bytes_for_one_thread_and_two(photos: list[PosedPhoto]) -> None:
    models = [field(photos) for _ in range(3)]
    for model, threads, seed in zip(models, (1, 2, 1), (7, 7, 8), strict=True):
        fit(model, RayBuffer(photos, 0), steps=8, batch_rays=256, seed=seed, threads=threads)
    assert same(models[0], models[1])
    assert not same(models[0], models[2])


class Killed(Exception):
    pass


@pytest.mark.parametrize("average", [0.0, 1.0])
@pytest.mark.parametrize("at", [1, 7, 8, 11])
def test_a_fit_killed_at_any_step_ends_with_the_same_bytes(
    photos: list[PosedPhoto], tmp_path: Path, at: int, average: float
) -> None:
    """The process dies after step ``at``, a checkpoint every third step lies on disk; run again."""
    how = {"steps": 12, "batch_rays": 256, "seed": 3, "log_every": 5, "save_every": 3,
           "exposure": True, "average": average}  # fmt: skip
    checkpoint = Checkpoint(tmp_path / "checkpoint.safetensors", "key")
    whole, dying, later = field(photos), field(photos), field(photos, seed=99)
    first = fit(whole, RayBuffer(photos, 0), **how)
    fatal = RayBuffer(photos, 0)
    draw = fatal.batch

    def batch(step: int, size: int) -> Batch:
        if step == at:
            raise Killed
        return draw(step, size)

    fatal.batch = batch  # type: ignore[method-assign]
    with pytest.raises(Killed):
        fit(dying, fatal, save=checkpoint.save, **how)
    resume = checkpoint.load()
    assert (resume[0] if resume else 0) == at // 3 * 3
    if resume is None:
        later = field(photos)
    second = fit(later, RayBuffer(photos, 0), resume=resume, **how)
    assert same(whole, later)
    assert first.rows == second.rows


def test_the_mean_is_that_of_every_tenth_step_of_the_last_share(photos: list[PosedPhoto]) -> None:
    """Half of 40 steps: those after 30 and 40, not the 20th; no share, or one step's, is the last step's."""
    last, none, mean = field(photos), field(photos), field(photos)
    after: dict[int, list[torch.Tensor]] = {}

    def note(step: int, loss: float, psnr: float) -> None:
        after[step] = [p.detach().clone() for p in last.parameters()]

    how = {"steps": 40, "batch_rays": 128, "seed": 3, "log_every": 10}
    fit(last, RayBuffer(photos, 0), progress=note, **how)
    fit(none, RayBuffer(photos, 0), average=1 / 40, **how)
    fit(mean, RayBuffer(photos, 0), average=0.5, **how)
    assert same(last, none)
    assert not same(last, mean)
    for got, third, fourth in zip(mean.parameters(), after[30], after[40], strict=True):
        torch.testing.assert_close(got, (third + fourth) / 2)


def test_soft_masks_reach_the_loss(photos: list[PosedPhoto]) -> None:
    """Fully soft-masked photos teach nothing about colour: grey noise there leaves the fit alone."""
    soft = np.zeros((30, 40), np.float32)
    soft[:, 20:] = 1.0
    models = []
    for value in (0.0, 1.0):
        marked = []
        for photo in photos:
            image = photo.image.copy()
            image[:, 20:] = value
            marked.append(PosedPhoto(**{**vars(photo), "image": image, "drop_mask": soft}))
        models.append(field(photos))
        fit(models[-1], RayBuffer(marked, 0), steps=6, batch_rays=256, seed=0)
    assert same(*models)


def test_shards_weigh_soft_masks_as_the_whole_batch_does(photos: list[PosedPhoto]) -> None:
    """Equation 4 is normalised over all rays of a step: however it is cut, the gradients are the same."""
    soft = np.zeros((30, 40), np.float32)
    soft[:, :30] = 0.9
    marked = [
        PosedPhoto(**{**vars(photo), "drop_mask": soft * (i < 3)}) for i, photo in enumerate(photos)
    ]
    losses = []
    for shards in (1, 4):
        record = fit(
            field(marked), RayBuffer(marked, 0), steps=1, batch_rays=256, seed=0, shards=shards
        )
        losses.append(record.rows[0][2])
    assert losses[1] == pytest.approx(losses[0], abs=1e-4)


def test_errors_that_are_no_numbers_end_the_fit_even_where_they_are_trimmed() -> None:
    with pytest.raises(UserError, match="broke down near step 4"):
        _row(5, [torch.tensor([0.0, float("nan")])])


def test_tables_too_large_for_the_memory_are_told(
    photos: list[PosedPhoto], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four times the parameters must be free: gradients, two moments, the mean."""
    model = field(photos)
    held = 4 * sum(parameter.nbytes for parameter in model.parameters())
    monkeypatch.setattr("pipeline.io.memory.free_memory", lambda: held)
    refuse_large(model, "cpu")
    monkeypatch.setattr("pipeline.io.memory.free_memory", lambda: held - 1)
    with pytest.raises(UserError, match="the field's tables need about"):
        refuse_large(model, "cpu")


def test_the_exposure_of_each_photo_is_found(photos: list[PosedPhoto]) -> None:
    """Half of the photos half as bright: ratios between photos come out, the mean stays 1."""
    dark = [0.5 if i % 2 else 1.0 for i in range(len(photos))]
    lit = [
        PosedPhoto(**{**vars(p), "image": p.image * d}) for p, d in zip(photos, dark, strict=True)
    ]
    record = fit(
        field(lit), RayBuffer(lit, 0), steps=250, batch_rays=512, seed=0, exposure=True, rate=2.0
    )
    logs = record.gains.log()
    assert logs.mean(0).abs().max() < 1e-5
    steps = logs[::2].mean(0) - logs[1::2].mean(0)
    assert torch.all((steps - np.log(2.0)).abs() < 0.15)


def test_the_rate_scales_every_step(photos: list[PosedPhoto]) -> None:
    """Adam's first step moves every parameter that has a gradient by its rate."""
    moved = []
    for rate in (1.0, 0.25):
        model, start = field(photos), field(photos)
        fit(model, RayBuffer(photos, 0), steps=1, batch_rays=256, seed=0, rate=rate)
        moved.append((model.colour_out.bias - start.colour_out.bias).abs().max().item())
    assert moved[1] == pytest.approx(moved[0] / 4, rel=1e-3)


def test_decay_shrinks_by_its_share_of_the_rate() -> None:
    """No gradient: ten steps at a constant rate of 0.1 leave (1 - 0.1 * 0.5)^10 of each parameter."""
    table = torch.nn.Parameter(torch.tensor([2.0, -1.0]))
    part = Part("table", ("table",), rate=0.1, final=1.0, decay=0.5)
    stepper = Stepper(part, [table], steps=10)
    for step in range(10):
        stepper.step(step, [torch.zeros(2)])
    torch.testing.assert_close(table.detach(), torch.tensor([2.0, -1.0]) * 0.95**10)


@pytest.mark.parametrize(("precision", "half"), [("float32", False), ("bfloat16", True)])
def test_products_are_of_the_precision_asked_for(
    photos: list[PosedPhoto], precision: str, half: bool
) -> None:
    class Camera:
        def __init__(self, photo: PosedPhoto) -> None:
            self.cam_from_world, self.intrinsics = photo.cam_from_world, photo.intrinsics
            self.height, self.width = photo.keep_mask.shape

    cameras = [Camera(photo) for photo in photos]
    model = build_around(
        "fast", cameras, NEAR, FAR, resolution=32, table_log2=10, precision=precision
    )
    assert isinstance(model, GridField)
    assert model.config.half is half
    record = fit(model, RayBuffer(photos, 0), steps=30, batch_rays=256, seed=0, log_every=10)
    assert record.rows[-1][2] > record.rows[0][2] + 0.5


def _keeps_tiny() -> bool:
    return bool(torch.full((1,), 1e-39).mul(1.0) > 0.0)


@pytest.mark.parametrize("threads", [1, 2])
def test_numbers_too_small_to_be_normal_are_zero_in_a_fit_alone(
    photos: list[PosedPhoto], threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor keeps them")
    torch.set_flush_denormal(False)
    kept, loss = list[bool](), GridField.loss

    def watched(*args: Any, **how: Any) -> Any:
        kept.append(_keeps_tiny())
        return loss(*args, **how)

    monkeypatch.setattr(GridField, "loss", watched)
    fit(field(photos), RayBuffer(photos, 0), steps=2, batch_rays=64, seed=0, threads=threads)
    assert kept == [False] * 4 and _keeps_tiny()


@pytest.mark.parametrize("as_table", [False, True])
def test_steps_are_those_of_adamw(as_table: bool) -> None:
    """With decay, and for a parameter that has no gradient in some steps; a table's gradient is cleared."""
    start = [torch.randn(7, 3, generator=torch.Generator().manual_seed(i)) for i in range(2)]
    ours, theirs = ([torch.nn.Parameter(one.clone()) for one in start] for _ in range(2))
    part = Part("both", ("a", "b"), 1e-2, 0.1, (0.8, 0.95), 1e-9, decay=0.3)
    stepper = Stepper(part, ours, steps=6)
    adam = torch.optim.AdamW(theirs, betas=part.betas, eps=part.eps, weight_decay=part.decay)
    for step in range(6):
        a, b = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(9 + step))
        gradients = [a, None if step == 2 else b]
        if as_table:
            stepper.step(step, [stepper.room("a").copy_(a), gradients[1]])
            assert not stepper.room("a").any()
        else:
            stepper.step(step, gradients)
        adam.param_groups[0]["lr"] = stepper.rate_at(step)
        for parameter, gradient in zip(theirs, gradients, strict=True):
            parameter.grad = gradient
        adam.step()
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-7)


def test_the_rate_rises_in_the_warm_up_or_a_twentieth_of_a_short_fit_and_falls_exponentially() -> (
    None
):
    part = Part("one", ("a",), 0.5, 0.01, warmup=50)
    for steps, rising in ((2000, 50), (400, 20), (10, 0)):
        stepper = Stepper(part, [torch.nn.Parameter(torch.ones(1))], steps, rate=2.0)
        found = np.array([stepper.rate_at(step) for step in range(steps + 1)])
        falling = 0.01 ** (np.arange(steps + 1) / steps)
        rise = np.minimum(1.0, (np.arange(steps + 1) + 1) / max(rising, 1))
        np.testing.assert_allclose(found, falling * rise, rtol=1e-12)


def test_a_fit_does_not_load_the_compiler_of_torch() -> None:
    """That takes a second or two at the start of every fit, and nothing compiles."""
    code = (
        "import sys, torch; from pipeline.field.base import Part; "
        "from pipeline.field.steppers import Stepper; "
        "one = torch.nn.Parameter(torch.ones(2)); "
        "Stepper(Part('a', ('a',), 1e-2, 0.1), [one], 1).step(0, [torch.ones(2)]); "
        "assert one[0] < 1 and 'torch._dynamo' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_half_precision_is_for_where_products_are_what_takes_time() -> None:
    assert not half_is_fast("fast", "cuda")
    assert not half_is_fast("paper", "cpu")


def test_cameras_all_around_get_as_fine_a_grid_and_more_samples() -> None:
    class Camera:
        width, height, intrinsics = 400, 300, (350.0, 350.0, 200.0, 150.0, 0.0)

        def __init__(self, angle: float) -> None:
            # Around the y axis, four units from it, looking at it.
            c, s = np.cos(angle), np.sin(angle)
            self.cam_from_world = np.array(
                [[c, 0, -s, 0], [0, 1, 0, 0], [s, 0, c, 4], [0, 0, 0, 1]]
            )

    cameras = [Camera(angle) for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False)]
    config = {"samples": 16, "table_log2": 10, "decay": 0.1}
    model = build_around("fast", cameras, 2.0, 1e6, resolution=768, **config)
    assert isinstance(model, GridField)
    assert model.space.kind == "contract"
    assert model.config.decay > 0.1
    assert build_around("fast", cameras, 2.0, 1e6, table_log2=10, decay=0.0).config.decay == 0.0
    assert model.config.samples == 32
    assert model.config.bins == 64
    # A pixel is 4/350 wide where they look; the unit ball reaches to the cameras.
    step = (model.space.high[0] - model.space.low[0]) * 4.0 / (model.config.fine[0] - 1)
    assert 1.0 < 4.0 / 350.0 / step < 3.0


def test_a_loss_that_is_not_finite_stops_with_step_and_knob(photos: list[PosedPhoto]) -> None:
    model = field(photos)
    with torch.no_grad():
        model.colour_out.bias.fill_(float("nan"))
    with pytest.raises(UserError, match="near step 4") as caught:
        fit(model, RayBuffer(photos, 0), steps=20, batch_rays=256, seed=0, log_every=5)
    knobs = re.findall(r"nerf\.(\w+)", caught.value.hint)
    known = yaml.safe_load((ROOT / "params.yaml").read_text())["nerf"]
    assert knobs and all(knob in known for knob in knobs)
