"""Trains a drop remover, AttGAN, Quan or Wen, from painted, rendered and photographed pairs."""

from __future__ import annotations

from functools import partial
from types import ModuleType
from typing import Annotated, Literal, get_args

import torch
from pydantic import Field
from tqdm import tqdm

from pipeline.attention import pools
from pipeline.attention.training import attention_loss
from pipeline.attention.weights import load_network
from pipeline.io import checkpoints
from pipeline.io.atomic import write_csv
from pipeline.io.paths import ScenePaths
from pipeline.parallel import map_named
from pipeline.removal import clips, store
from pipeline.removal.losses import PerceptualLoss
from pipeline.removal.recipes import Added, recipe_of
from pipeline.removal.samples import Pairs
from pipeline.removal.training import CURVE, Plan, Trainer, curve_rows, fit
from pipeline.stage import Job, Section, run

Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]
Method = Literal["attgan", "quan", "wen"]


class Params(Section):
    """Section `train_remover`."""

    folder: str
    seed: Annotated[int, Field(ge=0)]
    photos: str
    painted: Count
    clips: Count
    rendered: list[str]
    photo_pairs: list[str]
    shares: tuple[Share, Share, Share]
    validation: Count
    validation_photos: str
    validate_every: Count
    bfloat16: bool
    on_device: bool
    perceptual: str
    attention: str
    train_attention: bool
    attention_steps: Annotated[int, Field(ge=1, le=8)]
    published_edges: bool
    single_share: Share
    added: Added
    attgan: Plan
    quan: Plan
    wen: Plan


def main(chosen: dict[str, Method], job: Job, params: Params) -> str:
    """Writes the weights of the chosen method, and beside them the curve over unseen photos as CSV."""
    method = chosen["method"]
    trainer = _trainer(job, params, method)
    room, name = (clips, "clips") if method == "wen" else (pools, "painted")
    unseen = _painted(job, room, params.validation_photos, params.seed + 1, params.validation)
    told = params.model_dump(exclude={"folder", "attgan", "quan", "wen"} - {method})
    named = filter(None, (params.attention, params.perceptual, params.photos, *params.rendered,
                          *params.photo_pairs, params.validation_photos))  # fmt: skip
    key = checkpoints.training_key(told, map(job.resolve, named), "attention", "drops", "removal")
    checkpoint = (work := job.paths.work("train_remover")) / f"{method}-{key}.pt"
    rows = checkpoints.load_checkpoint(checkpoint, trainer)
    with tqdm(total=trainer.total, initial=trainer.done, unit="step") as bar:

        def on_score(loss: float, found: dict[str, tuple[float, float]]) -> None:
            bar.update(trainer.done - bar.n)
            rows.extend(curve_rows(trainer.done, loss, found))
            bar.write(" ".join(f"{each} {a:.2f} -> {b:.2f} dB" for each, (a, b) in found.items()))
            checkpoints.save_checkpoint(checkpoint, trainer, rows)
            store.save_remover(work / f"{method}.safetensors", trainer.average, method)

        mean = fit(trainer, params.validate_every, {name: Pairs(*unseen)}, on_score)
    store.save_remover(target := job.resolve(params.folder) / f"{method}.safetensors", mean, method)
    write_csv(target.with_suffix(".csv"), CURVE, rows)
    return f"{target.name}: {rows[-1][3]} -> {rows[-1][4]} dB on pictures it was not trained on"


def _trainer(job: Job, params: Params, method: Method) -> Trainer:
    attention = (load_network(job.resolve(params.attention), named_by="train_remover.attention")
                 if method == "attgan" else None)  # fmt: skip
    recipe = recipe_of(method, params.seed, attention=attention, map_loss=attention_loss,
                       train_attention=params.train_attention, steps=params.attention_steps,
                       published_edges=params.published_edges, added=params.added)  # fmt: skip
    backbone = PerceptualLoss(job.resolve(params.perceptual), method) if params.perceptual else None
    recipe.to(job.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    made = _painted(job, pools, params.photos, params.seed, params.painted)
    rendered = pools.together([pools.read_rendered(job.resolve(path)) for path in params.rendered])
    given = pools.together([pools.read_photo_pairs(job.resolve(p)) for p in params.photo_pairs])
    pairs = [Pairs(*part, share) for part, share in zip((made, rendered, given), params.shares, strict=True)
             if part[0] and share > 0]  # fmt: skip
    plan: Plan = getattr(params, method)
    moving = any(phase.kind == "clips" for phase in plan.phases)
    shots = [_painted(job, clips, params.photos, params.seed, params.clips)] if moving else []
    settings = params.model_dump(include={"seed", "bfloat16", "single_share", "on_device"})
    return Trainer(recipe, pairs, [Pairs(*s) for s in shots], plan, perceptual=backbone, **settings)


def _painted(job: Job, room: ModuleType, folder: str, seed: int, count: int) -> pools.Pictures:
    """Pictures (room: pools) or clips on the photos of a folder and procedural ones, made where missing."""
    photos = pools.list_pictures(job.resolve(folder)) if folder else ()
    work = ScenePaths(job.root, job.scene).work("train_remover")  # the same for all variants
    chunks = room.painted_chunks(work, seed, count, photos)
    map_named(room.paint_chunk, chunks, job_label="painting")
    return pools.together([room.read_chunk(chunk[0]) for chunk in chunks.values()], count)


if __name__ == "__main__":
    wish: dict[str, Method] = {}
    run("train_remover", Params, partial(main, wish),
        add_flags=lambda parser: parser.add_argument("--method", choices=get_args(Method), required=True),  # type: ignore[arg-type]
        before=lambda _, flags: wish.update(method=flags.method))  # fmt: skip
