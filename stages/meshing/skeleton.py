"""A tree of joints from loose bones, by what stays together in motion and lies close at rest.

Bones in the model are independent Gaussians, each with its own rigid motion. A rig is a tree. The cost of joining two
bones is how badly the best common joint between them holds over all frames, plus how far they lie apart at rest; the
tree is the one of least total cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

_PULL = 0.02  # squared radians: relative rotations below about eight degrees do not move a joint much


@dataclass(frozen=True)
class Skeleton:
    """Joints in an order in which parents come before children.

    names: one a joint, e.g. ``bone_07``.
    bone: (B,) index of each joint's bone in the model.
    parent: (B,) index of the parent joint, -1 for the root (which is joint 0).
    rest: (B, 4, 4) object_from_joint at rest, float64: upright axes, at the point where the joint holds the parent.
    centre: (B, 3) centre of the joint's bone at rest.
    """

    names: list[str]
    bone: np.ndarray
    parent: np.ndarray
    rest: np.ndarray
    centre: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def joint_of_bone(self) -> np.ndarray:
        """(B,) joint index of each bone of the model."""
        inverse = np.empty(len(self), np.int64)
        inverse[self.bone] = np.arange(len(self))
        return inverse

    def posed(self, bone_transforms: np.ndarray) -> np.ndarray:
        """Object_from_joint (T, B, 4, 4), joint order, of canonical-to-posed transforms (T, B, 4, 4), bone order."""
        return nearest_rigid(bone_transforms[:, self.bone].astype(np.float64)) @ self.rest

    def sticks(self, posed: np.ndarray) -> np.ndarray:
        """Ends (..., B, 2, 3) of each bone, joint and centre, in object space, of object_from_joint (..., B, 4, 4)."""
        offset = self.centre - self.rest[:, :3, 3]
        joint = posed[..., :3, 3]
        return np.stack([joint, joint + (posed[..., :3, :3] @ offset[..., None])[..., 0]], axis=-2)

    def local(self, posed: np.ndarray) -> np.ndarray:
        """Parent_from_joint (..., B, 4, 4) of object_from_joint (..., B, 4, 4); the root's is its own."""
        result = posed.copy()
        child = np.flatnonzero(self.parent >= 0)
        result[..., child, :, :] = invert(posed[..., self.parent[child], :, :]) @ posed[..., child, :, :]
        return result


def nearest_rigid(transforms: np.ndarray) -> np.ndarray:
    """Rigid transforms (..., 4, 4) nearest to given ones in the Frobenius norm (polar decomposition), float64."""
    result = np.zeros(transforms.shape, np.float64)
    u, _, vt = np.linalg.svd(transforms[..., :3, :3].astype(np.float64))
    flip = np.ones(u.shape[:-1])
    flip[..., 2] = np.linalg.det(u @ vt)
    result[..., :3, :3] = (u * flip[..., None, :]) @ vt
    result[..., :3, 3] = transforms[..., :3, 3]
    result[..., 3, 3] = 1.0
    return result


