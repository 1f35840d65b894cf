"""Equation 1 on numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from pipeline.field.volume import composite, render_weights, transmittance

# Two intervals of length 1 and 2 with densities ln 2 and ln 2 / 2: each lets half of the light
# through. T = 1, 1/2. w = 1 * 1/2, 1/2 * 1/2 = 1/2, 1/4; 1/4 of the light is left.
SIGMA = torch.tensor([[math.log(2.0), math.log(2.0) / 2]])
DELTA = torch.tensor([[1.0, 2.0]])


def test_transmittance() -> None:
    assert transmittance(SIGMA, DELTA)[0].tolist() == pytest.approx([1.0, 0.5])


def test_weights_and_colour() -> None:
    weights = render_weights(SIGMA, DELTA)
    assert weights[0].tolist() == pytest.approx([0.5, 0.25])
    # 1/2 * (1, 0, 0) + 1/4 * (0, 1, 0.4)
    rgb = composite(weights, torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.4]]]))
    assert rgb[0].tolist() == pytest.approx([0.5, 0.25, 0.1])


def test_an_opaque_background_takes_what_is_left() -> None:
    weights = render_weights(SIGMA, DELTA, opaque_last=True)
    assert weights[0].tolist() == pytest.approx([0.5, 0.5])


def test_density_behind_a_wall_changes_nothing() -> None:
    sigma = torch.tensor([[0.0, 1e6, 3.0]], requires_grad=True)
    weights = render_weights(sigma, torch.ones(1, 3))
    assert weights[0].tolist() == pytest.approx([0.0, 1.0, 0.0])
    weights[0, 2].backward()
    assert torch.isfinite(sigma.grad).all()


def test_the_gradient_is_the_formulas() -> None:
    sigma = torch.rand(3, 5, dtype=torch.float64, requires_grad=True)
    delta = torch.rand(3, 5, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda s: render_weights(s, delta), (sigma,))
