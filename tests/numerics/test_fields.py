"""The canonical field: what it is told is what it says, between nodes, beyond the box, and after resizing."""

from __future__ import annotations

import math

import pytest
import torch

from stages.model.fields import GridField, MlpField, outside_distance, positional_encoding

BOUNDS = torch.tensor([[-0.8, -0.6, -0.7], [0.8, 0.6, 0.9]])
RADIUS = 0.4


def sphere_sdf(points: torch.Tensor) -> torch.Tensor:
    return points.norm(dim=-1) - RADIUS


def sphere_field(voxel: float = 0.05) -> GridField:
    field = GridField(BOUNDS, voxel, 4)
    field.set_sdf(sphere_sdf(field.node_positions()))
    return field


def random_points(count: int, seed: int = 0, grow: float = 1.0) -> torch.Tensor:
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    middle, half = BOUNDS.mean(0), (BOUNDS[1] - BOUNDS[0]) / 2
    return middle + (2 * unit - 1) * half * grow


def slow_trilinear(grid: torch.Tensor, bounds: torch.Tensor, point: torch.Tensor) -> float:
    """Eight corners of the cell that holds `point`; grid (Z, Y, X)."""
    position = [
        float((point[k] - bounds[0, k]) / (bounds[1, k] - bounds[0, k])) * (grid.shape[2 - k] - 1) for k in range(3)
    ]
    total = 0.0
    for corner in range(8):
        weight, node = 1.0, []
        for k in range(3):
            low = min(int(position[k]), grid.shape[2 - k] - 2)
            share = position[k] - low
            up = corner >> k & 1
            weight *= share if up else 1 - share
            node.append(low + up)
        total += weight * float(grid[node[2], node[1], node[0]].detach())
    return total


def test_nodes_stand_at_equal_spacing_over_the_box() -> None:
    field = sphere_field()
    nodes = field.node_positions()
    assert torch.allclose(nodes[0, 0, 0], BOUNDS[0]) and torch.allclose(nodes[-1, -1, -1], BOUNDS[1])
    assert torch.allclose(nodes[1, 1, 1] - nodes[0, 0, 0], field.spacing, atol=1e-6)
    assert (field.spacing - 0.05).abs().max() < 0.01


def test_grid_says_what_it_was_set_to() -> None:
    field = sphere_field()
    nodes = field.node_positions().reshape(-1, 3)
    assert torch.allclose(field.sdf(field.prepare(), nodes), sphere_sdf(nodes), atol=1e-5)
    points = random_points(400)
    away = points.norm(dim=1) > 0.1  # the kink at the centre is rounded off
    found = field.sdf(field.prepare(), points)
    # linear interpolation errs by at most h^2 / 8 times the second derivatives' sum (2 / r)
    assert ((found - sphere_sdf(points)).abs() <= 3 * 0.05**2 / 8 * 2 / points.norm(dim=1))[away].all()


def test_sampling_is_trilinear() -> None:
    field = sphere_field()
    with torch.no_grad():
        for grid in (*field.sdf_grids, *field.colour_grids):
            grid.normal_(generator=torch.Generator().manual_seed(2))
    prepared = field.prepare()
    points = random_points(20, 1, grow=0.999)
    with torch.no_grad():
        queried = field.query(prepared, points)
    assert torch.equal(queried.sdf, field.sdf(prepared, points))
    for n, point in enumerate(points):
        assert float(queried.sdf[n]) == pytest.approx(slow_trilinear(prepared[0, 0], BOUNDS, point), abs=1e-4)
        for c in range(3):
            expected = slow_trilinear(prepared[0, 1 + c], BOUNDS, point)
            assert float(queried.appearance[n, c]) == pytest.approx(expected, abs=1e-4)


def test_many_points_give_the_same_as_few() -> None:
    field = sphere_field()
    points = random_points(6000, 3)
    whole = field.sdf(field.prepare(), points)
    parts = torch.cat([field.sdf(field.prepare(), part) for part in points.split(999)])
    assert torch.allclose(whole, parts, atol=1e-6)