def invert(transforms: np.ndarray) -> np.ndarray:
    """Inverse of rigid transforms (..., 4, 4)."""
    result = np.zeros_like(transforms)
    rotation = np.swapaxes(transforms[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ transforms[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def pair_joints(centres: np.ndarray, transforms: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """The best common joint of every pair of bones, and what joining them would cost.

    For bones a and b with motions J_a(t), J_b(t) the joint is the point p, at rest, that minimises
    ``mean_t |J_a(t) p - J_b(t) p|^2 + w |p - (c_a + c_b) / 2|^2``; the cost is the root of the first term at p, twice,
    plus the distance of the centres, in units of the object's length.

    Args:
        centres: (B, 3) at rest.
        transforms: (T, B, 4, 4) canonical to posed.
        length: longest edge of the object's box.

    Returns:
        Costs (B, B), symmetric with zero diagonal; points (B, B, 3), the diagonal holds the centres.
    """
    count = len(centres)
    first, second = np.triu_indices(count, 1)
    difference = transforms[:, first] - transforms[:, second]
    a, b = difference[..., :3, :3], difference[..., :3, 3]
    middle = (centres[first] + centres[second]) / 2
    apart = np.linalg.norm(centres[first] - centres[second], axis=1)
    normal = np.einsum("tpij,tpik->pjk", a, a) / len(a) + _PULL * np.eye(3)
    right = -np.einsum("tpij,tpi->pj", a, b) / len(a) + _PULL * middle
    shift = np.linalg.solve(normal, right[..., None])[..., 0] - middle
    # A joint far off both bones says that they move alike or not at all: keep it between them.
    shift *= np.minimum(1, 0.6 * apart / np.maximum(np.linalg.norm(shift, axis=1), 1e-12))[:, None]
    joint = middle + shift
    slip = np.sqrt(((np.einsum("tpij,pj->tpi", a, joint) + b) ** 2).sum(axis=-1).mean(axis=0))
    cost, point = np.zeros((count, count)), np.zeros((count, count, 3))
    cost[first, second] = cost[second, first] = (2.0 * slip + apart) / length
    point[first, second] = point[second, first] = joint
    point[np.arange(count), np.arange(count)] = centres
    return cost, point


def build_skeleton(
    centres: np.ndarray,
    transforms: np.ndarray,
    weights: np.ndarray,
    vertices: np.ndarray,
    inside: Callable[[np.ndarray], np.ndarray] | None = None,
    parents: np.ndarray | None = None,
) -> Skeleton:
    """Join the model's bones into a tree: the model's own, or for loose bones the one of least cost.

    The root of loose bones is the one from which the others, weighted by the surface they move, are nearest.

    Args:
        centres: (B, 3) of the bones at rest, canonical space.
        transforms: (T, B, 4, 4) canonical to posed, over all clips.
        weights: (V, B) skinning weights at rest.
        vertices: (V, 3) surface at rest.
        parents: (B,) the model's own tree, a root being its own parent; None for loose bones.
        inside: tells which of points (N, 3) lie in the body; joints outside are drawn in between their bones.
    """
    centres = centres.astype(np.float64)
    count = len(centres)
    cost, point = pair_joints(centres, transforms.astype(np.float64), float(np.ptp(vertices, axis=0).max()))
    if parents is None:
        # Bones that share skin belong together: overlap makes an edge up to a third cheaper.
        overlap = weights.T @ weights
        overlap = overlap / np.sqrt(np.maximum(np.outer(np.diag(overlap), np.diag(overlap)), 1e-12))
        cost = np.maximum(cost * (1 - overlap / 3), 1e-9) * (1 - np.eye(count))
        tree = sparse.csgraph.minimum_spanning_tree(sparse.csr_matrix(cost))
        tree = tree + tree.T
        along = sparse.csgraph.shortest_path(tree, directed=False)
        root = int((along @ (weights.mean(axis=0) + 1e-6)).argmin())
    else:
        child = np.flatnonzero(parents != np.arange(count))
        root = int(np.flatnonzero(parents == np.arange(count))[0])
        tree = sparse.csr_matrix((np.ones(len(child)), (parents[child], child)), shape=(count, count))
    order, before = sparse.csgraph.breadth_first_order(tree, root)
    position = np.empty(count, np.int64)
    position[order] = np.arange(count)
    parent_bone = np.where(before[order] < 0, order, before[order])
    parent = np.where(before[order] < 0, -1, position[parent_bone])
    rest = np.tile(np.eye(4), (count, 1, 1))
    rest[:, :3, 3] = point[order, parent_bone]
    middle = (centres[order] + centres[parent_bone]) / 2
    if inside is not None:
        for _ in range(3):
            outside = ~inside(rest[:, :3, 3])
            rest[outside, :3, 3] = (rest[outside, :3, 3] + middle[outside]) / 2
    names = [f"bone_{int(b):02d}" for b in order]
    return Skeleton(names, order.astype(np.int64), parent.astype(np.int64), rest, centres[order])
