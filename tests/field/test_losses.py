"""Equation 4 and the losses around it, on numbers worked out by hand."""

from __future__ import annotations

import pytest
import torch

from pipeline.field.losses import distortion_loss, masked_photometric_loss, proposal_loss


def test_covered_rays_count_neither_in_the_sum_nor_in_its_size() -> None:
    rendered = torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.0, 0.0], [0.2, 0.2, 0.2]])
    observed = torch.tensor([[0.5, 0.5, 0.8], [0.0, 0.0, 0.0], [0.2, 0.6, 0.2]])
    drop_mask = torch.tensor([0.0, 1.0, 0.0])
    # Kept rays: 0.3^2 + 0.4^2 = 0.25, over 2 rays of 3 channels: 0.25 / 6.
    loss = masked_photometric_loss(rendered, observed, drop_mask)
    assert float(loss) == pytest.approx(0.25 / 6)


def test_nothing_flows_into_a_covered_ray() -> None:
    rendered = torch.rand(4, 3, requires_grad=True)
    drop_mask = torch.tensor([1.0, 0.0, 1.0, 0.0])
    masked_photometric_loss(rendered, torch.zeros(4, 3), drop_mask).backward()
    assert rendered.grad[drop_mask == 1].abs().max() == 0
    assert rendered.grad[drop_mask == 0].abs().min() > 0


def test_soft_masks_weigh_rays_down() -> None:
    rendered = torch.tensor([[0.4, 0.0, 0.0], [0.0, 0.0, 0.0]])
    # Half covered: (0.5 * 0.4)^2 = 0.04, over 3 * (0.5^2 + 1^2) = 3.75.
    loss = masked_photometric_loss(rendered, torch.zeros(2, 3), torch.tensor([0.5, 0.0]))
    assert float(loss) == pytest.approx(0.04 / 3.75)


def test_trimming_leaves_the_farthest_rays_out() -> None:
    rendered = torch.tensor([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [0.9, 0, 0]])
    drop_mask = torch.zeros(4)
    # A quarter left out: 0.01 + 0.04 + 0.09 = 0.14, over the 3 rays' 9 numbers.
    loss = masked_photometric_loss(rendered, torch.zeros(4, 3), drop_mask, trim=0.25)
    assert float(loss) == pytest.approx(0.14 / 9)
    grown = rendered.clone().requires_grad_()
    masked_photometric_loss(grown, torch.zeros(4, 3), drop_mask, trim=0.25).backward()
    assert grown.grad[3].abs().max() == 0 and grown.grad[2, 0] > 0


def test_all_covered_gives_zero_and_no_nan() -> None:
    assert float(masked_photometric_loss(torch.ones(2, 3), torch.zeros(2, 3), torch.ones(2))) == 0


def test_a_proposal_that_covers_the_weights_costs_nothing() -> None:
    # The interval [0.3, 0.45] lies in the second of four bins, [0.25, 0.5): its bound is 0.5.
    edges, weights = torch.tensor([[0.3, 0.45]]), torch.tensor([[0.5]])
    assert float(proposal_loss(edges, weights, torch.tensor([[0.2, 0.5, 0.2, 0.1]]))) == 0
    # With 0.3 there the excess is 0.2: 0.2^2 / 0.5 = 0.08.
    loss = proposal_loss(edges, weights, torch.tensor([[0.4, 0.3, 0.2, 0.1]]))
    assert float(loss) == pytest.approx(0.08, rel=1e-5)


def test_distortion_against_the_double_sum() -> None:
    edges = torch.rand(3, 6).sort(dim=1).values
    weights = torch.rand(3, 5)
    m = 0.5 * (edges[:, 1:] + edges[:, :-1])
    pairs = weights[:, :, None] * weights[:, None] * (m[:, :, None] - m[:, None]).abs()
    within = (weights**2 * (edges[:, 1:] - edges[:, :-1])).sum(1) / 3
    assert float(distortion_loss(edges, weights)) == pytest.approx(
        float((pairs.sum((1, 2)) + within).mean()), rel=1e-5
    )