def test_gradient_of_sampling_is_the_finite_difference() -> None:
    field = sphere_field().double()
    field.bounds, field.spacing = field.bounds.double(), field.spacing.double()
    points = random_points(10, 4, grow=0.95).double().requires_grad_()
    prepared = field.prepare()
    weights = torch.randn(10, generator=torch.Generator().manual_seed(5)).double()
    value = (field.sdf(prepared, points) * weights).sum()
    by_points, by_fine, by_coarse = torch.autograd.grad(value, [points, field.sdf_grids[0], field.sdf_grids[-1]])
    step = 1e-6
    for n in range(3):
        for k in range(3):
            moved = points.detach().clone()
            moved[n, k] += step
            ahead = (field.sdf(prepared, moved) * weights).sum()
            moved[n, k] -= 2 * step
            behind = (field.sdf(prepared, moved) * weights).sum()
            assert float((ahead - behind).detach() / (2 * step)) == pytest.approx(float(by_points[n, k]), abs=1e-6)
    for grid, gradient in ((field.sdf_grids[0], by_fine), (field.sdf_grids[-1], by_coarse)):
        node = tuple(int(i) for i in torch.nonzero(gradient.abs() == gradient.abs().max())[0])
        with torch.no_grad():
            grid[node] += 1.0  # the field is linear in its grids: any step is exact
            ahead = (field.sdf(field.prepare(), points) * weights).sum()
            grid[node] -= 1.0
        assert float(ahead - value.detach()) == pytest.approx(float(gradient[node]), abs=1e-9)


def test_distance_goes_on_beyond_the_box() -> None:
    field = sphere_field()
    points = torch.tensor([[3.0, 0, 0], [0, -2.0, 0], [1.8, 1.6, 1.9], [0.1, 0.2, 0.3]])
    clamped = torch.minimum(torch.maximum(points, BOUNDS[0]), BOUNDS[1])
    gap = (points - clamped).norm(dim=1)
    assert torch.allclose(outside_distance(points, BOUNDS), gap, atol=2e-6)
    expected = field.sdf(field.prepare(), clamped) + gap
    assert torch.allclose(field.sdf(field.prepare(), points), expected, atol=1e-5)


@pytest.mark.parametrize(
    "bounds",
    [
        torch.tensor([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.55]]),
        torch.tensor([[-1.2, -0.9, -0.9], [1.0, 0.9, 1.1]]),
    ],
)
def test_resized_keeps_values_where_the_boxes_overlap(bounds: torch.Tensor) -> None:
    field = sphere_field(0.04)
    with torch.no_grad():
        for level, grid in enumerate(field.colour_grids):  # linear in x, y and z: no resampling error
            size = grid.shape[2:]
            axes = [torch.linspace(float(BOUNDS[0, k]), float(BOUNDS[1, k]), size[2 - k]) for k in range(3)]
            z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
            grid.copy_(torch.stack([x, y * 2, z + level])[None])
        field.embedding_grid.normal_(generator=torch.Generator().manual_seed(0))
        field.environment.weight.normal_()
    other = field.resized(bounds)
    assert torch.equal(other.bounds, bounds)
    points = random_points(300, 6)
    # a cell that straddles the old border bends there: stay a cell inside
    low, high = torch.maximum(bounds[0], BOUNDS[0]) + 0.05, torch.minimum(bounds[1], BOUNDS[1]) - 0.05
    points = points[((points > low) & (points < high)).all(1) & (points.norm(dim=1) > 0.15)]
    before, after = field.query(field.prepare(), points), other.query(other.prepare(), points)
    assert len(points) > 50
    assert (before.sdf - after.sdf).abs().max() < 3 * 0.04**2 / 0.15
    assert torch.allclose(before.appearance, after.appearance, atol=1e-4)
    assert torch.equal(other.environment.weight, field.environment.weight)
    far = points[points.norm(dim=1) > 0.3]
    assert (field.embedding(far) * other.embedding(far)).sum(1).mean() > 0.5  # random noise, resampled


def test_the_new_box_knows_the_distance_beyond_the_old_one() -> None:
    field = sphere_field()
    other = field.resized(torch.tensor([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]]))
    points = torch.tensor([[1.4, 0, 0], [0, 1.3, 0], [0.2, 0.1, -1.2]])
    assert torch.allclose(other.sdf(other.prepare(), points), sphere_sdf(points), atol=0.02)


