"""A GPU gives what a CPU gives; a step recorded there is the step as it is.

What needs no GPU to be seen is also run on a CPU: the same steps, not recorded.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.field.buffer import PosedPhoto, RayBuffer
from pipeline.field.cuda_steps import CudaSteps
from pipeline.field.fit import fit
from pipeline.field.grid_field import GridConfig, GridField
from pipeline.field.model import describe, restore, scene_space
from pipeline.field.paper_field import PaperConfig, PaperField
from pipeline.field.render import render_view
from pipeline.field.steppers import Exposure, steppers_of
from pipeline.field.store import Checkpoint

sys.path.insert(0, str(Path(__file__).parent))
from scene import camera, photograph

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
SIZE, FOCAL, NEAR, FAR = (80, 60), 76.0, 2.5, 20.0
INTRINSICS = (FOCAL, FOCAL, 40.0, 30.0, 0.01)
SMALL: dict[str, Any] = {
    "levels": 4, "features": 4, "table_log2": 13, "coarse": (12, 10, 8), "fine": (96, 72, 16),
    "hidden": 32, "samples": 8, "bins": 16, "proposal": (24, 18, 16), "distortion": 0.002,
    "decay": 0.1,
}  # fmt: skip
HOW: dict[str, Any] = {"batch_rays": 512, "seed": 0}


@pytest.fixture(scope="module")
def photos() -> list[PosedPhoto]:
    out = []
    for i in range(8):
        pose = camera(i, 8)
        image, _ = photograph(pose, *SIZE, FOCAL)
        keep = np.ones(image.shape[:2], bool)
        keep[5:9, 5:9] = False
        out.append(PosedPhoto(f"{i}", image, keep, pose, INTRINSICS, NEAR, FAR))
    return out


def space_of(photos: list[PosedPhoto]) -> Any:
    count = len(photos)
    cams = np.stack([p.cam_from_world for p in photos])
    numbers = np.tile(INTRINSICS, (count, 1)), np.tile(SIZE, (count, 1))
    return scene_space("auto", cams, *numbers, NEAR, FAR)


def field(photos: list[PosedPhoto], **config: Any) -> GridField:
    return GridField(GridConfig(**SMALL | config), space_of(photos), 0)


def seen(model: Any, photo: PosedPhoto, device: str) -> np.ndarray:
    pose = photo.cam_from_world
    return render_view(model, pose, INTRINSICS, SIZE, NEAR, FAR, device=device).rgb


def psnr(model: Any, photos: list[PosedPhoto], device: str) -> float:
    errors = [(seen(model, photo, device) - photo.image) ** 2 for photo in photos]
    return float(-10 * np.log10(np.mean(errors)))


def steps_on_cpu(photos: list[PosedPhoto], model: Any, count: int) -> list[float]:
    """The losses of the GPU's steps, taken on a CPU."""
    light = Exposure(len(photos))
    steppers = [one for module in (model, light) for one in steppers_of(module, count, 1.0)]
    take = CudaSteps(model, light, steppers, RayBuffer(photos, 0), 512, 0, False)
    return [float(take(step)[0]) for step in range(count)]


@pytest.mark.parametrize("plain", [True, False])
def test_the_steps_of_a_gpu_are_those_of_a_cpu(photos: list[PosedPhoto], plain: bool) -> None:
    """One shard on a CPU draws the same numbers: the same losses and parameters, to rounding."""
    models = [field(photos, trim=0.05) for _ in range(2)]
    for model in models:
        model.plain = plain
    losses = steps_on_cpu(photos, models[0], 12)
    record = fit(models[1], RayBuffer(photos, 0), steps=12, shards=1, exposure=True,
                 log_every=1, **HOW)  # fmt: skip
    assert losses == pytest.approx([row[1] for row in record.rows], rel=1e-6)
    for one, other in zip(models[0].parameters(), models[1].parameters(), strict=True):
        assert float((one - other).detach().norm() / other.detach().norm()) < 1e-2


def test_phases_tell_which_steps_do_the_same(photos: list[PosedPhoto]) -> None:
    plain, trimmed = field(photos), field(photos, trim=0.1)
    assert plain.phase(0) == plain.phase(199) == plain.phase(200) != plain.phase(201)
    assert trimmed.phase(198) != trimmed.phase(200) == trimmed.phase(202) != trimmed.phase(201)


