"""A coarser mesh on some of the vertices of a fine one, so that both are posed by the same motion."""

from __future__ import annotations

from dataclasses import dataclass

import fast_simplification
import numpy as np

from stages.meshing.surface import Mesh


@dataclass(frozen=True)
class Coarse:
    """vertex: (U,) vertices of the fine mesh that the coarse one keeps; faces: (F, 3) into them."""

    vertex: np.ndarray
    faces: np.ndarray


def coarse_subset(mesh: Mesh, face_budget: int) -> Coarse:
    """Collapse edges down to `face_budget` faces, then put every vertex where one of those merged into it lies.

    A mesh within the budget is kept whole.
    """
    whole = Coarse(np.arange(len(mesh.vertices)), mesh.faces)
    if len(mesh.faces) <= face_budget:
        return whole
    points, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    _, _, collapses = fast_simplification.simplify(points, faces, target_count=face_budget, return_collapses=True)
    moved, small, merged_into = fast_simplification.replay_simplification(points, faces, collapses)
    merged_into = np.asarray(merged_into, np.int64)
    distance = np.linalg.norm(points - moved[merged_into], axis=1)
    order = np.lexsort((distance, merged_into))
    cluster, first = np.unique(merged_into[order], return_index=True)
    nearest = np.full(len(moved), -1, np.int64)
    nearest[cluster] = order[first]
    small = np.asarray(small, np.int64)
    if (nearest[small] < 0).any():  # a vertex that nothing was merged into: better a large file than a torn mesh
        return whole
    used, index = np.unique(small, return_inverse=True)
    return Coarse(nearest[used], index.reshape(-1, 3))
