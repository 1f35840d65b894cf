"""Grids interpolate, and their gradients are those of the interpolation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.field.base import TableGradient
from pipeline.field.encoding import (
    HashGrid,
    add_rows,
    cell_corners,
    gather,
    level_resolutions,
    positional_encoding,
    spherical_harmonics,
)


@pytest.mark.parametrize("size", [64, 8])  # 4 * 4 * 4 vertices: direct, and hashed into 8 rows
def test_the_weights_of_a_cell_sum_to_one_and_rows_are_in_range(size: int) -> None:
    x = torch.rand(3, 50, generator=torch.Generator().manual_seed(0))
    rows, weights = cell_corners(x, (4, 4, 4), size)
    assert rows.dtype == torch.int32
    assert int(rows.min()) >= 0 and int(rows.max()) < size
    torch.testing.assert_close(weights.sum(1), torch.ones(50))
    assert float(weights.min()) >= 0


def test_a_dense_level_reproduces_a_linear_function_up_to_the_borders() -> None:
    nx, ny, nz = 4, 3, 5
    axes = np.meshgrid(*(np.linspace(0, 1, n) for n in (nz, ny, nx)), indexing="ij")
    table = torch.tensor(2 * axes[2] - 3 * axes[1] + 0.5 * axes[0]).float().reshape(-1, 1)
    x = torch.rand(3, 100, generator=torch.Generator().manual_seed(1))
    x[:, :2] = torch.tensor([[0.0, 1.0]] * 3)
    rows, weights = cell_corners(x, (nx, ny, nz), 64)
    found = gather(table, rows, weights)[:, 0]
    torch.testing.assert_close(found, 2 * x[0] - 3 * x[1] + 0.5 * x[2], atol=1e-5, rtol=0)


def test_adding_rows_is_the_transpose_of_gathering() -> None:
    g = torch.Generator().manual_seed(2)
    table, upstream = torch.rand(16, 3, generator=g), torch.rand(40, 3, generator=g)
    rows = torch.randint(0, 16, (40, 8), generator=g, dtype=torch.int32)
    weights = torch.rand(40, 8, generator=g)
    added = torch.zeros(16, 3)
    add_rows(rows, weights, upstream, added)
    forward = (gather(table, rows, weights) * upstream).sum()
    assert float((table * added).sum()) == pytest.approx(float(forward), rel=1e-5)


def test_the_sink_holds_what_the_dense_gradient_adds_up() -> None:
    g = torch.Generator().manual_seed(3)
    rows = torch.randint(0, 16, (40, 8), generator=g, dtype=torch.int32)
    weights, upstream = torch.rand(40, 8, generator=g), torch.rand(40, 2, generator=g)
    table = torch.rand(16, 2, generator=g, requires_grad=True)
    gather(table, rows, weights).backward(upstream)
    sink: list[TableGradient] = []
    again = table.detach().clone().requires_grad_()
    gather(again, rows, weights, "t", sink).backward(upstream)
    assert again.grad is None
    (entry,) = sink
    assert entry.table == "t"
    total = torch.zeros(16, 2)
    entry.add_to(total)
    assert torch.equal(total, table.grad)


def test_a_grid_is_the_same_for_the_same_generator() -> None:
    def values() -> torch.Tensor:
        grid = HashGrid([(4, 4, 4), (40, 40, 40)], 2, 8, torch.Generator().manual_seed(5))
        assert grid.sizes == [64, 256]
        return grid(torch.full((3, 1), 0.37))

    assert values().shape == (1, 4)
    assert torch.equal(values(), values())


def test_levels_run_from_coarse_to_fine() -> None:
    assert level_resolutions((16, 16, 8), (64, 64, 32), 3) == [
        (16, 16, 8), (32, 32, 16), (64, 64, 32),
    ]  # fmt: skip


def test_positional_encoding_by_hand() -> None:
    # x, sin x, cos x, sin 2x, cos 2x at x = 0 and pi/2.
    out = positional_encoding(torch.tensor([[0.0], [torch.pi / 2]]), 2)
    expected = torch.tensor([[0, 0, 1, 0, 1], [torch.pi / 2, 1, 0, 0, -1]])
    torch.testing.assert_close(out, expected, atol=1e-6, rtol=0)


def test_spherical_harmonics_are_orthonormal() -> None:
    directions = torch.randn(3, 200_000, generator=torch.Generator().manual_seed(0)).double()
    basis = spherical_harmonics(directions)
    gram = 4 * torch.pi * basis.t() @ basis / basis.shape[0]
    torch.testing.assert_close(gram, torch.eye(9).double(), atol=0.02, rtol=0)