@needs_gpu
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("record", [False, True])
def test_a_fit_on_the_gpu_reaches_what_the_cpu_reaches(
    photos: list[PosedPhoto], half: bool, record: bool
) -> None:
    found: dict[str, float] = {}
    for device in ("cpu", "cuda"):
        model = field(photos, half=half).to(device)
        fit(model, RayBuffer(photos[1:], 0, device), steps=400, average=0.2, record=record, **HOW)
        found[device] = psnr(model, photos[1:], device)
    assert found["cuda"] == pytest.approx(found["cpu"], abs=0.7), found


@needs_gpu
@pytest.mark.parametrize("kind", ["fast", "paper"])
def test_recorded_steps_are_the_steps_as_they_are(photos: list[PosedPhoto], kind: str) -> None:
    """To rounding: the order of a GPU's sums differs from run to run."""
    rows = []
    for record in (False, True):
        model: Any = field(photos, trim=0.05)
        if kind == "paper":
            model = PaperField(PaperConfig(width=64), space_of(photos), 0)
        rows.append(
            fit(model.to("cuda"), RayBuffer(photos, 0, "cuda"), steps=260, record=record,
                exposure=True, log_every=20, **HOW).rows
        )  # fmt: skip
    for one, other in zip(*rows, strict=True):
        assert one[0] == other[0]
        assert one[2] == pytest.approx(other[2], abs=0.3), rows
    assert rows[0][0][2] == pytest.approx(rows[1][0][2], abs=0.02)


@needs_gpu
def test_no_recording_fails(photos: list[PosedPhoto], caplog: pytest.LogCaptureFixture) -> None:
    fit(field(photos, trim=0.05).to("cuda"), RayBuffer(photos, 0, "cuda"), steps=220,
        exposure=True, **HOW)  # fmt: skip
    assert not caplog.records


@needs_gpu
@pytest.mark.parametrize("kind", ["fast", "paper"])
def test_a_view_is_that_of_the_cpu(photos: list[PosedPhoto], kind: str) -> None:
    if kind == "fast":
        model: Any = field(photos).to("cuda")
        fit(model, RayBuffer(photos, 0, "cuda"), steps=200, **HOW)
    else:
        model = PaperField(PaperConfig(width=64), space_of(photos), 0)
    tensors = {name: value.cpu().numpy() for name, value in model.state_dict().items()}
    views = [
        seen(restore(describe(model), tensors).to(device), photos[0], device)
        for device in ("cpu", "cuda")
    ]
    # A ray that grazes an edge may fall to either side of it.
    assert float(np.quantile(np.abs(views[0] - views[1]), 0.999)) < 1.0 / 255.0


@needs_gpu
@pytest.mark.parametrize("at", [40, 250])
def test_an_interrupted_fit_goes_on(photos: list[PosedPhoto], tmp_path: Path, at: int) -> None:
    """The same course within rounding; Adam's moments, the mean and the losses come back."""

    class Killed(Exception):
        pass

    how = {"steps": 300, "save_every": 30, "exposure": True, "average": 0.3, **HOW}
    checkpoint = Checkpoint(tmp_path / "checkpoint.safetensors", "key")
    whole, dying, later = (field(photos).to("cuda") for _ in range(3))
    first = fit(whole, RayBuffer(photos, 0, "cuda"), **how)
    fatal = RayBuffer(photos, 0, "cuda")
    draw = fatal.pixels

    def pixels(step: int, size: int) -> torch.Tensor:
        if step == at:
            raise Killed
        return draw(step, size)

    fatal.pixels = pixels  # type: ignore[method-assign]
    with pytest.raises(Killed):
        fit(dying, fatal, save=checkpoint.save, **how)
    resume = checkpoint.load("cuda")
    assert resume is not None and resume[0] == at // 30 * 30
    second = fit(later, RayBuffer(photos, 0, "cuda"), resume=resume, **how)
    assert [row[0] for row in first.rows] == [row[0] for row in second.rows]
    assert psnr(later, photos, "cuda") == pytest.approx(psnr(whole, photos, "cuda"), abs=0.3)
