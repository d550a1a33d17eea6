"""From a signed distance field to a clean triangle mesh: coarse-to-fine marching cubes at level 0, then repair.

Sample i of an axis sits at ``origin + i * step`` exactly and marching cubes works between samples, so the surface
carries no half-voxel shift (the reference code's does). Meshes are (V, 3) float64 vertices and (F, 3) int64 faces,
counter-clockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import fast_simplification
import numpy as np
import torch
from scipy import ndimage, sparse
from skimage import measure

from stages.geometry.raster import face_normals

Field = Callable[[torch.Tensor], torch.Tensor]
"""Points (N, 3) float32 to values (N,)."""

_BLOCK = 4  # fine cells along the edge of a coarse cell
_CHUNK = 65_536


class EmptySurface(ValueError):
    """The field has no zero crossing inside its bounds."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: vertices (V, 3) float64, faces (F, 3) int64, counter-clockwise seen from outside."""

    vertices: np.ndarray
    faces: np.ndarray

    @property
    def area(self) -> float:
        """Surface area."""
        return float(np.linalg.norm(face_normals(self.vertices, self.faces), axis=1).sum() / 2)

    @property
    def length(self) -> float:
        """Longest edge of the axis-aligned box."""
        return float(np.ptp(self.vertices, axis=0).max())


