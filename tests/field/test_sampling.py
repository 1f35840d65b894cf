"""Samples fall where the histogram has its weight."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.errors import UserError
from pipeline.field.buffer import photos_to_fit
from pipeline.field.sampling import (
    depth_at,
    intervals_around,
    invert_histogram,
    invert_pieces,
    stratified,
)
from pipeline.io.posed import PosedImage
from pipeline.io.scene import ImageRecord
from pipeline.io.transforms import View


def test_depth_is_linear_in_its_inverse() -> None:
    # Near 2, far 10: half-way 1/2 (1/2 + 1/10) = 0.3, depth 10/3.
    s = torch.tensor([0.0, 0.5, 1.0])
    depth = depth_at(s, torch.tensor(2.0), torch.tensor(10.0))
    assert depth.tolist() == pytest.approx([2.0, 10 / 3, 10.0])


def test_quantiles_of_a_histogram_by_hand() -> None:
    # Weights 0, 1, 3, 0 in quarters of [0, 1]: cumulative 0, 1/4, 1, 1.
    weights = torch.tensor([[0.0, 1.0, 3.0, 0.0]])
    # 1/8 is half-way through bin 1; 1/4 its end; 5/8 half-way through bin 2.
    u = torch.tensor([[0.125, 0.25, 0.625]])
    assert invert_histogram(weights, u)[0].tolist() == pytest.approx([0.375, 0.5, 0.625], abs=1e-4)
    edges = torch.tensor([[0.0, 0.25, 0.5, 0.75, 1.0]])
    assert invert_pieces(edges, weights, u)[0].tolist() == pytest.approx(
        [0.375, 0.5, 0.625], abs=1e-4
    )


def test_no_weight_at_all_is_taken_as_uniform() -> None:
    u = torch.tensor([[0.1, 0.5, 0.9]])
    assert invert_histogram(torch.zeros(1, 4), u)[0].tolist() == pytest.approx([0.1, 0.5, 0.9])


def test_samples_are_sorted_inside_the_ray_and_repeat_with_the_seed() -> None:
    def draw(seed: int) -> torch.Tensor:
        u = stratified(50, 8, torch.Generator().manual_seed(seed), torch.zeros(1))
        weights = torch.rand(50, 32, generator=torch.Generator().manual_seed(9)) ** 8
        return invert_histogram(weights, u)

    s = draw(1)
    assert bool((s[:, 1:] >= s[:, :-1]).all())
    assert float(s.min()) >= 0 and float(s.max()) <= 1
    assert torch.equal(s, draw(1)) and not torch.equal(s, draw(2))


def test_intervals_enclose_their_samples() -> None:
    # Midpoints 0.3 and 0.6 between the samples; the outer gaps 0.1 and 0.2 mirrored, 1.0 the end.
    edges = intervals_around(torch.tensor([[0.2, 0.4, 0.8]]))
    assert edges[0].tolist() == pytest.approx([0.1, 0.3, 0.6, 1.0])


@pytest.mark.parametrize(("near", "far"), [(1e-3, 2e3), (3.0, 2.0)])
def test_depths_that_cannot_be_told_apart_are_refused(near: float, far: float) -> None:
    with pytest.raises(UserError, match="depth"):
        photos_to_fit([], near, far)


def test_pixels_that_no_ray_leads_to_are_not_fitted() -> None:
    view = View("a.png", np.eye(4), 4.0, 4.0, 4.0, 3.0, -0.2, 8, 6, 1.0, 9.0)
    record = ImageRecord("a.png", "a.jpg", "", 8, 6, None, "train", 0)
    keep_mask = np.ones((6, 8), bool)
    keep_mask[3, 4] = False
    image = PosedImage(record, view, np.zeros((6, 8, 3), np.float32), keep_mask)
    (photo,) = photos_to_fit([image], 1.0, 9.0)
    assert not photo.keep_mask[0, 0] and not photo.keep_mask[3, 4] and photo.keep_mask[2, 4]
    assert np.array_equal(photo.keep_mask, keep_mask & ~view.without_ray())
