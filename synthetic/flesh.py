"""What every generated body is made of: bones, round cones of flesh round them, one watertight surface, soft weights.

A body is a smooth union of round cones laid along the bones, meshed once by marching cubes. A vertex takes its
skinning weights from the bones whose cones are near it, restricted to the neighbours of the nearest bone in the
skeleton, so that a left leg never pulls at a right one; then weights are smoothed along the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse
from skimage.measure import marching_cubes


@dataclass(frozen=True)
class Bone:
    """One bone of a skeleton: it turns about `joint`; its parent is an index, -1 for the root."""

    name: str
    parent: int
    joint: np.ndarray  # (3,) rest position, object space
    tip: np.ndarray  # (3,) rest position of its far end


@dataclass(frozen=True)
class Body:
    """A rest shape with its skeleton. V vertices, F faces, B bones; all in object space at rest."""

    vertices: np.ndarray  # (V, 3) float64
    faces: np.ndarray  # (F, 3) int64, outward
    weights: np.ndarray  # (V, B) float64, rows sum to 1
    bones: tuple[Bone, ...]
    marks: dict[str, tuple[np.ndarray, float]] = field(default_factory=dict)  # name -> centre (3,), radius

    @property
    def ground(self) -> float:
        """Height (y) of the soles at rest."""
        return float(self.vertices[:, 1].min())

    def index(self, name: str) -> int:
        """Index of a bone by name."""
        return next(i for i, bone in enumerate(self.bones) if bone.name == name)

    def skin(self, transforms: np.ndarray) -> np.ndarray:
        """Linear blend skinning: (B, 4, 4) rest-to-posed bone transforms -> (V, 3) posed vertices."""
        blended = (self.weights @ transforms[:, :3].reshape(len(transforms), 12)).reshape(-1, 3, 4)
        return np.einsum("vij,vj->vi", blended[:, :, :3], self.vertices) + blended[:, :, 3]


@dataclass(frozen=True)
class Cone:
    """A round cone from `a` to `b`, squeezed by `squeeze` along `axis`, joined with blending radius `blend`."""

    bone: str
    a: np.ndarray
    b: np.ndarray
    ra: float
    rb: float
    blend: float = 0.05
    axis: np.ndarray | None = None
    squeeze: float = 1.0

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Approximate signed distance of (N, 3) points, negative inside."""
        p, b = points - self.a, self.b - self.a
        if self.axis is not None:
            along = self.axis / np.linalg.norm(self.axis)
            p = p + np.outer(p @ along, along) * (1.0 / self.squeeze - 1.0)
            b = b + (b @ along) * along * (1.0 / self.squeeze - 1.0)
        t = np.clip(p @ b / max(float(b @ b), 1e-9), 0, 1)
        d = np.linalg.norm(p - t[:, None] * b, axis=1) - (self.ra + (self.rb - self.ra) * t)
        return d * min(1.0, self.squeeze)


def assemble(bones: list[Bone], cones: list[Cone], marks: dict[str, tuple[np.ndarray, float]], cells: int) -> Body:
    """Mesh the cones (`cells` marching-cubes cells along the longest edge); centre the body, make it 2 units long."""
    vertices, faces = surface(cones, cells)
    weights = skinning_weights(vertices, faces, bones, cones)
    low, high = vertices.min(0), vertices.max(0)
    centre, scale = (low + high) / 2, 2.0 / float((high - low).max())
    placed = tuple(replace(b, joint=(b.joint - centre) * scale, tip=(b.tip - centre) * scale) for b in bones)
    placed_marks = {name: ((c - centre) * scale, r * scale) for name, (c, r) in marks.items()}
    return Body((vertices - centre) * scale, faces, weights, placed, placed_marks)


def surface(cones: list[Cone], cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes on the smooth union of cones: vertices and outward faces of its largest component."""
    ends = np.array([[c.a, c.b] for c in cones]).reshape(-1, 3)
    reach = max(max(c.ra, c.rb) for c in cones) + 0.06
    low, high = ends.min(0) - reach, ends.max(0) + reach
    step = float((high - low).max()) / cells
    axes = [np.arange(lo, hi + step, step) for lo, hi in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    field = np.full(grid.shape[:3], 1.0)
    for cone in cones:  # each cone only changes the field near itself
        margin = max(cone.ra, cone.rb) + cone.blend + 3 * step
        lo = np.minimum(cone.a, cone.b) - margin
        hi = np.maximum(cone.a, cone.b) + margin
        window = tuple(slice(*np.searchsorted(ax, [lo[i], hi[i]])) for i, ax in enumerate(axes))
        d = cone.distance(grid[window].reshape(-1, 3)).reshape(field[window].shape)
        field[window] = _smooth_min(field[window], d, cone.blend)
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(step, step, step), gradient_direction="descent")
    vertices = vertices.astype(np.float64) + low
    return _largest_component(vertices, faces.astype(np.int64))


def _smooth_min(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Polynomial smooth minimum with blending radius `k`."""
    h = np.clip(0.5 + 0.5 * (b - a) / k, 0, 1)
    return b + (a - b) * h - k * h * (1 - h)


def _largest_component(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    _, label = sparse.csgraph.connected_components(adjacency_of(len(vertices), faces), directed=False)
    keep = label == np.bincount(label).argmax()
    renumber = np.cumsum(keep) - 1
    return vertices[keep], renumber[faces[keep[faces[:, 0]]]]


def adjacency_of(count: int, faces: np.ndarray) -> sparse.csr_matrix:
    """(V, V) matrix of ones where two vertices share an edge."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ones = np.ones(2 * len(pairs))
    both = np.concatenate([pairs, pairs[:, ::-1]])
    matrix = sparse.csr_matrix((ones, (both[:, 0], both[:, 1])), (count, count))
    matrix.data[:] = 1.0
    return matrix


def skinning_weights(vertices: np.ndarray, faces: np.ndarray, bones: list[Bone], cones: list[Cone]) -> np.ndarray:
    """Skinning weights (V, B): near bones of the skeleton's neighbourhood, smoothed along the surface."""
    names = [b.name for b in bones]
    distance = np.full((len(vertices), len(bones)), np.inf)
    for cone in cones:
        column = names.index(cone.bone)
        distance[:, column] = np.minimum(distance[:, column], cone.distance(vertices))
    near = np.eye(len(bones), dtype=bool)
    for i, b in enumerate(bones):
        if b.parent >= 0:
            near[i, b.parent] = near[b.parent, i] = True
    nearest = distance.argmin(1)
    raw = np.exp(-(distance - distance.min(1, keepdims=True)) / 0.03) * near[nearest]
    weights = raw / raw.sum(1, keepdims=True)
    adjacency = adjacency_of(len(vertices), faces)
    average = sparse.diags(1.0 / np.asarray(adjacency.sum(1)).ravel()) @ adjacency
    for _ in range(8):
        weights = 0.5 * weights + 0.5 * (average @ weights)
    weights[weights < 1e-3] = 0.0
    return weights / weights.sum(1, keepdims=True)
