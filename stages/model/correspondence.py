"""Canonical embeddings and pixel-to-surface matching (BANMo, section 3.3, equation 10)."""

from __future__ import annotations

import torch
from torch import Tensor


def match_grid(bounds: Tensor, per_axis: int = 20) -> Tensor:
    """The canonical grid V* (per_axis^3, 3): cell centres of the box `bounds` (2, 3)."""
    unit = (torch.arange(per_axis, device=bounds.device, dtype=bounds.dtype) + 0.5) / per_axis
    axes = [bounds[0, k] + (bounds[1, k] - bounds[0, k]) * unit for k in range(3)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    return torch.stack([x, y, z], -1).reshape(-1, 3)


def cells_near(surface: Tensor, per_axis: int = 20) -> Tensor:
    """Cells (C, 3) of the canonical grid over the box of `surface` (N, 3) that lie on it, to a cell and a half.

    Cells away from the surface carry no mass, as the paper's trained embeddings would make them.
    """
    low, high = surface.amin(0), surface.amax(0)
    grid = match_grid(torch.stack([low, high]), per_axis)
    gap = torch.cdist(grid, surface[:: max(1, len(surface) // 512)]).amin(1)
    return grid[gap < 1.5 * (high - low).max() / per_axis]


def soft_argmax(
    pixel_features: Tensor, grid: Tensor, grid_features: Tensor, temperature: Tensor | float, prior: Tensor | None
) -> Tensor:
    """X*(x) = sum_V softmax_V(alpha <psi_I(x), psi(V)>) V (equation 10).

    `pixel_features` (P, 16) and `grid_features` (V, 16) of unit length, `grid` (V, 3), `temperature` = alpha,
    `prior` (V,) log-weights: cells off the surface carry no mass. Returns (P, 3).
    """
    scores = temperature * (pixel_features @ grid_features.T)
    if prior is not None:
        scores = scores + prior
    return scores.softmax(-1) @ grid
