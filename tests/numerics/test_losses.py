"""Every term of the objective against a loop, a closed form or a finite difference."""

from __future__ import annotations

import math
from itertools import permutations

import pytest
import torch

from stages.model import losses


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def weights(*shape: int, seed: int = 9) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# ---------------------------------------------------------------------------------------------- per ray


def test_colour_loss_loop() -> None:
    a, b, w = draw(5, 3), draw(5, 3, seed=1), weights(5)
    expected = sum(float(w[r]) * sum(abs(float(a[r, c] - b[r, c])) for c in range(3)) / 3 for r in range(5)) / 5
    assert float(losses.colour_loss(a, b, w)) == pytest.approx(expected)


def test_silhouette_loss_loop() -> None:
    a, b, w = weights(6, seed=1), weights(6, seed=2), weights(6)
    expected = sum(float(w[r]) * float(a[r] - b[r]) ** 2 for r in range(6)) / 6
    assert float(losses.silhouette_loss(a, b, w)) == pytest.approx(expected)


def test_huber_is_quadratic_then_linear_then_flat() -> None:
    error = torch.tensor([0.0, 0.2, 0.5, 1.5, 8.0, 50.0], dtype=torch.float64)
    expected = [0.0, 0.2**2 / (2 * 0.5), 0.25, 1.5 - 0.25, 7.75, 7.75]
    assert losses.huber(error, 0.5, 8.0).tolist() == pytest.approx(expected)
    beyond = torch.tensor([9.0], requires_grad=True)
    losses.huber(beyond, 0.5, 8.0).sum().backward()
    assert float(beyond.grad) == 0.0  # hopeless flow pulls nowhere


def test_flow_loss_loop() -> None:
    a, b, w = 3 * draw(6, 2), 3 * draw(6, 2, seed=1), weights(6)
    total = 0.0
    for r in range(6):
        error = math.hypot(float(a[r, 0] - b[r, 0]), float(a[r, 1] - b[r, 1]))
        total += float(w[r]) * (error**2 if error < 0.5 else min(error, 8.0) - 0.25)
    assert float(losses.flow_loss(a, b, w)) == pytest.approx(total / 6, rel=1e-4)


def test_feature_and_match_losses_loop() -> None:
    a, b, w = draw(4, 16), draw(4, 16, seed=1), weights(4)
    expected = sum(float(w[r]) * sum(float(a[r, c] - b[r, c]) ** 2 for c in range(16)) for r in range(4)) / 4
    assert float(losses.feature_loss(a, b, w)) == pytest.approx(expected)
    expected = sum(float(w[r]) * sum(float(a[r, c] - b[r, c]) ** 2 for c in range(3)) for r in range(4)) / 4
    assert float(losses.match_loss(a[:, :3], b[:, :3], w)) == pytest.approx(expected)


def test_cycle_2d_loss_loop() -> None:
    a, b, w = 100 * draw(5, 2), 100 * draw(5, 2, seed=1), weights(5)
    total = 0.0
    for r in range(5):
        total += float(w[r]) * min(1.0, math.dist(a[r].tolist(), b[r].tolist()) / 200)
    assert float(losses.cycle_2d_loss(a, b, w, 200)) == pytest.approx(total / 5, rel=1e-6)


def test_cycle_3d_loss_loop() -> None:
    a, b, w = draw(3, 4, 3), draw(3, 4, 3, seed=1), weights(3, 4)
    total = sum(float(w[r, s]) * math.dist(a[r, s].tolist(), b[r, s].tolist()) for r in range(3) for s in range(4))
    assert float(losses.cycle_3d_loss(a, b, w)) == pytest.approx(total / 3, rel=1e-6)


@pytest.mark.parametrize("weight", [0.0, 0.5])
def test_a_term_is_divided_by_a_fixed_count(weight: float) -> None:
    """Rays that no longer count do not make the others count more."""
    a, b = weights(4, seed=1), weights(4, seed=2)
    w = torch.ones(4, dtype=torch.float64)
    less = w.clone()
    less[2:] = weight
    whole = (a - b).square()
    expected = (whole[:2].sum() + weight * whole[2:].sum()) / 4
    assert float(losses.silhouette_loss(a, b, less)) == pytest.approx(float(expected))


# ---------------------------------------------------------------------------------------------- shape


