"""The paper's NeRF has the paper's numbers, and runs behind the same interface."""

from __future__ import annotations

from pathlib import Path

import torch
import yaml

from pipeline.field.base import Rays
from pipeline.field.paper_field import PaperConfig, PaperField, PaperNetwork
from pipeline.geometry.spaces import Space

SPACE = Space("ndc", ((1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0)), 1.0, (-1.0, -1.0, 0.0),
              (1.0, 1.0, 1.0))  # fmt: skip


def test_the_papers_numbers() -> None:
    config = PaperConfig()
    assert (config.layers, config.width, config.skip) == (8, 256, 4)
    assert (config.position_frequencies, config.direction_frequencies) == (10, 4)
    assert (config.coarse_samples, config.fine_samples) == (64, 64)
    assert config.density_noise == 1.0
    assert (config.rate, config.final_rate) == (5e-4, 5e-5)
    fit = yaml.safe_load((Path(__file__).parents[2] / "params.yaml").read_text())["nerf"]
    assert (fit["paper_steps"], fit["paper_batch_rays"], fit["rate"]) == (200_000, 1024, 1.0)


def test_each_network_has_the_public_codes_parameter_count() -> None:
    network = PaperNetwork(PaperConfig())
    assert sum(p.numel() for p in network.parameters()) == 595_844
    # The skip joins the encoded position to the fifth layer's output.
    assert network.trunk[5].in_features == 256 + 63


def test_the_rate_falls_tenfold_over_the_fit() -> None:
    field = PaperField(PaperConfig(layers=6, width=16), SPACE, 0)
    (part,) = field.parts()
    assert part.rate == 5e-4
    assert abs(part.rate * part.final - 5e-5) < 1e-12
    assert part.betas == (0.9, 0.999) and part.warmup == 0


def test_fine_samples_join_the_coarse_ones_and_a_step_reaches_both_networks() -> None:
    config = PaperConfig(layers=6, width=16, coarse_samples=8, fine_samples=6)
    field = PaperField(config, SPACE, 0)
    ones = torch.ones(5)
    rays = Rays(torch.zeros(3, 5), torch.stack([0.1 * ones, 0 * ones, ones]), ones, 9 * ones)
    out = field.render(rays)
    assert out.weights.shape == (5, 14)
    assert bool((out.edges[:, 1:] >= out.edges[:, :-1]).all())
    assert float(out.weights.sum(1).max()) <= 1.0 + 1e-5
    generator = torch.Generator().manual_seed(0)
    loss, photometric = field.loss(rays, torch.zeros(5, 3), torch.zeros(5), 0, generator, [])
    loss.backward()
    assert loss.item() > photometric.item() > 0
    assert field.coarse.rgb.weight.grad.abs().max() > 0
    assert field.fine.rgb.weight.grad.abs().max() > 0
