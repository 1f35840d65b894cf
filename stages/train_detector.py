"""Trains a drop detector of `weights/` from painted, rendered and photographed pairs."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from pydantic import Field
from tqdm import tqdm

from pipeline.attention import pools
from pipeline.attention.samples import Pool
from pipeline.attention.training import CURVE, Score, Trainer, curve_rows, fit, phases_of, score
from pipeline.attention.weights import averaged, first_network, load_others, save_network
from pipeline.drops.pairs import KINDS, Kind
from pipeline.io.atomic import write_csv
from pipeline.io.checkpoints import load_checkpoint, save_checkpoint, training_key
from pipeline.io.paths import ScenePaths
from pipeline.parallel import map_named
from pipeline.stage import Job, Section, run


class PhaseParams(Section):
    """One stretch of training; see training.Phase."""

    steps: Annotated[int, Field(ge=1, le=8)]
    iterations: Annotated[int, Field(ge=1)]
    batch: Annotated[int, Field(ge=1, le=256)]
    crop: Annotated[int, Field(ge=16, le=256)]
    rate: Annotated[float, Field(gt=0, le=1)]


class Params(Section):
    """Section `train_detector`."""

    model: Literal["unet", "attentive"]
    weights: Annotated[str, Field(pattern=r"\.safetensors$")]
    start: str
    target: Literal["coverage", "difference"]
    seed: Annotated[int, Field(ge=0)]
    photos: str
    painted: Annotated[int, Field(ge=pools.CHUNK, multiple_of=pools.CHUNK)]
    veils: Annotated[int, Field(ge=0, multiple_of=pools.CHUNK)]
    films: Annotated[int, Field(ge=0, multiple_of=pools.CHUNK)]
    rendered: list[str]
    photo_pairs: list[str]
    shares: tuple[float, float, float]
    clean_share: Annotated[float, Field(ge=0, le=1)]
    lures: Annotated[float, Field(ge=0, le=1)]
    validation: Annotated[int, Field(ge=1, le=pools.CHUNK)]
    validation_photos: str
    validation_rendered: list[str]
    validate_every: Annotated[int, Field(ge=1)]
    bfloat16: bool
    on_device: bool
    phases: Annotated[list[PhaseParams], Field(min_length=1)]
    average: dict[str, Annotated[float, Field(gt=0, lt=1)]]


def main(job: Job, params: Params) -> str:
    """Writes the weights, and beside them the validation curve as CSV."""
    start = job.resolve(params.start) if params.start else None
    network = first_network(start, params.model, params.seed, named_by="train_detector.start")
    phases = phases_of(network, [phase.model_dump() for phase in params.phases])
    validation, training = _validation(job, params), _training(job, params)
    network.to(job.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    told = params.model_dump(include={"seed", "clean_share", "lures", "bfloat16", "on_device"})
    trainer = Trainer(network, training, phases, **told)
    others = load_others({job.resolve(p): s for p, s in params.average.items()}, params.model)
    named = filter(None, (params.start, params.photos, *params.rendered, *params.photo_pairs,
                          params.validation_photos, *params.validation_rendered))  # fmt: skip
    about = params.model_dump(exclude={"weights", "average"})
    key = training_key(about, map(job.resolve, named), "attention", "drops")
    rows = load_checkpoint(checkpoint := job.paths.work("train_detector") / f"{key}.pt", trainer)
    with tqdm(total=trainer.total, initial=trainer.done, unit="step") as bar:

        def on_score(done: int, steps: int, loss: float, found: dict[str, Score]) -> None:
            bar.update(done - bar.n)
            rows.extend(curve_rows(done, steps, loss, found))
            bar.write(" ".join(f"{name} F1 {each.f1:.3f}" for name, each in found.items()))
            save_checkpoint(checkpoint, trainer, rows)

        trained = fit(trainer, params.validate_every, validation, on_score)
    if others:
        trained = averaged(trained.cpu(), others)
        found = {name: score(trained, pool, phases[-1].steps) for name, pool in validation.items()}
        rows.extend(curve_rows(trainer.done, phases[-1].steps, float("nan"), found))
    save_network(target := job.resolve(params.weights), trained)
    write_csv(target.with_suffix(".csv"), CURVE, rows)
    return f"{target.name}: best F1 {rows[-1][7]} on {rows[-1][3]} pictures it was not trained on"


def _painted(job: Job, folder: str, seed: int, count: int, kind: Kind = "drops") -> pools.Pictures:
    """Painted pictures on the photos of a folder and on procedural ones, made where missing."""
    photos = pools.list_pictures(job.resolve(folder)) if folder else ()
    work = ScenePaths(job.root, job.scene).work("train_detector")  # the same for all variants
    chunks = pools.painted_chunks(work, seed, count, photos, kind)
    map_named(pools.paint_chunk, chunks, job_label="painting")
    return pools.together([pools.read_chunk(chunk[0]) for chunk in chunks.values()], count)


def _training(job: Job, params: Params) -> list[Pool]:
    counts = zip(KINDS, (params.painted, params.veils, params.films), strict=True)
    painted = [_painted(job, params.photos, params.seed, n, kind) for kind, n in counts]
    rendered = [pools.read_rendered(job.resolve(path)) for path in params.rendered]
    pairs = [pools.read_photo_pairs(job.resolve(path)) for path in params.photo_pairs]
    parts = [pools.aimed(pools.together(p), params.target) for p in (painted, rendered, pairs)]
    return pools.weighted(parts, params.shares)


def _validation(job: Job, params: Params) -> dict[str, Pool]:
    """Pictures of other seeds, photos and places than those that are trained on."""
    sets = pools.read_by_name([job.resolve(p) for p in params.validation_rendered], "painted")
    sets["painted"] = _painted(job, params.validation_photos, params.seed + 1, params.validation)
    return {name: Pool(*pools.aimed(pictures, params.target)) for name, pictures in sets.items()}


if __name__ == "__main__":
    run("train_detector", Params, main)
