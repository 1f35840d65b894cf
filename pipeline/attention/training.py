"""Fits a detector to pools of rainy pictures with known coverage."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.attention.muon import Muon
from pipeline.attention.network import AttentiveRecurrentNet
from pipeline.attention.resident import draw_resident
from pipeline.attention.samples import VISIBLE_COVERAGE, Pool, draw_batch, wetness
from pipeline.attention.unet import DropUNet
from pipeline.attention.weights import Detector
from pipeline.errors import UserError
from pipeline.geometry.crops import resident
from pipeline.io.processor import multiplies_bfloat16

THETA = 0.8
# Columns of the validation curve; see `curve_rows`.
CURVE = ("iteration", "steps", "loss", "set", "threshold", "precision", "recall", "f1", "iou")
EMA_DECAY = 0.995
THRESHOLDS = np.arange(2, 20) / 20


@dataclass(frozen=True)
class Phase:
    """A stretch of training at one number of recurrent steps.

    rate: Muon's learning rate at its start, lowered along a half cosine to a twentieth.
    """

    steps: int
    iterations: int
    batch: int
    crop: int
    rate: float


@dataclass(frozen=True)
class Score:
    """A detector against true coverage > 0.05, its maps cut at `threshold`; all in [0,1]."""

    threshold: float
    precision: float
    recall: float
    f1: float
    iou: float


def attention_loss(
    maps: Sequence[Tensor], target: Tensor, weight: Tensor | None = None, theta: float = THETA
) -> Tensor:
    """The paper's loss over the N steps: sum of theta^(N-t) MSE(A_t, M), t = 1..N.

    maps: N raw maps (B,1,H,W); target and the pixels' weight: the same shape.
    Source: Qian et al., CVPR 2018, eq. 3.
    """
    total = torch.zeros((), device=target.device)
    share = torch.ones_like(target) if weight is None else weight
    for step, found in enumerate(maps, start=1):
        error = ((found - target).square() * share).mean()
        total = total + theta ** (len(maps) - step) * error
    return total


def overlap_loss(log_odds: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Binary cross-entropy of a soft target plus one minus the soft Dice coefficient.

    All (B,1,H,W). The Dice coefficient has squares below the line (Milletari et al., 3DV 2016), so
    that it, too, is best at the soft target itself.
    """
    entropy = F.binary_cross_entropy_with_logits(log_odds, target, weight)
    found = torch.sigmoid(log_odds)
    both = 2 * (weight * found * target).sum() + 1
    return entropy + 1 - both / ((weight * (found.square() + target.square())).sum() + 1)


