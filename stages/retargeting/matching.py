"""Putting a category's puppet on a fitted model, if the model's embedding is that category's."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.model.banmo import Banmo
from stages.retargeting.articulation import spread
from stages.retargeting.fitting import Effort, Posture, Surface, fit_surface
from stages.retargeting.handing import Handed, hand_on, hang
from stages.retargeting.puppet import Puppet

ALIKE = 0.85
"""Least median cosine between a model's embedding and its nearest ones on the canonical surface."""
_POINTS = 1200
_ON_MODEL = Effort(rounds=12, steps=30, rest=0.0005, learning_rate=0.03)


def model_surface(model: Banmo) -> Surface:
    """Points of the model's surface at rest, their normals (gradient of the signed distance) and embedding."""
    points = model.surface[spread(len(model.surface), _POINTS)]
    step = 0.5 * model.architecture.voxel
    sides = [model.sdf(points + d) - model.sdf(points - d) for d in step * torch.eye(3)]
    normals = torch.nn.functional.normalize(torch.stack(sides, -1), dim=-1)
    return Surface(points, normals, model.embedding(points))


def likeness(puppet: Puppet, surface: Surface) -> float:
    """Median cosine of the surface's embedding with the nearest of the puppet; near one if one network made both."""
    return float((surface.features @ puppet.embedding.T).amax(1).median())


def handed(puppet: Puppet, surface: Surface, moving: Posture) -> tuple[Handed, float]:
    """The motion of the clip's subject on the model's surface, and how badly its puppet fits the model (sizes)."""
    rest = fit_surface(puppet, surface, _ON_MODEL)
    weights: Tensor = hang(puppet, rest, surface)
    return hand_on(puppet, rest, moving, surface.points, weights), float(rest.misfit.mean())