def nodes(counts: tuple[int, int, int], spacing: torch.Tensor) -> torch.Tensor:
    """Positions (Z, Y, X, 3) of a grid about the origin."""
    axes = [(torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * spacing[k] for k, n in enumerate(counts)]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return torch.stack([x, y, z], -1)


SPACING = torch.tensor([0.05, 0.04, 0.06], dtype=torch.float64)


def test_eikonal_is_zero_for_a_plane_and_small_for_a_sphere() -> None:
    points = nodes((14, 16, 12), SPACING)
    normal = torch.nn.functional.normalize(torch.tensor([1.0, -2, 0.5]).double(), dim=0)
    assert float(losses.eikonal_loss(points @ normal - 0.1, SPACING, 0.15)) < 1e-9
    assert float(losses.eikonal_loss(points.norm(dim=-1) - 0.25, SPACING, 0.15)) < 0.02
    assert float(losses.eikonal_loss(3 * (points @ normal), SPACING, 0.15)) == pytest.approx(4, rel=1e-6)


def test_eikonal_loop() -> None:
    grid = 0.2 * draw(4, 5, 6)
    total, count = 0.0, 0
    for z in range(3):
        for y in range(4):
            for x in range(5):
                if abs(float(grid[z, y, x])) < 0.15:
                    g = [
                        float(grid[z, y, x + 1] - grid[z, y, x]) / float(SPACING[0]),
                        float(grid[z, y + 1, x] - grid[z, y, x]) / float(SPACING[1]),
                        float(grid[z + 1, y, x] - grid[z, y, x]) / float(SPACING[2]),
                    ]
                    total += (math.sqrt(sum(v * v for v in g)) - 1) ** 2
                    count += 1
    assert count > 5
    assert float(losses.eikonal_loss(grid, SPACING, 0.15)) == pytest.approx(total / count, rel=1e-6)


def test_smoothness_is_zero_for_a_plane() -> None:
    points = nodes((8, 9, 7), SPACING)
    assert float(losses.smoothness_loss(points @ torch.tensor([0.3, -2.0, 1.0]).double(), SPACING, 0.2)) < 1e-20


def test_smoothness_loop() -> None:
    grid = 0.2 * draw(4, 5, 6)
    near = grid.abs() < 0.15
    total = 0.0
    shape = grid.shape
    for z in range(shape[0]):
        for y in range(shape[1]):
            for x in range(shape[2]):
                for axis, step in ((2, SPACING[0]), (1, SPACING[1]), (0, SPACING[2])):
                    node = [z, y, x]
                    if not near[z, y, x] or not 0 < node[axis] < shape[axis] - 1:
                        continue
                    up, down = list(node), list(node)
                    up[axis] += 1
                    down[axis] -= 1
                    second = float(grid[tuple(up)] + grid[tuple(down)] - 2 * grid[z, y, x]) / float(step)
                    total += second**2
    assert float(losses.smoothness_loss(grid, SPACING, 0.15)) == pytest.approx(total / int(near.sum()), rel=1e-9)


def test_shape_terms_are_finite_without_a_surface() -> None:
    grid = torch.full((4, 4, 4), 5.0, dtype=torch.float64, requires_grad=True)
    total = losses.eikonal_loss(grid, SPACING, 0.1) + losses.smoothness_loss(grid, SPACING, 0.1)
    total.backward()
    assert float(total.detach()) == 0.0 and torch.isfinite(grid.grad).all()


# ---------------------------------------------------------------------------------------------- bones


def test_sinkhorn_divergence_of_a_set_from_itself_is_zero() -> None:
    a = draw(12, 3)
    assert float(losses.sinkhorn_divergence(a, a, 0.05)) == pytest.approx(0, abs=1e-12)
    assert float(losses.sinkhorn_divergence(a, a[torch.randperm(12)], 0.05)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("shift", [0.05, 0.3, 1.0])
def test_sinkhorn_divergence_of_a_translation_is_half_its_square(shift: float) -> None:
    a = draw(20, 3)
    t = shift * torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -2.0]).double(), dim=0)
    found = float(losses.sinkhorn_divergence(a, a + t, 0.05, sweeps=200))
    assert found == pytest.approx(shift**2 / 2, rel=0.02)


def test_sinkhorn_tends_to_the_best_assignment() -> None:
    a, b = draw(4, 3), draw(4, 3, seed=1)
    cost = 0.5 * torch.cdist(a, b).square()
    best = min(sum(float(cost[i, p[i]]) for i in range(4)) for p in permutations(range(4))) / 4
    assert float(losses.sinkhorn_divergence(a, b, 0.02, sweeps=400)) == pytest.approx(best, rel=0.02)


