"""Surface extraction and repair against closed forms."""

import numpy as np
import pytest
import torch
import trimesh

from stages.meshing.surface import (
    EmptySurface,
    Field,
    Mesh,
    boundary_loops,
    clean_surface,
    close_holes,
    decimate,
    extract,
    largest_component,
    weld,
)

BOUNDS = np.array([[-1.5, -1.4, -1.3], [1.5, 1.4, 1.3]])


def ball(centre: tuple[float, float, float], radius: float) -> Field:
    return lambda p: (p - torch.tensor(centre)).norm(dim=-1) - radius


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("resolution", [32, 64, 96])
def test_a_sphere_is_where_it_is_and_as_large_as_it_is(resolution: int) -> None:
    centre = (0.213, -0.137, 0.071)
    mesh = extract(ball(centre, 0.5), BOUNDS, resolution)
    step = 1.0 / resolution
    distance = np.linalg.norm(mesh.vertices - centre, axis=1) - 0.5
    assert np.abs(distance).max() < step**2 * 2  # second order, no half-voxel shift
    assert np.abs(solid(mesh).center_mass - centre).max() < 0.02 * step
    assert solid(mesh).is_watertight
    assert solid(mesh).volume == pytest.approx(4 / 3 * np.pi * 0.125, rel=20 * step**2)  # positive: turned outward


def test_thin_parts_survive_the_coarse_grid() -> None:
    """A rod thinner than a coarse cell is followed from the body out to its end."""

    def field(p: torch.Tensor) -> torch.Tensor:
        rod = p - torch.stack([p[:, 0].clamp(0, 1.2), torch.zeros(len(p)), torch.zeros(len(p))], -1)
        return torch.minimum(ball((0, 0, 0), 0.4)(p), rod.norm(dim=-1) - 0.015)

    mesh, dropped = largest_component(extract(field, BOUNDS, 192))
    assert mesh.vertices[:, 0].max() == pytest.approx(1.215, abs=0.005)
    assert dropped == 0
    assert solid(mesh).is_watertight


def test_a_field_that_is_not_metric_is_followed_too() -> None:
    """Values five times too steep make the coarse band miss cells; sign changes on faces wake them."""
    mesh = extract(lambda p: 5 * ball((0, 0, 0), 0.9)(p), BOUNDS, 64)
    assert solid(mesh).is_watertight
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.9).max() < 2e-3


def test_what_leaves_the_bounds_is_capped() -> None:
    mesh = extract(lambda p: p[:, 1], BOUNDS, 32)  # the half space below y = 0
    assert solid(mesh).is_watertight
    assert solid(mesh).volume > 0
    assert mesh.vertices[:, 1].max() == pytest.approx(0, abs=1e-6)


def test_an_empty_field_is_refused_and_nan_counts_as_outside() -> None:
    with pytest.raises(EmptySurface):
        extract(lambda p: torch.ones(len(p)), BOUNDS, 32)
    with pytest.raises(EmptySurface):
        extract(lambda p: torch.full((len(p),), torch.nan), BOUNDS, 32)
    with pytest.raises(EmptySurface):
        extract(lambda p: ball((0, 0, 0), 0.0)(p).abs() + 1e-3, BOUNDS, 32)


def test_levels_grow_the_surface() -> None:
    mesh = extract(ball((0, 0, 0), 0.5), BOUNDS, 48, level=0.2)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.7).max() < 2e-3


def test_loose_pieces_are_left_out_and_counted() -> None:
    big, small = ball((-0.4, 0, 0), 0.5), ball((1.0, 0.9, 0), 0.2)
    raw = extract(lambda p: torch.minimum(big(p), small(p)), BOUNDS, 64)
    mesh, facts = clean_surface(raw, 800)
    assert facts.dropped_area == pytest.approx(0.04 / 0.29, rel=0.05)
    assert mesh.vertices[:, 0].max() < 0.2
    assert facts.faces == len(mesh.faces) <= 800
    assert solid(mesh).is_watertight
    assert np.abs(np.linalg.norm(mesh.vertices - [-0.4, 0, 0], axis=1) - 0.5).max() < 0.02


def test_decimation_leaves_small_meshes_alone() -> None:
    mesh = extract(ball((0, 0, 0), 0.5), BOUNDS, 16)
    assert decimate(mesh, 100_000) is mesh


def test_holes_are_found_and_filled_the_right_way_round() -> None:
    mesh = extract(ball((0, 0, 0), 0.5), BOUNDS, 24)
    low = mesh.vertices[mesh.faces][..., 2].max(axis=1) < 0.3
    high = mesh.vertices[mesh.faces][..., 2].min(axis=1) > -0.3
    open_mesh = Mesh(mesh.vertices, mesh.faces[low & high])
    assert len(boundary_loops(open_mesh.faces)) == 2
    closed, holes = close_holes(open_mesh)
    assert holes == 2
    assert solid(closed).is_watertight
    assert solid(closed).is_winding_consistent
    assert solid(closed).volume > 0.3
    assert close_holes(mesh)[1] == 0


def test_welding_merges_copies_and_drops_slivers() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [5, 5, 5]])
    faces = np.array([[0, 1, 2], [3, 5, 4], [0, 0, 1], [1, 2, 0]])
    mesh = weld(Mesh(vertices, faces))
    assert len(mesh.vertices) == 4
    assert len(mesh.faces) == 2


def test_the_same_field_gives_the_same_bytes() -> None:
    first, _ = clean_surface(extract(ball((0.1, 0, 0), 0.5), BOUNDS, 48), 500)
    second, _ = clean_surface(extract(ball((0.1, 0, 0), 0.5), BOUNDS, 48), 500)
    assert first.vertices.tobytes() == second.vertices.tobytes()
    assert first.faces.tobytes() == second.faces.tobytes()
