"""Putting a category's puppet on a fitted model, if the model's embedding is that category's."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from stages.fitting.known_poses import spread
from stages.model.banmo import Banmo
from stages.retargeting.fitting import Effort, Posture, Surface, fit_surface, lay
from stages.retargeting.handing import Handed, hand_on, hang
from stages.retargeting.puppet import Puppet

ALIKE = 0.6
"""Least share of a model's surface that its embedding alone sends to about the right place on the canonical surface."""
_ABOUT = 0.25  # so near, where the object is 2 long
_POINTS = 1200
_LINK = 0.1  # surface points this near belong together, where the object is 2 long
_ON_MODEL = Effort(rounds=12, steps=30, near=(0.6, 0.05), rest=0.0005, learning_rate=0.03)


def _largest_piece(points: Tensor) -> Tensor:
    """(M,) which points of a surface belong to its largest connected piece; crumbs of a field lie anywhere."""
    pairs = cKDTree(points.numpy()).query_pairs(_LINK, output_type="ndarray")
    links = sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(points), len(points)))
    _, label = sparse.csgraph.connected_components(links, directed=False)
    return torch.from_numpy(label == np.bincount(label).argmax())


def model_surface(model: Banmo) -> Surface:
    """Points of the model's surface at rest, their normals (gradient of the signed distance) and embedding."""
    surface = model.surface[_largest_piece(model.surface)]
    points = surface[spread(len(surface), _POINTS)]
    step = 0.5 * model.architecture.voxel
    sides = [model.sdf(points + d) - model.sdf(points - d) for d in step * torch.eye(3)]
    normals = torch.nn.functional.normalize(torch.stack(sides, -1), dim=-1)
    return Surface(points, normals, model.embedding(points))


def likeness(puppet: Puppet, surface: Surface) -> float:
    """Share of the surface that a rigid motion and a scale lay on the vertices its embedding names.

    Near one if the embedding is this category's, whatever the model's build; hardly anything if it is another's, and
    nothing if the model was fitted without features.
    """
    if not surface.features.any():
        return 0.0
    rotation, scale, joint = lay(puppet, surface)
    vertex = (surface.features @ puppet.embedding.T).argmax(1)
    there = scale * (puppet.vertices[vertex] - puppet.joints[0]) @ rotation[0].T + joint
    return float(((there - surface.points).norm(dim=1) < _ABOUT).float().mean())


def handed(puppet: Puppet, surface: Surface, moving: Posture) -> tuple[Handed, float]:
    """The motion of the clip's subject on the model's surface, and how badly its puppet fits the model (sizes)."""
    rest = fit_surface(puppet, surface, _ON_MODEL)
    weights: Tensor = hang(puppet, rest, surface)
    return hand_on(puppet, rest, moving, surface.points, weights), float(rest.misfit.mean())
