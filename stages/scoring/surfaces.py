"""Distances between surfaces: samples of one, nearest points on the other."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

_DENSE = 40_000  # extra samples that find the triangles worth looking at
_SEED = 0


class Surface:
    """A triangle mesh with `samples` points spread evenly over its area; the same mesh gives the same samples.

    vertices: (V, 3) float64. faces: (F, 3) int64. points: (samples, 3).
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, samples: int = 10_000, seed: int = _SEED) -> None:
        """Sample the mesh. Raises ValueError when it has no area."""
        self.vertices, self.faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        generator = np.random.default_rng(seed)
        self.points, _ = self._sample(samples, generator)
        self._dense = self._sample(_DENSE, generator)
        self._order = generator.permutation(samples)

    def _sample(self, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Points (count, 3) and their faces (count,): one from each of `count` strips of equal area."""
        corner = self.vertices[self.faces]
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        filled = np.cumsum(np.linalg.norm(across, axis=1))
        if not len(filled) or not filled[-1] > 0:
            raise ValueError("the mesh has no area")
        level = (np.arange(count) + generator.random(count)) / count * filled[-1]
        face = np.minimum(np.searchsorted(filled, level), len(filled) - 1)
        u, v = generator.random((2, count))
        root = np.sqrt(u)
        weight = np.stack([1 - root, root * (1 - v), root * v], axis=1)
        return np.einsum("nk,nkc->nc", weight, corner[face]), face

    @cached_property
    def _index(self) -> tuple[cKDTree, np.ndarray]:
        points, face = self._dense
        centroids = self.vertices[self.faces].mean(axis=1)  # so that no face is too small to be found
        return cKDTree(np.concatenate([points, centroids])), np.concatenate([face, np.arange(len(self.faces))])

    @cached_property
    def shuffled(self) -> np.ndarray:
        """The samples in random order: any first part of them is spread over the whole surface."""
        return self.points[self._order]

    @cached_property
    def few(self) -> cKDTree:
        """A tree of 2000 samples, for rough matching."""
        return cKDTree(self.shuffled[:2000])

    @cached_property
    def tree(self) -> cKDTree:
        """A tree of the samples, for distances from sample to sample."""
        return cKDTree(self.points)

    def nearest(self, points: np.ndarray, candidates: int = 8) -> tuple[np.ndarray, np.ndarray]:
        """The nearest points (N, 3) on the surface itself to points (N, 3), and their distances (N,)."""
        tree, face_of = self._index
        _, found = tree.query(points, k=candidates)
        face = face_of[found.reshape(len(points), -1)]
        best, least = np.zeros_like(points), np.full(len(points), np.inf)
        for column in range(face.shape[1]):
            spot = nearest_on_triangle(points, self.vertices[self.faces[face[:, column]]])
            distance = np.linalg.norm(spot - points, axis=1)
            closer = distance < least
            best[closer], least[closer] = spot[closer], distance[closer]
        return best, least


def nearest_on_triangle(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The nearest point (N, 3) of triangles (N, 3, 3) to points (N, 3), row by row.

    The foot of the perpendicular where it lies in the triangle, else the best of the three edges.
    """
    edge_b, edge_c, to_point = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray((a * b).sum(axis=1))

    bb, bc, cc = dot(edge_b, edge_b), dot(edge_b, edge_c), dot(edge_c, edge_c)
    pb, pc = dot(to_point, edge_b), dot(to_point, edge_c)
    scale = np.maximum(bb * cc - bc * bc, 1e-30)
    v, w = (cc * pb - bc * pc) / scale, (bb * pc - bc * pb) / scale
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (bb * cc - bc * bc > 1e-24)
    best = corners[:, 0] + v[:, None] * edge_b + w[:, None] * edge_c
    least = np.where(inside, dot(best - points, best - points), np.inf)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        along = corners[:, end] - corners[:, start]
        share = np.clip(dot(points - corners[:, start], along) / np.maximum(dot(along, along), 1e-30), 0, 1)
        spot = corners[:, start] + share[:, None] * along
        distance = dot(spot - points, spot - points)
        closer = ~inside & (distance < least)
        best[closer], least[closer] = spot[closer], distance[closer]
    return best
