"""Volume rendering of the signed distance field (BANMo, equations 2, 3, 9; VolSDF's Laplace density).

Depths are z in camera space along directions with unit z. Axes: ray R, sample S.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def laplace_density(sdf: Tensor, beta: Tensor | float) -> Tensor:
    """sigma = Gamma_beta(-d) / beta, Gamma the Laplace cumulative distribution (section 3.1); 1/units."""
    beta = torch.as_tensor(beta, dtype=sdf.dtype, device=sdf.device)
    tail = 0.5 * torch.exp(-sdf.abs() / beta)
    return torch.where(sdf > 0, tail, 1 - tail) / beta


def edge_offset(beta: float, radius: float = 0.1) -> float:
    """How far outside the zero level a silhouette's edge (opacity one half) would lie, in units.

    A ray that passes a surface of curvature `radius` at distance d gathers about
    ``exp(-d / beta) / (2 beta) * sqrt(2 pi radius beta)`` of optical depth; it is ln 2 at the offset. Rendering the
    field shifted by it puts the silhouette on the zero level, so that shapes do not come out thin.
    """
    return beta * math.log(max(math.sqrt(2 * math.pi * radius / beta) / (2 * math.log(2)), 1.0))


def ray_weights(density: Tensor, lengths: Tensor) -> Tensor:
    """tau_i = prod_{j<i} p_j (1 - p_i) with p_i = exp(-sigma_i delta_i) (equation 2), (R, S) from (R, S), (R, S)."""
    optical = density * lengths
    before = torch.cumsum(optical, -1) - optical
    return torch.exp(-before) * (1 - torch.exp(-optical))


def uniform_depths(near: Tensor, far: Tensor, samples: int, jitter: Tensor | None) -> Tensor:
    """Stratified depths (R, samples) between near (R,) and far (R,); `jitter` (R, samples) in 0..1, else centres."""
    step = 0.5 if jitter is None else jitter
    unit = (torch.arange(samples, device=near.device, dtype=near.dtype) + step) / samples
    return near[:, None] + (far - near)[:, None] * unit


def importance_depths(edges: Tensor, weights: Tensor, samples: int, jitter: Tensor | None) -> Tensor:
    """Depths (R, samples) drawn from the piecewise constant density `weights` (R, S) on `edges` (R, S + 1), sorted.

    `jitter` (R, samples) in 0..1 stratifies; None takes the strata's centres.
    """
    step = 0.5 if jitter is None else jitter
    unit = (torch.arange(samples, device=edges.device, dtype=edges.dtype) + step) / samples
    unit = unit.expand(len(edges), samples).contiguous()
    cumulative = torch.cumsum(weights, -1)
    cumulative = cumulative / cumulative[:, -1:].clamp_min(1e-12)
    cumulative = torch.cat([torch.zeros_like(cumulative[:, :1]), cumulative], -1)
    right = torch.searchsorted(cumulative, unit, right=True).clamp(1, weights.shape[1])
    low, high = cumulative.gather(1, right - 1), cumulative.gather(1, right)
    share = ((unit - low) / (high - low).clamp_min(1e-8)).clamp(0, 1)
    start, end = edges.gather(1, right - 1), edges.gather(1, right)
    return start + share * (end - start)


def dilate(weights: Tensor) -> Tensor:
    """Each weight (R, S) takes the largest of its neighbours': the surface may lie in the next cell."""
    return torch.nn.functional.max_pool1d(weights[:, None], 3, stride=1, padding=1)[:, 0]


def interval_lengths(depths: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """Length (R, S) of the ray that each sorted depth (R, S) stands for: up to midway to its neighbours."""
    middle = (depths[:, 1:] + depths[:, :-1]) / 2
    edges = torch.cat([near[:, None], middle, far[:, None]], 1)
    return (edges[:, 1:] - edges[:, :-1]).clamp_min(0)
