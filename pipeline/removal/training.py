"""Fits a remover to pairs of rainy and dry pictures."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.errors import UserError
from pipeline.geometry.crops import resident
from pipeline.io.processor import multiplies_bfloat16
from pipeline.removal.critics import Critic
from pipeline.removal.recipes import AnyRecipe, Outcome, check_crop, critic_of
from pipeline.removal.samples import Batch, Pairs, draw_batch, draw_resident

# Columns of the validation curve; see `curve_rows`.
CURVE = ("iteration", "loss", "set", "psnr_rainy", "psnr")
EMA_DECAY = 0.998
WARM = 20  # iterations at the start of a phase in which the rate rises


@dataclass(frozen=True)
class Phase:
    """A stretch of training.

    kind: `pairs` of single pictures, `clips` of several frames, or `carry`: the rainy picture is to
    come out unchanged. rate: Adam's at its start; it falls along a half cosine to a twentieth, or
    along (1 - progress)^power where a power is given (0: it stays).
    """

    kind: Literal["carry", "pairs", "clips"]
    iterations: int
    batch: int
    crop: int
    rate: float
    power: float | None

    __pydantic_config__: ClassVar = {"extra": "forbid", "allow_inf_nan": False}  # of params.yaml

    def __post_init__(self) -> None:
        if min(self.iterations, self.batch, self.crop) < 1 or not 0 < self.rate <= 1:
            raise ValueError("iterations, batch and crop start at 1, the rate lies in (0, 1]")
        if self.power is not None and self.power < 0:
            raise ValueError("a rate that falls as a power has one of 0 or more")


@dataclass(frozen=True)
class Plan:
    """One remover's training: Adam's betas, how many times the published weight the discriminator's
    verdict has (0: none is trained), Adam's rate for the discriminator, and the phases.
    """

    betas: tuple[float, float]
    adversarial: float
    critic_rate: float
    phases: list[Phase]

    __pydantic_config__: ClassVar = {"extra": "forbid", "allow_inf_nan": False}  # of params.yaml

    def __post_init__(self) -> None:
        if not all(0 <= beta < 1 for beta in self.betas) or not self.phases:
            raise ValueError("betas lie in [0, 1), and there is at least one phase")
        if self.adversarial < 0 or self.critic_rate <= 0:
            raise ValueError("adversarial is 0 or more, critic_rate above 0")


class Trainer:
    """A fit under way: the remover, its running average, its optimisers and how far it is.

    Every batch, and what dropout leaves out, is drawn from generators seeded with (seed, phase,
    iteration), so a fit that was interrupted and goes on from `state()` ends like one that was not.
    single_share: of the iterations with clips, how many look at five times as many single pictures
    instead. bfloat16: products in half precision, about twice as fast, where the device multiplies them itself.
    on_device: all pictures are kept where the recipe computes, and crops are cut there.
    """

    def __init__(
        self, recipe: AnyRecipe, pairs: Sequence[Pairs], clips: Sequence[Pairs], plan: Plan,
        *, seed: int, bfloat16: bool = False, single_share: float = 0.0,
        perceptual: nn.Module | None = None, on_device: bool = False,
    ) -> None:  # fmt: skip
        _check(recipe, pairs, clips, plan, single_share)
        self.recipe, self.pairs, self.clips = recipe, pairs, clips
        where = str(_device(recipe)) if on_device else None
        self.stacks = [resident(pools, where) for pools in (pairs, clips)] if where else []
        self.plan, self.phases, self.seed = plan, plan.phases, seed
        self.bfloat16 = bfloat16 and multiplies_bfloat16(_device(recipe).type)
        self.single_share, self.perceptual = single_share, perceptual
        self.critic = critic_of(recipe, seed) if plan.adversarial > 0 else None
        self.phase = self.iteration = self.done = 0
        self.average = copy.deepcopy(recipe).eval()
        learnt = [each for each in recipe.parameters() if each.requires_grad]
        self.optimisers = [torch.optim.Adam(learnt, lr=1.0, betas=plan.betas)]
        if perceptual is not None:
            perceptual.to(_device(recipe))
        if self.critic is not None:
            self.critic.to(_device(recipe))
            judging = self.critic.parameters()
            self.optimisers.append(torch.optim.Adam(judging, plan.critic_rate, plan.betas))

    @property
    def total(self) -> int:
        """The iterations of all phases."""
        return sum(phase.iterations for phase in self.phases)

    @property
    def finished(self) -> bool:
        return self.phase >= len(self.phases)

    def advance(self) -> float:
        """One iteration; its loss, without the discriminator's part."""
        phase = self.phases[self.phase]
        rng = np.random.default_rng([self.seed, self.phase, self.iteration])
        torch.manual_seed(int(rng.integers(2**31)))
        batch = self._draw(phase, rng)
        self.recipe.train()
        if phase.kind == "carry":
            with self._precision():
                loss = self.recipe.carry(batch)
            self._apply(loss, phase)
        else:
            with self._precision():
                outcome = self.recipe.outcome(batch, self.perceptual)
            loss = outcome.loss
            # Wen's discriminator looks at five frames: single pictures pass it by.
            critic = None if self.recipe.clips and batch.rainy.shape[1] == 1 else self.critic
            if critic is None:
                self._apply(loss, phase)
            else:
                fooled = critic.fooled(outcome.fake)
                self._apply(loss + self.plan.adversarial * critic.weight * fooled, phase)
                self._judge(critic, outcome)
        self.iteration, self.done = self.iteration + 1, self.done + 1
        if self.iteration >= phase.iterations:
            self.phase, self.iteration = self.phase + 1, 0
        return float(loss.detach())

    def _draw(self, phase: Phase, rng: np.random.Generator) -> Batch:
        moving, count = phase.kind == "clips", phase.batch
        if moving and rng.random() < self.single_share:
            moving, count = False, 5 * count
        if self.stacks:
            return draw_resident(self.stacks[moving], rng, count, phase.crop)
        pools, device = self.clips if moving else self.pairs, _device(self.recipe)
        return Batch(*(part.to(device) for part in draw_batch(pools, rng, count, phase.crop)))

    def _precision(self) -> torch.autocast:
        device = _device(self.recipe).type
        return torch.autocast(device, torch.bfloat16, enabled=self.bfloat16)

    def _apply(self, loss: Tensor, phase: Phase) -> None:
        optimiser = self.optimisers[0]
        for group in optimiser.param_groups:
            group["lr"] = rate_at(phase, self.iteration)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.recipe.parameters(), 1.0)
        optimiser.step()
        decay = min(EMA_DECAY, (self.done + 1) / (self.done + 10))
        new = self.recipe.state_dict()
        with torch.no_grad():
            for name, kept in self.average.state_dict().items():
                kept.lerp_(new[name], 1 - decay)

    def _judge(self, critic: Critic, outcome: Outcome) -> None:
        """The discriminator's own step."""
        self.optimisers[1].zero_grad()
        loss = critic.loss(outcome.fake.detach(), outcome.real, outcome.attention)
        loss.backward()
        self.optimisers[1].step()

    def state(self) -> dict[str, Any]:
        """All that `restore` needs to go on from here: tensors and numbers."""
        return {
            "recipe": self.recipe.state_dict(),
            "average": self.average.state_dict(),
            "critic": self.critic.state_dict() if self.critic is not None else {},
            "optimisers": [optimiser.state_dict() for optimiser in self.optimisers],
            "where": [self.phase, self.iteration, self.done],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes back to what `state()` returned."""
        self.recipe.load_state_dict(state["recipe"])
        self.average.load_state_dict(state["average"])
        if self.critic is not None:
            self.critic.load_state_dict(state["critic"])
        for optimiser, saved in zip(self.optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(saved)
        self.phase, self.iteration, self.done = state["where"]

    def score(self, pool: Pairs) -> tuple[float, float]:
        """Mean PSNR (dB) over a pool, of the rainy pictures and of the restored ones.

        Computed as in training, in half precision where that is asked for; sides are cut to what
        the network reads. Of a clip the middle frame counts.
        """
        found = []
        for index in range(len(pool.rainy)):
            rainy, clean = (
                _whole(part[index], self.recipe.multiple) for part in (pool.rainy, pool.clean)
            )
            device = _device(self.recipe)
            with torch.inference_mode(), self._precision():
                restored = self.average.restored(rainy.to(device)).float().clamp(0, 1).cpu()
            middle = rainy.shape[1] // 2
            found.append([psnr(each, clean[:, middle]) for each in (rainy[:, middle], restored)])
        before, after = np.mean(found, axis=0)
        return float(before), float(after)


def rate_at(phase: Phase, iteration: int) -> float:
    """Adam's learning rate at an iteration of a phase."""
    warm, progress = min(1.0, (iteration + 1) / WARM), iteration / phase.iterations
    if phase.power is not None:
        return phase.rate * warm * (1 - progress) ** phase.power
    return phase.rate * warm * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress)))


