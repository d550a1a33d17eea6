"""Matching pixels to the canonical surface: the grid, and the soft argmax between its limits (equation 10)."""

from __future__ import annotations

import math

import pytest
import torch

from stages.model.correspondence import match_grid, soft_argmax

BOUNDS = torch.tensor([[-1.0, 0.0, 2.0], [1.0, 0.5, 2.6]])


def unit(count: int, seed: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 16, generator=torch.Generator().manual_seed(seed)), dim=1)


def test_match_grid_holds_the_cells_centres() -> None:
    grid = match_grid(BOUNDS, 4)
    assert grid.shape == (64, 3)
    assert torch.allclose(grid.mean(0), BOUNDS.mean(0))
    for k in range(3):
        width = float(BOUNDS[1, k] - BOUNDS[0, k])
        expected = [float(BOUNDS[0, k]) + width * (i + 0.5) / 4 for i in range(4)]
        assert sorted(set(grid[:, k].tolist())) == pytest.approx(expected)


def test_soft_argmax_loop() -> None:
    pixels, cells, grid = unit(3, 0), unit(8, 1), match_grid(BOUNDS, 2)
    prior = torch.randn(8, generator=torch.Generator().manual_seed(2))
    for log_weight in (None, prior):
        found = soft_argmax(pixels, grid, cells, 7.0, log_weight)
        for p in range(3):
            mass = [
                math.exp(7.0 * float(pixels[p] @ cells[v]) + (0.0 if log_weight is None else float(log_weight[v])))
                for v in range(8)
            ]
            expected = sum(m * grid[v] for v, m in enumerate(mass)) / sum(mass)
            assert torch.allclose(found[p], expected, atol=1e-5)


def test_soft_argmax_limits() -> None:
    cells, grid = unit(27, 1), match_grid(BOUNDS, 3)
    pixels = cells[[4, 13, 26]]
    sharp = soft_argmax(pixels, grid, cells, 1e4, None)
    assert torch.allclose(sharp, grid[[4, 13, 26]], atol=1e-5)
    blind = soft_argmax(pixels, grid, cells, 0.0, None)
    assert torch.allclose(blind, grid.mean(0).expand(3, 3), atol=1e-5)


def test_cells_off_the_surface_carry_no_mass() -> None:
    cells, grid = unit(27, 1), match_grid(BOUNDS, 3)
    prior = torch.full((27,), -torch.inf)
    prior[[2, 5]] = 0.0
    found = soft_argmax(cells[[4]], grid, cells, 1.0, prior)[0]
    share = (found - grid[2]).norm() / (grid[5] - grid[2]).norm()
    assert 0 < float(share) < 1
    assert torch.allclose(found, grid[2] + share * (grid[5] - grid[2]), atol=1e-5)