def extract(sdf: Field, bounds: np.ndarray, resolution: int, level: float = 0.0) -> Mesh:
    """The level set of a field, by marching cubes on a grid that is fine only where the surface is.

    A coarse grid finds the box of the object; a second one over that box finds the cells that the surface may cross
    (a sign change at the corners, or a value smaller than the cell, as the field is about metric); blocks whose fine
    samples change sign on a face wake their neighbours until the surface is complete.

    Args:
        sdf: signed distance, negative inside.
        bounds: (2, 3) box of canonical space that holds the object; what touches it is capped there.
        resolution: fine cells along the longest edge of the object's box.
        level: value of the field that is the surface.

    Raises:
        EmptySurface: no crossing anywhere in the box.
    """
    lower, upper = np.asarray(bounds, np.float64)
    coarse = max(resolution // _BLOCK, 8)
    values, step = _sample_box(sdf, lower, upper, coarse)
    near = np.argwhere(values - level < 1.5 * step)
    if not (values < level).any() and not len(near):
        raise EmptySurface(f"the field is above {level:g} everywhere in its bounds (least value {values.min():.3g})")
    tight_lower = np.maximum(lower + (near.min(axis=0) - 1) * step, lower)
    tight_upper = np.minimum(lower + (near.max(axis=0) + 1) * step, upper)

    values, step = _sample_box(sdf, tight_lower, tight_upper, coarse)
    volume = _refine(sdf, tight_lower, values - level, step, level)
    if not (volume < 0).any():
        raise EmptySurface(f"the field is above {level:g} everywhere in its bounds (least value {values.min():.3g})")
    fine_step = step / _BLOCK
    # One layer of outside all round closes the surface where it meets the bounds.
    padded = np.pad(volume, 1, constant_values=fine_step)
    vertices, faces, _, _ = measure.marching_cubes(padded, 0.0, gradient_direction="descent", allow_degenerate=False)
    return weld(Mesh(tight_lower + (vertices.astype(np.float64) - 1) * fine_step, faces.astype(np.int64)))


def evaluate(field: Field, points: np.ndarray) -> np.ndarray:
    """A field at points (N, 3), in chunks: (N,) float32; what is not finite counts as outside."""
    parts = [
        field(torch.from_numpy(np.ascontiguousarray(points[i : i + _CHUNK], np.float32))).detach().cpu().numpy().ravel()
        for i in range(0, len(points), _CHUNK)
    ]
    return np.nan_to_num(np.concatenate(parts).astype(np.float32), nan=1.0, posinf=1.0, neginf=-1.0)


def _sample_box(sdf: Field, lower: np.ndarray, upper: np.ndarray, cells: int) -> tuple[np.ndarray, float]:
    """Sample a box on a cubic lattice of `cells` along its longest edge; the last sample may lie beyond the box."""
    step = float((upper - lower).max()) / cells
    shape = np.maximum(np.ceil((upper - lower) / step - 1e-9).astype(int), 1) + 1
    index = np.indices(shape).reshape(3, -1).T
    return evaluate(sdf, lower + index * step).reshape(shape), step


def _refine(sdf: Field, lower: np.ndarray, coarse: np.ndarray, step: float, level: float) -> np.ndarray:
    """Fine samples (4x a side) near the surface, interpolated coarse ones elsewhere."""
    fine_shape = (np.array(coarse.shape) - 1) * _BLOCK + 1
    positions = [np.arange(n) / _BLOCK for n in fine_shape]
    volume = _trilinear(coarse, positions)
    corners = _corners(coarse)
    active = (corners.min(axis=0) < 0) & (corners.max(axis=0) >= 0)
    active = ndimage.binary_dilation(active | (np.abs(corners).min(axis=0) < 0.9 * step))
    known = np.zeros(fine_shape, bool)
    pending = active
    while pending.any():
        wanted = _spread(pending, fine_shape) & ~known
        index = np.argwhere(wanted)
        volume[wanted] = evaluate(sdf, lower + index * (step / _BLOCK)) - level
        known |= wanted
        pending = _neighbours_crossed(volume, active) & ~active
        active = active | pending
    return volume


def _trilinear(coarse: np.ndarray, positions: list[np.ndarray]) -> np.ndarray:
    volume = coarse.astype(np.float32)
    for axis, position in enumerate(positions):
        low = np.minimum(position.astype(int), coarse.shape[axis] - 2)
        shape = [1, 1, 1]
        shape[axis] = -1
        weight = (position - low).astype(np.float32).reshape(shape)
        volume = np.take(volume, low, axis) * (1 - weight) + np.take(volume, low + 1, axis) * weight
    return volume


def _corners(values: np.ndarray) -> np.ndarray:
    """(8, ...) values at the corners of each cell."""
    ends = (slice(None, -1), slice(1, None))
    return np.stack([values[a, b, c] for a in ends for b in ends for c in ends])


def _spread(cells: np.ndarray, fine_shape: np.ndarray) -> np.ndarray:
    """Fine samples, boundary included, of the given coarse cells."""
    wanted = np.zeros(fine_shape, bool)
    inner = cells.repeat(_BLOCK, 0).repeat(_BLOCK, 1).repeat(_BLOCK, 2)
    wanted[:-1, :-1, :-1] = inner
    for axis in range(3):
        here, there = [slice(None)] * 3, [slice(None)] * 3
        here[axis], there[axis] = slice(1, None), slice(None, -1)
        wanted[tuple(here)] |= wanted[tuple(there)].copy()
    return wanted


def _neighbours_crossed(volume: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Cells one of whose six faces changes sign, where the cell across that face is active."""
    inside = volume < 0
    crossed = np.zeros_like(active)
    for axis in range(3):
        moved = np.moveaxis(inside, axis, 0)[::_BLOCK]  # the lattice planes between cells
        low, high = _window(moved, np.logical_and), _window(moved, np.logical_or)
        mixed = high & ~low  # (n + 1, m, k): the face holds both signs
        cells, out = np.moveaxis(active, axis, 0), np.moveaxis(crossed, axis, 0)
        out[1:] |= mixed[1:-1] & cells[:-1]
        out[:-1] |= mixed[1:-1] & cells[1:]
    return crossed


def _window(planes: np.ndarray, reduce: np.ufunc) -> np.ndarray:
    """Reduce each face of a cell (5 x 5 samples) to one value."""
    for axis in (1, 2):
        moved = np.moveaxis(planes, axis, 0)
        cells = (len(moved) - 1) // _BLOCK
        body = moved[:-1].reshape(cells, _BLOCK, *moved.shape[1:])
        planes = np.moveaxis(reduce(reduce.reduce(body, axis=1), moved[_BLOCK::_BLOCK]), 0, axis)
    return planes


# --------------------------------------------------------------------------------------------- repair


def weld(mesh: Mesh) -> Mesh:
    """Merge coincident vertices; drop degenerate and doubled faces and vertices without a face."""
    _, first, inverse = np.unique(np.round(mesh.vertices, 9), axis=0, return_index=True, return_inverse=True)
    faces = inverse.ravel()[mesh.faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[proper]
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return compact(Mesh(mesh.vertices[first], faces[np.sort(kept)]))


def compact(mesh: Mesh) -> Mesh:
    """Drop vertices that no face uses."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3))


def largest_component(mesh: Mesh) -> tuple[Mesh, float]:
    """The connected part with most area, and the share of the area that was left behind."""
    edges = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(mesh.vertices),) * 2)
    count, label = sparse.csgraph.connected_components(graph, directed=False)
    if count <= 1:
        return mesh, 0.0
    face_label = label[mesh.faces[:, 0]]
    area = np.bincount(face_label, np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1), minlength=count)
    best = int(area.argmax())
    return compact(Mesh(mesh.vertices, mesh.faces[face_label == best])), float(1 - area[best] / max(area.sum(), 1e-30))


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed chains of edges that belong to one face only, each in the order that closes the surface."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, inverse, count = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    open_edges = directed[count[inverse.ravel()] == 1]
    follow: dict[int, list[int]] = {}
    for a, b in open_edges.tolist():
        follow.setdefault(b, []).append(a)  # the filling face runs against its neighbour
    loops = []
    while follow:
        start = min(follow)
        loop, here = [start], start
        while here in follow:
            after = follow[here].pop()
            if not follow[here]:
                del follow[here]
            here = after
            if here == start:
                break
            loop.append(here)
        if here == start and len(loop) >= 3:
            loops.append(np.array(loop, np.int64))
    return loops


