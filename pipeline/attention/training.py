"""Fits the attentive-recurrent network to pools of rainy pictures with known coverage."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.attention.muon import Muon
from pipeline.attention.network import (
    FEATURES,
    AttentiveRecurrentNet,
    bias_of,
    first_layer,
    last_layer,
)
from pipeline.attention.samples import MAP_THRESHOLD, VISIBLE_COVERAGE, Pool, draw_batch, wetness

THETA = 0.8
EMA_DECAY = 0.995


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
    """The network against true coverage > 0.05, its map cut at 0.3; all in [0,1]."""

    mse: float
    precision: float
    recall: float
    f1: float


def attention_loss(maps: Sequence[Tensor], target: Tensor, theta: float = THETA) -> Tensor:
    """The paper's loss over the N steps: sum of theta^(N-t) MSE(A_t, M), t = 1..N.

    maps: N raw maps (B,1,H,W); target: the same shape. Source: Qian et al., CVPR 2018, eq. 3.
    """
    total = torch.zeros((), device=target.device)
    for step, found in enumerate(maps, start=1):
        total = total + theta ** (len(maps) - step) * (found - target).square().mean()
    return total


def initialise(network: AttentiveRecurrentNet, seed: int) -> None:
    """Draws starting weights from which a few minutes of training get somewhere.

    The first layer reads differences (each of its kernels sums to zero over the photo) four
    times as strongly as usual, because drops show in contrast, not in brightness. The gates
    start open and, like the residual branches, quiet, so that nothing is saturated. From plain
    starting values nothing was learnt in the same time.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Conv2d):
                deviation = math.sqrt(2 / module.weight[0].numel())
                module.weight.normal_(0, deviation, generator=generator)
                bias_of(module).zero_()
        first = first_layer(network.det_conv0).weight
        first[:, :3] -= first[:, :3].mean((2, 3), keepdim=True)
        first[:, :3] *= 4
        first[:, 3:] *= 0.1
        for block in network.residual_blocks():
            last_layer(block).weight *= 0.3
        for gate in (network.conv_i, network.conv_f, network.conv_g, network.conv_o):
            first_layer(gate).weight *= 0.5
        bias_of(first_layer(network.conv_i)).fill_(1)
        bias_of(first_layer(network.conv_o)).fill_(1)
        last = first_layer(network.det_conv_mask)
        last.weight *= 0.3
        bias_of(last).fill_(0.2)


def unroll(network: AttentiveRecurrentNet) -> None:
    """Prepares weights that were trained with one step for several, keeping what they compute.

    At one step the map is a constant 0.5 and the state zero. The constant is absorbed into the
    first layer's bias, the weights that read map and hidden state become zero, and the forget
    gate is nearly closed: every further step then repeats the first one (but for what the
    closed gate lets through), and training goes on from there instead of unlearning.
    """
    gates = (network.conv_i, network.conv_f, network.conv_g, network.conv_o)
    with torch.no_grad():
        first, forget = first_layer(network.det_conv0), first_layer(network.conv_f)
        bias_of(first).add_(0.5 * first.weight[:, 3].sum((1, 2)))
        first.weight[:, 3].zero_()
        for gate in gates:
            first_layer(gate).weight[:, FEATURES:].zero_()
        forget.weight.mul_(0.1)
        bias_of(forget).fill_(-3)


class Trainer:
    """A fit under way: the network, its running average, its optimisers and how far it is.

    Every crop is drawn from a generator seeded with (seed, phase, iteration), so a fit that was
    interrupted and goes on from `state()` ends like one that was not.
    """

    def __init__(
        self, network: AttentiveRecurrentNet, pools: Sequence[Pool], phases: Sequence[Phase],
        *, seed: int, clean_share: float,
    ) -> None:  # fmt: skip
        self.network, self.pools, self.phases = network, pools, phases
        self.seed, self.clean_share = seed, clean_share
        self.phase = self.iteration = self.seen = self.done = 0
        self.average = AttentiveRecurrentNet().to(next(network.parameters()).device)
        self._begin_phase()

    def _begin_phase(self) -> None:
        """A new phase starts from the running average, with fresh optimisers."""
        if self.seen:
            self.network.load_state_dict(self.average.state_dict())
        if self.phase < len(self.phases) and self._was_single_step():
            unroll(self.network)
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
    def finished(self) -> bool:
        return self.phase >= len(self.phases)

    def advance(self) -> float:
        """One iteration; its loss."""
        phase = self.phases[self.phase]
        rng = np.random.default_rng([self.seed, self.phase, self.iteration])
        device = next(self.network.parameters()).device
        images, coverage = draw_batch(self.pools, rng, phase.batch, phase.crop, self.clean_share)
        target = wetness(coverage.to(device))
        loss = attention_loss(self.network(images.to(device), phase.steps), target)
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

    def _apply(self, phase: Phase) -> None:
        warm = min(1.0, (self.iteration + 1) / 20)
        progress = self.iteration / phase.iterations
        rate = phase.rate * warm * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress)))
        for optimiser, factor in zip(self.optimisers, (1.0, 0.15), strict=True):
            for group in optimiser.param_groups:
                group["lr"] = rate * factor
            optimiser.step()
        self.seen += 1
        decay = min(EMA_DECAY, self.seen / (self.seen + 10))
        with torch.no_grad():
            for kept, new in zip(self.average.parameters(), self.network.parameters(), strict=True):
                kept.lerp_(new, 1 - decay)

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


def _is_matrix(name: str, parameter: Tensor) -> bool:
    """Muon takes the hidden convolutions; Adam the map's single row and all biases."""
    return parameter.ndim == 4 and not name.startswith("det_conv_mask")


def score(network: AttentiveRecurrentNet, pool: Pool, steps: int) -> Score:
    """How well the network finds the water of a pool it was not trained on.

    All pixels of all pictures are counted together.
    """
    device = next(network.parameters()).device
    squares = pixels = hits = marked = wet = 0.0
    for rainy, cover in zip(pool.rainy, pool.coverage, strict=True):
        bgr = np.ascontiguousarray(rainy[..., ::-1].transpose(2, 0, 1), np.float32) / 255
        with torch.inference_mode():
            raw = network(torch.from_numpy(bgr)[None].to(device), steps)[-1][0, 0]
        found = raw.cpu().clamp(0, 1)
        coverage = torch.from_numpy(cover.astype(np.float32) / 255)
        squares += float((found - wetness(coverage)).square().sum())
        pixels += cover.size
        marks, true = found > MAP_THRESHOLD, coverage > VISIBLE_COVERAGE
        hits += float((marks & true).sum())
        marked += float(marks.sum())
        wet += float(true.sum())
    return Score(
        mse=squares / max(pixels, 1),
        precision=hits / max(marked, 1),
        recall=hits / max(wet, 1),
        f1=2 * hits / max(marked + wet, 1),
    )


def fit(
    trainer: Trainer,
    *,
    validate_every: int,
    validation: Pool,
    on_score: Callable[[int, int, float, Score], None],
) -> AttentiveRecurrentNet:
    """The running average of the weights after all phases.

    on_score(iterations done, recurrent steps, mean loss since the last call, score) is called
    every `validate_every` iterations and at the end of each phase: there a checkpoint is written.
    """
    losses: list[float] = []
    while not trainer.finished:
        steps = trainer.phases[trainer.phase].steps
        losses.append(trainer.advance())
        if trainer.iteration % validate_every == 0:  # 0 after the last one of a phase, too
            result = score(trainer.average, validation, steps)
            on_score(trainer.done, steps, float(np.mean(losses)), result)
            losses = []
    return trainer.average
