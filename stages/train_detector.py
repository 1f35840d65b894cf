"""Trains the drop detector of `weights/` from painted, rendered and photographed pairs."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from pathlib import Path
from typing import Annotated

import torch
from pydantic import Field
from tqdm import tqdm

from pipeline.attention.network import AttentiveRecurrentNet, load_network
from pipeline.attention.pools import (
    CHUNK,
    Pictures,
    paint_chunk,
    read_chunk,
    read_photo_pairs,
    read_rendered,
)
from pipeline.attention.samples import Pool
from pipeline.attention.training import Phase, Score, Trainer, fit, initialise
from pipeline.errors import UserError
from pipeline.io.atomic import write_bytes, write_text
from pipeline.io.tensors import save_tensors
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

    weights: Annotated[str, Field(pattern=r"\.safetensors$")]
    start: str
    seed: Annotated[int, Field(ge=0)]
    painted: Annotated[int, Field(ge=CHUNK, multiple_of=CHUNK)]
    validation: Annotated[int, Field(ge=1, le=CHUNK)]
    rendered: list[str]
    photo_pairs: list[str]
    shares: tuple[float, float, float]
    clean_share: Annotated[float, Field(ge=0, le=1)]
    validate_every: Annotated[int, Field(ge=1)]
    phases: Annotated[list[PhaseParams], Field(min_length=1)]


def main(job: Job, params: Params) -> str:
    """Writes the weights, and beside them the validation curve as CSV."""
    start = job.resolve(params.start) if params.start else None
    network = load_network(start) if start else AttentiveRecurrentNet()
    if start is None:
        initialise(network, params.seed)
    pools, validation = _pools(job, params)
    phases = [Phase(**phase.model_dump()) for phase in params.phases]
    trainer = Trainer(
        network.to(job.device), pools, phases, seed=params.seed, clean_share=params.clean_share
    )
    checkpoint = job.paths.work("train_detector") / f"{_key(params, start)}.pt"
    rows = _resume(checkpoint, trainer)
    total = sum(phase.iterations for phase in phases)
    with tqdm(total=total, initial=trainer.done, unit="step") as bar:

        def on_score(done: int, steps: int, loss: float, score: Score) -> None:
            bar.update(done - bar.n)
            bar.set_postfix(f1=f"{score.f1:.3f}")
            figures = (loss, score.mse, score.precision, score.recall, score.f1)
            rows.append([done, steps, *(round(figure, 6) for figure in figures)])
            buffer = io.BytesIO()
            torch.save({"trainer": trainer.state(), "rows": rows}, buffer)
            write_bytes(checkpoint, buffer.getvalue())

        average = fit(
            trainer,
            validate_every=params.validate_every,
            validation=validation,
            on_score=on_score,
        )
    target = job.resolve(params.weights)
    save_tensors(target, {k: v.cpu() for k, v in average.state_dict().items()})
    _write_curve(target.with_suffix(".csv"), rows)
    return f"{target.name}: F1 {rows[-1][-1]:.3f} on {params.validation} painted pictures"


def _key(params: Params, start: Path | None) -> str:
    """Names what a checkpoint belongs to: parameters and starting weights."""
    told = json.dumps(params.model_dump(), sort_keys=True).encode()
    return hashlib.sha256(told + (start.read_bytes() if start else b"")).hexdigest()[:16]


def _resume(checkpoint: Path, trainer: Trainer) -> list[list[float]]:
    if not checkpoint.is_file():
        return []
    saved = torch.load(checkpoint, map_location="cpu", weights_only=True)
    trainer.restore(saved["trainer"])
    return saved["rows"]


def _write_curve(path: Path, rows: list[list[float]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["iteration", "steps", "loss", "mse", "precision", "recall", "f1"])
    writer.writerows(rows)
    write_text(path, text.getvalue())


def _pools(job: Job, params: Params) -> tuple[list[Pool], Pool]:
    """The pools to train on, and painted pictures of other seeds to validate on."""
    folder = job.paths.work("train_detector") / f"painted-{params.seed}"
    chunks = {f"{k:04d}": (folder / f"{k:04d}.npz", params.seed, k)
              for k in range(params.painted // CHUNK + 1)}  # fmt: skip
    map_named(paint_chunk, chunks, job_label="painting")
    *training, last = [read_chunk(path) for path, _, _ in chunks.values()]
    painted: Pictures = ([], [], [])
    rendered: Pictures = ([], [], [])
    photos: Pictures = ([], [], [])
    for chunk in training:
        _extend(painted, chunk)
    for path in params.rendered:
        _extend(rendered, read_rendered(job.resolve(path)))
    for path in params.photo_pairs:
        _extend(photos, read_photo_pairs(job.resolve(path)))
    pools = [Pool(pictures[0], pictures[1], pictures[2], share=share)
             for pictures, share in zip((painted, rendered, photos), params.shares, strict=True)
             if pictures[0] and share > 0]  # fmt: skip
    if not pools:
        raise UserError("There is nothing to train on.", "Raise train_detector.shares.")
    few = params.validation
    return pools, Pool(last[0][:few], last[1][:few], last[2][:few])


def _extend(into: Pictures, more: Pictures) -> None:
    for old, new in zip(into, more, strict=True):
        old.extend(new)


if __name__ == "__main__":
    run("train_detector", Params, main)
