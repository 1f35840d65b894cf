"""Steps of a fit on a GPU, recorded once and played again.

A step is some hundred small pieces of work: a GPU is through with each before Python has sent the next.
A CUDA graph holds them all and is sent at once.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Hashable, Sequence

import torch
from torch import Tensor, nn

from pipeline.field.buffer import RayBuffer
from pipeline.field.steppers import Exposure, Stepper, as_field, found_in, totals

log = logging.getLogger(__name__)

FIRST = 3  # steps of each phase that run as they are: they make what later steps use again


class CudaSteps:
    """Called with a step's number, takes the step; (loss, photometric loss) ``(2,)`` comes out.

    What changes from step to step (the pixels, the rates, the random numbers' seed) is put where the
    recorded step reads it. Steps of the same phase (:meth:`pipeline.field.base.Field.phase`) share a
    recording. The numbers are those of steps that are not recorded, but for sums that a GPU adds up
    in no fixed order.
    """

    def __init__(
        self,
        model: nn.Module,
        light: Exposure | None,
        steppers: Sequence[Stepper],
        buffer: RayBuffer,
        batch_rays: int,
        seed: int,
        record: bool,
    ) -> None:
        self.model, self.light, self.steppers, self.buffer = model, light, steppers, buffer
        self.seed, self.batch_rays = seed, batch_rays
        device = torch.device(buffer.device)
        self.record = record and device.type == "cuda"
        self.pixels = buffer.pixels(0, batch_rays).clone()
        steps = max(stepper.steps for stepper in steppers)
        rates = [[stepper.rate_at(step) for stepper in steppers] for step in range(steps)]
        self.schedule = torch.tensor(rates, device=device)
        self.rates = self.schedule[0].clone()
        for stepper, rate in zip(steppers, self.rates, strict=True):
            stepper.now = rate
        self.source = torch.Generator(device)
        self.stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self.taken: Counter[Hashable] = Counter()
        self.recorded: dict[Hashable, tuple[torch.cuda.CUDAGraph, Tensor]] = {}

    def __call__(self, step: int) -> Tensor:
        phase = as_field(self.model).phase(step)
        self.pixels.copy_(self.buffer.pixels(step, self.batch_rays))
        self.rates.copy_(self.schedule[step])
        self.source.manual_seed((self.seed * 1_000_003 + step) * 64)
        self.taken[phase] += 1
        if self.record and self.taken[phase] > FIRST and phase not in self.recorded:
            self._record(phase, step)
        if phase in self.recorded:
            graph, losses = self.recorded[phase]
            graph.replay()
            return losses.clone()
        return self._on_stream(step)

    def _work(self, step: int) -> Tensor:
        batch = self.buffer.rays(self.pixels)
        found = found_in(self.model, self.light, self.steppers, batch, step, self.source, 1.0)
        for stepper in self.steppers:
            stepper.apply(totals(stepper, [found]))
        return found.losses

    def _on_stream(self, step: int) -> Tensor:
        """The step as it is, where it will be recorded: what a stream needs is then there."""
        if self.stream is None:
            return self._work(step)
        now = torch.cuda.current_stream(self.stream.device)
        self.stream.wait_stream(now)
        with torch.cuda.stream(self.stream):
            losses = self._work(step)
        now.wait_stream(self.stream)
        return losses

    def _record(self, phase: Hashable, step: int) -> None:
        """Records a step without taking it; where that fails, no further step is recorded."""
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self.source)
        pool = next((one.pool() for one, _ in self.recorded.values()), None)
        try:
            with torch.cuda.graph(graph, pool, self.stream, capture_error_mode="thread_local"):
                losses = self._work(step)
        except RuntimeError as error:
            log.warning("The GPU records no step, so each takes longer: %s", error)
            self.record, self.source = False, torch.Generator(self.buffer.device)
            self.source.manual_seed((self.seed * 1_000_003 + step) * 64)
            return
        self.recorded[phase] = graph, losses