def psnr(found: Tensor, wanted: Tensor) -> float:
    """In dB, of pictures in [0,1]; 99 at most, for equal ones."""
    return float(-10 * torch.log10((found - wanted).square().mean().clamp_min(10**-9.9)))


def _whole(picture: np.ndarray, multiple: int) -> Tensor:
    frames = picture if picture.ndim == 4 else picture[None]
    height, width = (length // multiple * multiple for length in frames.shape[1:3])
    planes = frames[:, :height, :width].transpose(0, 3, 1, 2)
    return torch.from_numpy(np.ascontiguousarray(planes, np.float32))[None] / 255


def _device(recipe: nn.Module) -> torch.device:
    return next(recipe.parameters()).device


def _check(
    recipe: AnyRecipe, pairs: Sequence[Pairs], clips: Sequence[Pairs],
    plan: Plan, single_share: float,
) -> None:  # fmt: skip
    """UserError for a plan that this recipe cannot follow with these pictures."""
    for phase in plan.phases:
        check_crop(recipe, phase.crop, plan.adversarial > 0)
        moving = phase.kind == "clips"
        if moving and not recipe.clips:
            raise UserError(
                "Only wen looks at several frames; the others learn from pairs.",
                "Set the kind of the phase to pairs under train_remover.",
            )
        if moving and not clips:
            raise UserError("There are no clips to train on.", "Give some under train_remover.")
        if not pairs and (not moving or single_share > 0):
            raise UserError(
                "There are no pairs to train on.",
                "Give some under train_remover, and a share of them above 0.",
            )


def curve_rows(
    done: int, loss: float, found: Mapping[str, tuple[float, float]]
) -> list[list[float | str]]:
    """Rows of the validation curve, one per set of pictures; columns: CURVE."""
    return [
        [done, round(loss, 6), name, round(before, 3), round(after, 3)]
        for name, (before, after) in found.items()
    ]


def fit(
    trainer: Trainer,
    validate_every: int,
    validation: Mapping[str, Pairs],
    on_score: Callable[[float, dict[str, tuple[float, float]]], None],
) -> nn.Module:
    """The running average of the remover after all phases.

    on_score(mean loss since the last call, PSNR before and after per validation pool) is called
    every `validate_every` iterations and at the end of each phase: there a checkpoint is written.
    UserError once the loss is no number, which it stays.
    """
    losses: list[float] = []
    while not trainer.finished:
        losses.append(trainer.advance())
        if not math.isfinite(losses[-1]):
            raise UserError(
                f"The training broke down near step {trainer.done}.",
                "Lower the rate of the phase under train_remover.",
            )
        if trainer.iteration % validate_every == 0:  # 0 after the last one of a phase, too
            found = {name: trainer.score(pool) for name, pool in validation.items()}
            on_score(float(np.mean(losses)), found)
            losses = []
    return trainer.average
