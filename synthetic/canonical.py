"""One canonical surface a category, and the place on it of every point of every body of that category.

The canonical surface is the rest shape of an average body. A point of another body is carried there bone by bone:
its coordinates in the bone's own frame, stretched by the two bones' lengths and girths, blended by skinning weights;
the nearest canonical vertex with like weights and a like normal is its label. Left stays left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import eigsh

from stages.geometry.raster import vertex_normals
from synthetic.bodies import QuadrupedShape, quadruped
from synthetic.flesh import Body, Bone
from synthetic.people import PersonShape, person

CATEGORIES = ("quadruped", "human")
CANONICAL_CELLS = {"quadruped": 46, "human": 50}
_WEIGHT_PULL, _NORMAL_PULL = 0.25, 0.12  # units of a canonical body 2 long
AVERAGE = QuadrupedShape(
    leg=0.7, neck=0.32, skull=0.14, muzzle=0.15, muzzle_girth=0.075, ear=0.16, tail=0.65, tail_girth=0.065
)  # fmt: skip


def canonical_body(category: str) -> Body:
    """The body whose rest shape is the category's canonical surface; always the same."""
    cells = CANONICAL_CELLS[category]
    return person(PersonShape(), cells) if category == "human" else quadruped(AVERAGE, cells)


@dataclass(frozen=True)
class Carrier:
    """Finds canonical vertices for the vertices of other bodies of one category."""

    body: Body
    key: np.ndarray  # (V, 3 + B + 3) position, weights, normal, each with its pull

    @classmethod
    def of(cls, body: Body) -> Carrier:
        """Prepare a canonical body."""
        return cls(body, _key(body.vertices, body.weights, vertex_normals(body.vertices, body.faces)))

    def labels(self, other: Body) -> np.ndarray:
        """(V',) index of the canonical vertex of every vertex of a body with the same bones."""
        carried = np.zeros_like(other.vertices)
        for i, (mine, theirs) in enumerate(zip(self.body.bones, other.bones, strict=True)):
            weight = other.weights[:, i]
            if not weight.any():
                continue
            to_bone, from_bone = _frame(theirs), _frame(mine)
            length = np.linalg.norm(mine.tip - mine.joint) / np.linalg.norm(theirs.tip - theirs.joint)
            girth = _girth(self.body, i) / max(_girth(other, i), 1e-3)
            stretch = np.diag([girth, length, girth])
            local = (other.vertices - theirs.joint) @ to_bone.T @ stretch
            carried += weight[:, None] * (local @ from_bone + mine.joint)
        key = _key(carried, other.weights, vertex_normals(other.vertices, other.faces))
        square = (self.key**2).sum(1)[None] - 2 * key @ self.key.T
        return square.argmin(1)


def _key(position: np.ndarray, weights: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return np.concatenate([position, _WEIGHT_PULL * weights, _NORMAL_PULL * normals], 1)


def _frame(bone: Bone) -> np.ndarray:
    """(3, 3) rows: side, along, front of a bone; the side is as near to +x as can be."""
    along = (bone.tip - bone.joint) / max(float(np.linalg.norm(bone.tip - bone.joint)), 1e-9)
    side = np.array([1.0, 0, 0]) if abs(along[0]) < 0.9 else np.array([0, 0, 1.0])
    side = side - (side @ along) * along
    side /= np.linalg.norm(side)
    return np.stack([side, along, np.cross(side, along)])


def _girth(body: Body, bone_idx: int) -> float:
    """Typical distance of a bone's own vertices from its axis."""
    own = body.weights[:, bone_idx] > 0.5
    if own.sum() < 4:
        own = body.weights[:, bone_idx] >= np.sort(body.weights[:, bone_idx])[-4]
    bone = body.bones[bone_idx]
    along = _frame(bone)[1]
    offset = body.vertices[own] - bone.joint
    return float(np.median(np.linalg.norm(offset - np.outer(offset @ along, along), axis=1)))


def laplacian_basis(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """(V, count) eigenfunctions of the surface's Laplace-Beltrami operator (cotangent weights), smoothest first.

    The constant one is left out; each has unit mean square. Signs are fixed by the vertex of the largest value.
    """
    corners = vertices[faces]
    rows, columns, values = [], [], []
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    for k in range(3):
        a, b = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        cotangent = (a * b).sum(1) / np.maximum(np.linalg.norm(np.cross(a, b), axis=1), 1e-9)
        cotangent = np.clip(cotangent, 0.05, 20.0) / 2  # a sliver must not tear the surface
        i, j = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        rows += [i, j]
        columns += [j, i]
        values += [cotangent, cotangent]
    count_v = len(vertices)
    weight = sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count_v,) * 2
    )
    stiffness = sparse.diags(np.asarray(weight.sum(1)).ravel()) - weight
    mass = np.bincount(faces.ravel(), np.repeat(area / 3, 3), count_v)
    start = np.cos(np.arange(count_v) * 1.7)  # a fixed start, so that the same bytes come out
    _, functions = eigsh(stiffness, count + 1, sparse.diags(mass), sigma=-1e-3, which="LM", v0=start)
    functions = functions[:, 1:] * np.sqrt(mass.sum())
    sign = np.sign(functions[np.abs(functions).argmax(0), np.arange(functions.shape[1])])
    return functions * sign


def mirror_vertices(vertices: np.ndarray) -> np.ndarray:
    """(V,) index of the vertex nearest to each vertex's mirror image across x = 0."""
    mirrored = vertices * np.array([-1.0, 1, 1])
    return ((vertices**2).sum(1)[None] - 2 * mirrored @ vertices.T).argmin(1)
