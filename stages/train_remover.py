"""Trains a drop remover, AttGAN, Quan or Wen, from painted, rendered and photographed pairs."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal, get_args

import torch
from pydantic import Field
from tqdm import tqdm

from pipeline.attention import pools
from pipeline.attention.training import attention_loss
from pipeline.attention.weights import load_network
from pipeline.io.atomic import write_text
from pipeline.io.weights import read_state
from pipeline.parallel import map_named
from pipeline.removal import clips, recipes, store
from pipeline.removal.losses import PerceptualLoss
from pipeline.removal.samples import Pairs
from pipeline.removal.training import Phase, Settings, Trainer, curve_rows, curve_text, fit
from pipeline.stage import Job, Section, run

Share = Annotated[float, Field(ge=0, le=1)]
Method = Literal["attgan", "quan", "wen"]


class PhaseParams(Section):
    """One stretch of training; see training.Phase."""

    kind: Literal["carry", "pairs", "clips"]
    iterations: Annotated[int, Field(ge=1)]
    batch: Annotated[int, Field(ge=1, le=64)]
    crop: Annotated[int, Field(ge=16, le=512)]
    rate: Annotated[float, Field(gt=0, le=1)]
    power: Annotated[float, Field(ge=0, le=4)] | None


class MethodParams(Section):
    """One remover's recipe; see training.Settings."""

    betas: tuple[Share, Share]
    adversarial: Annotated[float, Field(ge=0, le=10)]
    critic_rate: Annotated[float, Field(gt=0, le=1)]
    phases: Annotated[list[PhaseParams], Field(min_length=1)]


class Params(Section):
    """Section `train_remover`."""

    folder: str
    seed: Annotated[int, Field(ge=0)]
    photos: str
    painted: Annotated[int, Field(ge=pools.CHUNK, multiple_of=pools.CHUNK)]
    clips: Annotated[int, Field(ge=clips.CHUNK, multiple_of=clips.CHUNK)]
    rendered: list[str]
    photo_pairs: list[str]
    shares: tuple[Share, Share, Share]
    validation: Annotated[int, Field(ge=1, le=clips.CHUNK)]
    validation_photos: str
    validation_rendered: list[str]
    validate_every: Annotated[int, Field(ge=1)]
    bfloat16: bool
    perceptual: str
    attention: str
    train_attention: bool
    attention_steps: Annotated[int, Field(ge=1, le=8)]
    published_edges: bool
    single_share: Share
    attgan: MethodParams
    quan: MethodParams
    wen: MethodParams


def main(chosen: dict[str, Method], job: Job, params: Params) -> str:
    """Writes the weights of the chosen method, and beside them the validation curve as CSV."""
    method = chosen["method"]
    trainer = _trainer(job, params, method)
    validation = _validation(job, params, method)
    others = {"attgan", "quan", "wen"} - {method}
    files = [job.resolve(path) if path else None for path in (params.attention, params.perceptual)]
    key = store.training_key(params.model_dump(exclude={"folder", *others}), *files)
    work = job.paths.work("train_remover")
    checkpoint = work / f"{method}-{key}.pt"
    rows = store.load_checkpoint(checkpoint, trainer)
    with tqdm(total=trainer.total, initial=trainer.done, unit="step") as bar:

        def on_score(loss: float, found: dict[str, tuple[float, float]]) -> None:
            bar.update(trainer.done - bar.n)
            rows.extend(curve_rows(trainer.done, loss, found))
            bar.write(" ".join(f"{name} {a:.2f} -> {b:.2f} dB" for name, (a, b) in found.items()))
            store.save_checkpoint(checkpoint, trainer, rows)
            store.save_remover(work / f"{method}.safetensors", trainer.average, method)

        average = fit(trainer, validate_every=params.validate_every, validation=validation,
                      on_score=on_score)  # fmt: skip
    target = job.resolve(params.folder) / f"{method}.safetensors"
    store.save_remover(target, average, method)
    write_text(target.with_suffix(".csv"), curve_text(rows))
    return f"{target.name}: {rows[-1][3]} -> {rows[-1][4]} dB on {rows[-1][2]} pictures it was not trained on"


