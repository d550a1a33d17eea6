"""Volume rendering: the Laplace density, the paper's product of transmittances, sampling, the silhouette's edge."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from stages.model.rendering import (
    dilate,
    edge_offset,
    importance_depths,
    interval_lengths,
    laplace_density,
    ray_weights,
    uniform_depths,
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("beta", [0.005, 0.04, 0.3])
def test_density_is_the_laplace_cumulative_of_the_negated_distance(beta: float) -> None:
    sdf = torch.linspace(-1, 1, 201, dtype=torch.float64)
    cumulative = torch.distributions.Laplace(torch.zeros((), dtype=torch.float64), beta).cdf(-sdf)
    assert torch.allclose(laplace_density(sdf, beta) * beta, cumulative, atol=1e-12)
    assert float(laplace_density(torch.zeros(1), beta)) == pytest.approx(0.5 / beta)


def test_density_tends_to_a_solid_as_beta_goes_to_zero() -> None:
    sdf = torch.tensor([-0.1, -0.01, 0.01, 0.1], dtype=torch.float64)
    for beta in (1e-2, 1e-3, 1e-4):
        scaled = laplace_density(sdf, beta) * beta
        expected = (sdf < 0).double()
        assert (scaled - expected).abs().max() <= 0.5 * math.exp(-0.01 / beta) + 1e-12


def test_density_gradient_is_the_laplace_density() -> None:
    sdf = torch.tensor([-0.2, -0.03, 0.01, 0.3], dtype=torch.float64, requires_grad=True)
    laplace_density(sdf, 0.05).sum().backward()
    expected = -torch.exp(-sdf.detach().abs() / 0.05) / (2 * 0.05**2)
    assert torch.allclose(sdf.grad, expected)


def test_ray_weights_are_the_product_of_transmittances() -> None:
    density = torch.rand(4, 9, generator=seeded(), dtype=torch.float64) * 20
    lengths = torch.rand(4, 9, generator=seeded(1), dtype=torch.float64) * 0.2
    found = ray_weights(density, lengths)
    for r in range(4):
        for i in range(9):
            expected = 1.0
            for j in range(i):
                expected *= math.exp(-float(density[r, j] * lengths[r, j]))
            expected *= 1 - math.exp(-float(density[r, i] * lengths[r, i]))
            assert float(found[r, i]) == pytest.approx(expected, abs=1e-12)
    total = found.sum(1)
    assert torch.allclose(total, 1 - torch.exp(-(density * lengths).sum(1)))
    assert (total <= 1).all()


def test_weights_never_sum_to_more_than_one() -> None:
    density = torch.rand(50, 30, generator=seeded(2)) * 1e4
    assert (ray_weights(density, torch.full_like(density, 0.1)).sum(1) <= 1 + 1e-6).all()
    assert (ray_weights(torch.zeros(2, 5), torch.ones(2, 5)) == 0).all()


def test_uniform_depths_are_one_a_stratum() -> None:
    near, far = torch.tensor([1.0, 2.0]), torch.tensor([3.0, 2.5])
    centres = uniform_depths(near, far, 4, None)
    assert torch.allclose(centres[0], torch.tensor([1.25, 1.75, 2.25, 2.75]))
    jittered = uniform_depths(near, far, 4, torch.rand(2, 4, generator=seeded()))
    edges = near[:, None] + (far - near)[:, None] * torch.arange(5) / 4
    assert ((jittered >= edges[:, :-1]) & (jittered <= edges[:, 1:])).all()


def test_importance_depths_follow_the_weights() -> None:
    edges = torch.tensor([[0.0, 1, 3, 3.5, 7]])
    weights = torch.tensor([[1.0, 0.0, 5.0, 2.0]])
    depths = importance_depths(edges, weights, 8000, torch.rand(1, 8000, generator=seeded()))
    assert (depths[:, 1:] >= depths[:, :-1]).all()
    share = torch.histogram(depths[0], edges[0]).hist / 8000
    assert torch.allclose(share, weights[0] / 8, atol=2e-3)
    last = depths[depths > 3.5]  # uniform inside a cell
    assert float(last.mean()) == pytest.approx(5.25, abs=0.01)
    assert float(last.std()) == pytest.approx(3.5 / math.sqrt(12), abs=0.01)
    quantiles = importance_depths(edges, weights, 8, None)
    assert torch.allclose(quantiles[0, [0, 1, 5]], torch.tensor([0.5, 3.05, 3.45]), atol=1e-5)


def test_importance_depths_of_nothing_stay_on_the_ray() -> None:
    edges = torch.tensor([[1.0, 2, 3]])
    depths = importance_depths(edges, torch.zeros(1, 2), 5, None)
    assert torch.isfinite(depths).all() and ((depths >= 1) & (depths <= 3)).all()


def test_dilate_takes_the_largest_of_three() -> None:
    weights = torch.rand(3, 7, generator=seeded())
    for r in range(3):
        for i in range(7):
            expected = float(weights[r, max(0, i - 1) : i + 2].max())
            assert float(dilate(weights)[r, i]) == expected


def test_interval_lengths_cover_the_ray_once() -> None:
    depths = torch.sort(torch.rand(3, 6, generator=seeded()) + 1, dim=1).values
    near, far = torch.ones(3), torch.full((3,), 2.0)
    lengths = interval_lengths(depths, near, far)
    assert torch.allclose(lengths.sum(1), far - near)
    assert float(lengths[0, 0]) == pytest.approx(float((depths[0, 0] + depths[0, 1]) / 2 - 1), abs=1e-6)
    assert float(lengths[0, 2]) == pytest.approx(float((depths[0, 3] - depths[0, 1]) / 2), abs=1e-6)


def opacity_at(distance: float, sdf: Callable[[torch.Tensor], torch.Tensor], beta: float) -> float:
    """Opacity of a ray along z that passes the z axis at x = `distance`, by fine quadrature."""
    z = torch.linspace(-1, 1, 20001, dtype=torch.float64)
    points = torch.stack([torch.full_like(z, distance), torch.zeros_like(z), z], -1)
    density = laplace_density(sdf(points) + edge_offset(beta), beta)[None]
    return float(ray_weights(density, torch.full_like(density, 1e-4)).sum())


@pytest.mark.parametrize("beta", [0.003, 0.006, 0.012, 0.025])
@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_silhouettes_edge_lies_on_the_surface(beta: float, shape: str) -> None:
    """Opacity one half within a fraction of beta of the zero level: for the radius the offset is made for."""
    radius = 0.1
    axes = 3 if shape == "sphere" else [0, 2]  # a cylinder along y

    def sdf(points: torch.Tensor) -> torch.Tensor:
        return (points if axes == 3 else points[:, axes]).norm(dim=1) - radius

    low, high = radius - 4 * beta, radius + 4 * beta
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if opacity_at(middle, sdf, beta) > 0.5 else (low, middle)
    assert low == pytest.approx(radius, abs=0.5 * beta)
    if beta <= 0.012:
        assert opacity_at(radius, sdf, beta) == pytest.approx(0.5, abs=0.12)
    assert opacity_at(radius - 4 * beta, sdf, beta) > 0.9
    assert opacity_at(radius + 4 * beta, sdf, beta) < 0.1


def test_edge_offset_is_none_for_soft_fields_and_grows_with_radius() -> None:
    assert edge_offset(10.0) == 0.0
    assert 0 < edge_offset(0.01, 0.05) < edge_offset(0.01, 0.2)
    for beta in (0.005, 0.02):
        optical = math.exp(-edge_offset(beta) / beta) / (2 * beta) * math.sqrt(2 * math.pi * 0.1 * beta)
        assert optical == pytest.approx(math.log(2))