class Trainer:
    """A fit under way: the network, its running average, its optimisers and how far it is.

    Every crop is drawn from a generator seeded with (seed, phase, iteration), so a fit that was
    interrupted and goes on from `state()` ends like one that was not. bfloat16: products in half
    precision, about twice as fast, where the device multiplies them itself. on_device: all pictures are
    kept where the network computes and crops are cut there, so that a GPU need not wait for them.
    """

    def __init__(
        self, network: Detector, pools: Sequence[Pool], phases: Sequence[Phase],
        *, seed: int, clean_share: float, lures: float = 0.0, bfloat16: bool = False,
        on_device: bool = False,
    ) -> None:  # fmt: skip
        self.network, self.pools, self.phases = network, pools, phases
        self.stacks = resident(pools, str(_device(network))) if on_device else []
        self.seed = seed
        self.bfloat16 = bfloat16 and multiplies_bfloat16(_device(network).type)
        self.clean_share, self.lures = clean_share, lures
        self.phase = self.iteration = self.seen = self.done = 0
        self.average = copy.deepcopy(network).eval()
        self._begin_phase()

    def _begin_phase(self) -> None:
        """A new phase starts from the running average, with fresh optimisers."""
        if self.seen:
            self.network.load_state_dict(self.average.state_dict())
        if self.phase < len(self.phases) and self._was_single_step():
            assert isinstance(self.network, AttentiveRecurrentNet)
            self.network.unroll()
        self.average.load_state_dict(self.network.state_dict())
        self.seen = 0
        matrices = [p for n, p in self.network.named_parameters() if _is_matrix(n, p)]
        rest = [p for n, p in self.network.named_parameters() if not _is_matrix(n, p)]
        self.optimisers = (Muon(matrices, lr=1.0), torch.optim.Adam(rest, lr=1.0))

    def _was_single_step(self) -> bool:
        return (
            self.phase > 0
            and self.phases[self.phase - 1].steps == 1
            and self.phases[self.phase].steps > 1
        )

    @property
    def total(self) -> int:
        """The iterations of all phases."""
        return sum(phase.iterations for phase in self.phases)

    @property
    def finished(self) -> bool:
        return self.phase >= len(self.phases)

    def advance(self) -> float:
        """One iteration; its loss."""
        phase = self.phases[self.phase]
        rng = np.random.default_rng([self.seed, self.phase, self.iteration])
        wish = (rng, phase.batch, phase.crop, self.clean_share, self.lures)
        drawn = draw_resident(self.stacks, *wish) if self.stacks else draw_batch(self.pools, *wish)
        self.network.train()
        loss = self._loss(*drawn, phase.steps)
        for optimiser in self.optimisers:
            optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._apply(phase)
        self.iteration, self.done = self.iteration + 1, self.done + 1
        if self.iteration >= phase.iterations:
            self.phase, self.iteration = self.phase + 1, 0
            self._begin_phase()
        return float(loss.detach())

    def _loss(self, images: Tensor, coverage: Tensor, weight: Tensor, steps: int) -> Tensor:
        device = _device(self.network)
        images = images.to(device, memory_format=torch.channels_last)
        target, weight = wetness(coverage.to(device)), weight.to(device)
        with torch.autocast(device.type, torch.bfloat16, enabled=self.bfloat16):
            if isinstance(self.network, DropUNet):
                found = [self.network(images)]
            else:
                found = self.network(images, steps)
        found = [each.float() for each in found]
        if isinstance(self.network, DropUNet):
            return overlap_loss(found[0], target, weight)
        return attention_loss(found, target, weight)

    def _apply(self, phase: Phase) -> None:
        rate = rate_at(phase, self.iteration)
        for optimiser, factor in zip(self.optimisers, (1.0, 0.15), strict=True):
            for group in optimiser.param_groups:
                group["lr"] = rate * factor
            optimiser.step()
        self.seen += 1
        decay = min(EMA_DECAY, self.seen / (self.seen + 10))
        new = self.network.state_dict()
        with torch.no_grad():
            for name, kept in self.average.state_dict().items():
                if kept.is_floating_point():
                    kept.lerp_(new[name], 1 - decay)

    def state(self) -> dict[str, Any]:
        """All that `restore` needs to go on from here: tensors and numbers."""
        return {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self.optimisers],
            "where": [self.phase, self.iteration, self.seen, self.done],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes back to what `state()` returned."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        for optimiser, saved in zip(self.optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(saved)
        self.phase, self.iteration, self.seen, self.done = state["where"]


def phases_of(network: Detector, told: Sequence[Mapping[str, Any]]) -> list[Phase]:
    """The phases as they are told; UserError for one that the network cannot learn from.

    Of one crop of no more than 16 pixels the U-Net's normalisation sees, at its smallest scale, a single
    number per channel.
    """
    phases = [Phase(**each) for each in told]
    for phase in phases:
        seen = phase.batch * math.ceil(phase.crop / network.grid) ** 2
        if isinstance(network, DropUNet) and seen < 2:
            raise UserError(
                f"The unet cannot learn from batches of one crop of {phase.crop} pixels: "
                "at its smallest scale that is one pixel.",
                f"Raise batch to 2, or crop above {network.grid}, in that phase of train_detector.",
            )
    return phases


