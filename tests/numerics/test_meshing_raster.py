"""The rasteriser against slow loops and closed forms."""

import numpy as np
import pytest

from stages.geometry.raster import project, rasterise, vertex_normals

INTRINSICS = np.array([[40.0, 0, 17.3], [0, 42.0, 14.8], [0, 0, 1]])


def sphere(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit sphere of quads cut in two, counter-clockwise from outside."""
    theta = np.pi * np.arange(1, rows) / rows
    phi = 2 * np.pi * np.arange(columns) / columns
    ring = np.stack(
        [
            np.sin(theta)[:, None] * np.cos(phi),
            np.cos(theta)[:, None] + 0 * phi,
            -np.sin(theta)[:, None] * np.sin(phi),
        ],
        axis=-1,
    )
    vertices = np.concatenate([[[0, 1, 0]], ring.reshape(-1, 3), [[0, -1, 0]]])
    faces = []
    for j in range(columns):
        k = (j + 1) % columns
        faces.append([0, 1 + j, 1 + k])
        for i in range(rows - 2):
            a, b = 1 + i * columns, 1 + (i + 1) * columns
            faces += [[a + j, b + j, b + k], [a + j, b + k, a + k]]
        last = 1 + (rows - 2) * columns
        faces.append([last + j, len(vertices) - 1, last + k])
    return vertices, np.array(faces)


def slow_depth(vertices: np.ndarray, faces: np.ndarray, height: int, width: int) -> np.ndarray:
    """Depth by intersecting the ray of every pixel with every triangle (Cramer's rule)."""
    depth = np.full((height, width), np.inf)
    for row in range(height):
        for column in range(width):
            ray = np.linalg.solve(INTRINSICS, [column + 0.5, row + 0.5, 1.0])
            for a, b, c in vertices[faces]:
                matrix = np.stack([a - b, a - c, ray], axis=1)
                if abs(np.linalg.det(matrix)) < 1e-12:
                    continue
                u, v, distance = np.linalg.solve(matrix, a)
                if u >= 0 and v >= 0 and u + v <= 1 and distance > 0:
                    depth[row, column] = min(depth[row, column], distance)
    return depth


def test_depth_equals_the_slow_ray_caster() -> None:
    rng = np.random.default_rng(0)
    vertices = rng.uniform(-1, 1, (24, 3)) + np.array([0, 0, 3.0])
    faces = np.arange(24).reshape(8, 3)
    fast = rasterise(vertices, faces, INTRINSICS, 30, 34, cull_back=False).depth
    slow = slow_depth(vertices, faces, 30, 34)
    agree = np.isfinite(fast) == np.isfinite(slow)
    assert agree.mean() > 0.998  # a pixel centre on an edge may fall either way
    both = np.isfinite(fast) & np.isfinite(slow)
    assert both.sum() > 200
    assert np.abs(fast[both] - slow[both]).max() < 1e-4


def test_a_closed_mesh_has_no_cracks_and_culling_changes_nothing() -> None:
    vertices, faces = sphere(60, 90)
    vertices = vertices + np.array([0.1, -0.05, 3.0])
    k = np.array([[160.0, 0, 64], [0, 160.0, 64], [0, 0, 1]])
    culled = rasterise(vertices, faces, k, 128, 128)
    whole = rasterise(vertices, faces, k, 128, 128, cull_back=False)
    assert len(faces) > 8192
    np.testing.assert_array_equal(culled.covered, whole.covered)
    np.testing.assert_allclose(culled.depth, whole.depth, atol=1e-5)
    columns, rows = np.meshgrid(np.arange(128) + 0.5, np.arange(128) + 0.5)
    rays = np.stack([(columns - 64) / 160, (rows - 64) / 160, np.ones_like(rows)], axis=-1)
    centre = np.array([0.1, -0.05, 3.0])
    along = (rays @ centre) / np.linalg.norm(rays, axis=-1)
    miss = np.sqrt(np.maximum((centre**2).sum() - along**2, 0))
    assert culled.covered[miss < 0.99].all()
    assert not culled.covered[miss > 1.001].any()


def test_attributes_are_interpolated_perspective_correctly() -> None:
    vertices = np.array([[-1.0, -1, 2], [1, -1, 5], [-1, 1, 3], [1.2, 1, 2.5]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    fragments = rasterise(vertices, faces, INTRINSICS, 30, 34, cull_back=False)
    image = fragments.interpolate(faces, vertices, background=-7.0)
    rows, columns = np.nonzero(fragments.covered)
    assert len(rows) > 100
    seen = project(image[rows, columns].astype(float), INTRINSICS)
    np.testing.assert_allclose(seen, np.stack([columns + 0.5, rows + 0.5], axis=1), atol=2e-3)
    np.testing.assert_allclose(image[rows, columns, 2], fragments.depth[rows, columns], rtol=1e-5)
    assert (image[~fragments.covered] == -7).all()


@pytest.mark.parametrize("offset", [(0, 0, -3.0), (50, 0, 3.0)])
def test_what_is_behind_or_beside_the_camera_is_not_drawn(offset: tuple[float, float, float]) -> None:
    vertices, faces = sphere(6, 8)
    fragments = rasterise(vertices + np.array(offset), faces, INTRINSICS, 30, 34)
    assert not fragments.covered.any()
    assert np.isinf(fragments.depth).all()


def test_normals_of_a_sphere_point_outward() -> None:
    vertices, faces = sphere(30, 40)
    normals = vertex_normals(vertices, faces)
    assert ((normals * vertices).sum(axis=1) > 0.99).all()
    lonely = vertex_normals(np.concatenate([vertices, [[9.0, 9, 9]]]), faces)[-1]
    np.testing.assert_array_equal(lonely, [0, 1, 0])