def test_sinkhorn_gradient_is_the_finite_difference() -> None:
    a, b = draw(6, 3).requires_grad_(), draw(9, 3, seed=1)
    (gradient,) = torch.autograd.grad(losses.sinkhorn_divergence(a, b, 0.3, sweeps=300), a)
    step = 1e-4
    for n, k in ((0, 0), (2, 1), (5, 2)):
        moved = a.detach().clone()
        moved[n, k] += step
        ahead = float(losses.sinkhorn_divergence(moved, b, 0.3, sweeps=300))
        moved[n, k] -= 2 * step
        behind = float(losses.sinkhorn_divergence(moved, b, 0.3, sweeps=300))
        assert (ahead - behind) / (2 * step) == pytest.approx(float(gradient[n, k]), rel=2e-2, abs=2e-4)


def test_following_the_sinkhorn_gradient_brings_bones_to_the_surface() -> None:
    """With the sweeps that training uses."""
    surface = torch.nn.functional.normalize(draw(60, 3), dim=1)
    bones = (0.2 * draw(8, 3, seed=1) + torch.tensor([2.0, 0, 0])).requires_grad_()
    optimiser = torch.optim.Adam([bones], lr=0.15)
    before = float(losses.sinkhorn_divergence(bones, surface, 0.05).detach())
    for _ in range(20):
        optimiser.zero_grad()
        losses.sinkhorn_divergence(bones, surface, 0.05).backward()
        optimiser.step()
    assert float(losses.sinkhorn_divergence(bones, surface, 0.05).detach()) < 0.1 * before


# ---------------------------------------------------------------------------------------------- time


def test_second_difference_loop_within_videos() -> None:
    values, video = draw(9, 2, 3), torch.tensor([0, 0, 0, 0, 1, 1, 2, 2, 2])
    total, count = 0.0, 0
    for t in range(1, 8):
        if video[t - 1] == video[t + 1]:
            total += float((values[t + 1] - 2 * values[t] + values[t - 1]).square().sum())
            count += 1
    assert count == 3
    assert float(losses.second_difference(values, video)) == pytest.approx(total / count)
    steady = torch.arange(9, dtype=torch.float64)[:, None] * 0.3
    assert float(losses.second_difference(steady, torch.zeros(9))) == pytest.approx(0, abs=1e-20)


def test_coverage_pulls_the_nearest_point_of_pixels_that_nothing_covers() -> None:
    placed = torch.tensor([[[10.0, 10.0], [40.0, 10.0], [90.0, 90.0]]], requires_grad=True)
    pixels = torch.tensor([[[15.0, 10.0], [40.0, 22.0], [41.0, 10.0], [10.0, 10.5]]])
    weight = torch.tensor([[1.0, 1.0, 0.0, 1.0]])
    value = losses.coverage_loss(placed, pixels, weight, cap_px=8.0)
    value.backward()
    # 5 px is beyond the corner of 2, 12 px beyond the cap of 8, half a pixel inside the corner; one pixel is covered
    assert float(value) == pytest.approx(((5 - 1) + (8 - 1) + 0.5**2 / 4) / 4, rel=1e-3)
    assert placed.grad is not None
    assert float(placed.grad[0, 0, 0]) < 0 and placed.grad[0, 1].abs().max() == 0 and placed.grad[0, 2].abs().max() == 0


def test_spill_pulls_points_beside_the_mask_back_onto_it() -> None:
    # A mask that fills the left 10 columns of a 40 x 20 map; a cell is two pixels of the frame wide.
    column = torch.arange(40, dtype=torch.float32)
    beside = (2 * (column - 9).clamp_min(0)).expand(1, 20, 40)
    placed = torch.tensor([[[5.0, 10.0], [14.5, 10.0], [10.0, 10.0], [38.5, 10.0], [60.0, 10.0]]], requires_grad=True)
    value = losses.spill_loss(placed, beside, torch.tensor([[0.5]]), cap_px=30.0)
    value.backward()
    # on the mask; 10 px beside it; 1 px (between two cells); 58 px, beyond the cap; beyond the picture
    assert float(value) == pytest.approx(0.5 * (0 + (10 - 1) + 1 / 4 + (30 - 1) + 0) / 5)
    assert placed.grad is not None
    pull = placed.grad[0]
    assert float(pull[1, 0]) == pytest.approx(0.5 * 2 / 5) and float(pull[2, 0]) > 0
    assert pull[0].abs().max() == 0 and pull[3].abs().max() == 0 and pull[4].abs().max() == 0
    assert pull[:, 1].abs().max() == 0