def close_holes(mesh: Mesh) -> tuple[Mesh, int]:
    """Fill every boundary loop with a fan about its centre; returns the mesh and how many holes there were."""
    loops = boundary_loops(mesh.faces)
    vertices, faces = [mesh.vertices], [mesh.faces]
    for k, loop in enumerate(loops):
        vertices.append(mesh.vertices[loop].mean(axis=0, keepdims=True))
        centre = np.full(len(loop), len(mesh.vertices) + k)
        faces.append(np.stack([loop, np.roll(loop, -1), centre], axis=1))
    return Mesh(np.concatenate(vertices), np.concatenate(faces)), len(loops)


def decimate(mesh: Mesh, face_budget: int) -> Mesh:
    """Quadric edge collapse down to `face_budget` faces; a mesh within the budget is returned as it is."""
    if len(mesh.faces) <= face_budget:
        return mesh
    vertices, faces = fast_simplification.simplify(
        mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), target_count=face_budget
    )
    return weld(Mesh(vertices.astype(np.float64), faces.astype(np.int64)))


@dataclass(frozen=True)
class SurfaceFacts:
    """What became of the surface on its way to the export."""

    extracted_faces: int
    faces: int
    vertices: int
    dropped_area: float  # share of the extracted area in parts that were left behind
    holes_closed: int
    level: float


def clean_surface(
    raw: Mesh, face_budget: int, level: float = 0.0, repair: Callable[[Mesh], Mesh] | None = None
) -> tuple[Mesh, SurfaceFacts]:
    """Largest component, repaired by a tool of the user's if there is one, decimated to the budget, without holes.

    Closing a hole only adds vertices behind the others: the last ``facts.holes_closed`` of them are the fillings.
    """
    mesh, dropped = largest_component(raw)
    if repair is not None:
        mesh, _ = largest_component(weld(repair(mesh)))
    mesh, _ = largest_component(decimate(mesh, face_budget))
    mesh, holes = close_holes(mesh)
    facts = SurfaceFacts(len(raw.faces), len(mesh.faces), len(mesh.vertices), dropped, holes, level)
    return mesh, facts