def _trainer(job: Job, params: Params, method: Method) -> Trainer:
    recipe: recipes.AnyRecipe
    if method == "attgan":
        recipe = recipes.AttganRecipe(load_network(job.resolve(params.attention)), attention_loss,
                                      train_attention=params.train_attention,
                                      steps=params.attention_steps)  # fmt: skip
    elif method == "quan":
        recipe = recipes.QuanRecipe(published_edges=params.published_edges)
    else:
        recipe = recipes.WenRecipe()
    recipe.begin(params.seed)
    own: MethodParams = getattr(params, method)
    critic = recipes.critic_of(recipe, params.seed) if own.adversarial > 0 else None
    perceptual = None
    if params.perceptual:
        file = job.resolve(params.perceptual)
        perceptual = PerceptualLoss(read_state(file), 19 if method == "wen" else 16, str(file))
    for network in (recipe, critic, perceptual):
        if network is not None:
            network.to(job.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    settings = Settings(params.seed, own.betas, params.bfloat16, own.adversarial, own.critic_rate,
                        params.single_share)  # fmt: skip
    phases = [Phase(**phase.model_dump()) for phase in own.phases]
    moving = any(phase.kind == "clips" for phase in phases)
    pictures = _painted(job, params.photos, params.seed, params.painted)
    rendered = pools.together([pools.read_rendered(job.resolve(path)) for path in params.rendered])
    photographed = pools.together(
        [pools.read_photo_pairs(job.resolve(p)) for p in params.photo_pairs]
    )
    pairs = [Pairs(*part, share=share) for part, share
             in zip((pictures, rendered, photographed), params.shares, strict=True) if part[0] and share]  # fmt: skip
    shots = [_clips(job, params.photos, params.seed, params.clips)] if moving else []
    return Trainer(recipe, pairs, shots, phases, settings, critic, perceptual)


def _validation(job: Job, params: Params, method: Method) -> dict[str, Pairs]:
    """Pictures on other photos and of other places than those that are trained on."""
    if method == "wen":
        return {"clips": _clips(job, params.validation_photos, params.seed + 1, params.validation)}
    painted = _painted(job, params.validation_photos, params.seed + 1, params.validation)
    folders = [job.resolve(path) for path in params.validation_rendered]
    return {
        **{path.name: Pairs(*pools.read_rendered(path)) for path in folders},
        "painted": Pairs(*painted),
    }


def _painted(job: Job, folder: str, seed: int, count: int) -> pools.Pictures:
    photos = pools.list_pictures(job.resolve(folder)) if folder else ()
    work = job.paths.work("train_remover") / pools.painted_name(seed, photos)
    chunks = {f"{k:04d}": (work / f"{k:04d}.npy", seed, k, photos)
              for k in range(-(-count // pools.CHUNK))}  # fmt: skip
    map_named(pools.paint_chunk, chunks, job_label="painting")
    return pools.together([pools.read_chunk(chunk[0]) for chunk in chunks.values()], count)


def _clips(job: Job, folder: str, seed: int, count: int) -> Pairs:
    photos = pools.list_pictures(job.resolve(folder)) if folder else ()
    work = job.paths.work("train_remover") / clips.clips_name(seed, photos)
    chunks = {f"{k:04d}": (work / f"{k:04d}.npy", seed, k, photos)
              for k in range(-(-count // clips.CHUNK))}  # fmt: skip
    map_named(clips.paint_chunk, chunks, job_label="painting")
    return clips.read_chunks([chunk[0] for chunk in chunks.values()], count)


if __name__ == "__main__":
    wish: dict[str, Method] = {}
    run("train_remover", Params, partial(main, wish),
        add_flags=lambda parser: parser.add_argument("--method", choices=get_args(Method), required=True),
        before=lambda _, flags: wish.update(method=flags.method))  # fmt: skip