def rate_at(phase: Phase, iteration: int) -> float:
    """Muon's learning rate: it rises over twenty iterations and falls along a half cosine."""
    warm = min(1.0, (iteration + 1) / 20)
    fall = 0.5 * (1 + math.cos(math.pi * iteration / phase.iterations))
    return phase.rate * warm * (0.05 + 0.95 * fall)


def _device(network: Detector) -> torch.device:
    return next(network.parameters()).device


def _is_matrix(name: str, parameter: Tensor) -> bool:
    """Muon takes the hidden convolutions; Adam the map's single row and all vectors."""
    return parameter.ndim == 4 and not name.startswith(("det_conv_mask", "last"))


def score(network: Detector, pool: Pool, steps: int) -> Score:
    """How well the network finds the water of a pool it was not trained on, at its best threshold.

    All pixels of all pictures are counted together; thresholds are tried in steps of 0.05.
    """
    device = _device(network)
    counts = np.zeros((3, len(THRESHOLDS)))  # hits, marked, wet
    for rainy, cover in zip(pool.rainy, pool.coverage, strict=True):
        bgr = np.ascontiguousarray(rainy[..., ::-1].transpose(2, 0, 1), np.float32) / 255
        with torch.inference_mode():
            found = network.attention(torch.from_numpy(bgr)[None].to(device), steps)
        counts += count(found[0, 0].cpu().numpy(), cover / 255 > VISIBLE_COVERAGE)
    return scores(counts)[int(np.argmax([each.f1 for each in scores(counts)]))]


def count(found: np.ndarray, wet: np.ndarray) -> np.ndarray:
    """(3, thresholds): pixels marked and wet, marked, wet, at each of THRESHOLDS.

    found: map (H,W) in [0,1]; wet: (H,W) bool. Counts of several pictures add up.
    """
    hits = [int((wet & (found > threshold)).sum()) for threshold in THRESHOLDS]
    marked = [int((found > threshold).sum()) for threshold in THRESHOLDS]
    return np.array([hits, marked, [int(wet.sum())] * len(THRESHOLDS)], float)


def scores(counts: np.ndarray) -> list[Score]:
    """The score at each of THRESHOLDS, from `count`."""
    return [
        Score(
            threshold=float(threshold),
            precision=hits / max(marked, 1),
            recall=hits / max(wet, 1),
            f1=2 * hits / max(marked + wet, 1),
            iou=hits / max(marked + wet - hits, 1),
        )
        for threshold, (hits, marked, wet) in zip(THRESHOLDS, counts.T.tolist(), strict=True)
    ]


def curve_rows(
    done: int, steps: int, loss: float, found: Mapping[str, Score]
) -> list[list[float | str]]:
    """Rows of the validation curve, one per set of pictures; columns: CURVE."""
    rows: list[list[float | str]] = []
    for name, each in found.items():
        figures = (each.threshold, each.precision, each.recall, each.f1, each.iou)
        rows.append([done, steps, round(loss, 6), name, *(round(f, 4) for f in figures)])
    return rows


def fit(
    trainer: Trainer,
    validate_every: int,
    validation: Mapping[str, Pool],
    on_score: Callable[[int, int, float, dict[str, Score]], None],
) -> Detector:
    """The running average of the weights after all phases.

    on_score(iterations done, recurrent steps, mean loss since the last call, score per validation
    pool) is called every `validate_every` iterations and at the end of each phase: there a
    checkpoint is written. UserError once the loss is no number, which it stays.
    """
    losses: list[float] = []
    while not trainer.finished:
        steps = trainer.phases[trainer.phase].steps
        losses.append(trainer.advance())
        if not math.isfinite(losses[-1]):
            raise UserError(
                f"The training broke down near step {trainer.done}.",
                "Lower the rate of the phase under train_detector.",
            )
        if trainer.iteration % validate_every == 0:  # 0 after the last one of a phase, too
            result = {
                name: score(trainer.average, pool, steps) for name, pool in validation.items()
            }
            on_score(trainer.done, steps, float(np.mean(losses)), result)
            losses = []
    return trainer.average