def test_grid_shading_is_a_gain_and_a_bias_of_the_logit() -> None:
    field = sphere_field()
    generator = torch.Generator().manual_seed(0)
    appearance, light = torch.randn(5, 3, generator=generator), torch.randn(5, 4, generator=generator)
    nothing = torch.zeros(5, 3)
    assert torch.equal(field.shade(appearance, nothing, light), torch.sigmoid(appearance))
    with torch.no_grad():
        field.environment.weight.normal_(std=0.3, generator=generator)
        field.environment.bias.normal_(std=0.3, generator=generator)
    for n in range(5):
        six = field.environment.weight @ light[n] + field.environment.bias
        expected = torch.sigmoid(appearance[n] * torch.exp(six[:3].clamp(-2, 2)) + six[3:])
        assert torch.allclose(field.shade(appearance, nothing, light)[n], expected, atol=1e-6)


def test_embeddings_have_unit_length() -> None:
    points = random_points(50)
    field = sphere_field()
    with torch.no_grad():
        field.embedding_grid.normal_()
    for candidate in (field, MlpField(BOUNDS, 4, depth=4, width=32)):
        embedding = candidate.embedding(points)
        assert embedding.shape == (50, 16)
        assert torch.allclose(embedding.norm(dim=1), torch.ones(50), atol=1e-5)


def test_positional_encoding_term_by_term() -> None:
    x = torch.tensor([[0.2, -0.7]], dtype=torch.float64)
    expected = [0.2, -0.7]
    expected += [math.sin(2**k * math.pi * v) for v in (0.2, -0.7) for k in range(3)]
    expected += [math.cos(2**k * math.pi * v) for v in (0.2, -0.7) for k in range(3)]
    assert positional_encoding(x, 3)[0].tolist() == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(3))
def test_networks_begin_as_a_sphere_of_half_the_box(seed: int) -> None:
    bounds = torch.tensor([[-0.7, -0.5, -0.9], [0.9, 0.7, 1.1]])  # half of the longest edge is 1
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        field = MlpField(bounds, 4, depth=8, width=256)
    directions = torch.nn.functional.normalize(torch.randn(300, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    centre = bounds.mean(0)

    def along(radius: float) -> torch.Tensor:
        with torch.no_grad():
            return field.sdf(field.prepare(), centre + radius * directions)

    assert (along(0.05) < 0).all() and (along(0.95) > 0).all()
    # where the sign changes along each direction, and how fast the distance grows there
    radii = torch.linspace(0.05, 0.95, 46)
    signs = torch.stack([along(float(r)) for r in radii])
    crossing = radii[(signs > 0).float().argmax(0)]
    assert 0.35 < float(crossing.mean()) < 0.65
    assert float(crossing.std() / crossing.mean()) < 0.15
    assert (signs[1:] > signs[:-1]).float().mean() > 0.99
    slope = (along(0.7) - along(0.4)) / 0.3
    assert 0.6 < float(slope.mean()) < 1.4


def test_network_colour_sees_direction_and_light() -> None:
    field = MlpField(BOUNDS, 4, depth=4, width=32)
    points = random_points(6)
    appearance = field.query(field.prepare(), points).appearance
    ahead, light = torch.tensor([[0.0, 0, 1]]).expand(6, 3), torch.zeros(6, 4)
    colour = field.shade(appearance, ahead, light)
    assert ((colour > 0) & (colour < 1)).all()
    assert torch.allclose(colour, field.shade(appearance, 5 * ahead, light), atol=1e-6)
    assert not torch.allclose(colour, field.shade(appearance, -ahead, light), atol=1e-4)
    assert not torch.allclose(colour, field.shade(appearance, ahead, light + 1), atol=1e-4)


def test_coarse_grids_are_interpolated_as_torch_does_it() -> None:
    field = GridField(torch.tensor([[-1.0, -0.5, -0.4], [1.0, 0.6, 0.5]]), 0.07, 4)
    generator = torch.Generator().manual_seed(0)
    for grid in field.sdf_grids:
        torch.nn.init.normal_(grid, generator=generator)
    wanted = sum(
        torch.nn.functional.interpolate(grid, field.shape, mode="trilinear", align_corners=True)
        for grid in field.sdf_grids
    )
    assert len({grid.shape for grid in field.sdf_grids}) == 3
    assert torch.allclose(field.prepare()[:, :1], wanted, atol=1e-5)
