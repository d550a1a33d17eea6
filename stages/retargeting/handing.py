"""Handing a motion on: from a puppet that follows a clip's subject to a model that another puppet was fitted to.

Both puppets are one category's, so bone b of one is bone b of the other. The model's surface hangs on its puppet's
bones; these take the orientations of the subject's, at the model's own lengths. The root pose that brings the trunk
there is the model's root pose in the clip, the rest is motion in object space, which the model's codes then follow.

Axes: N frames, P points of the model's surface, B bones of the puppet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.geometry.cameras import transform
from stages.geometry.rotations import invert_rigid, rigid
from stages.model.banmo import Banmo
from stages.retargeting.fitting import Posture, Surface
from stages.retargeting.puppet import Puppet, skinned, vertex_turns

_NEIGHBOURS, _NORMAL, _EMBEDDING = 6, 0.1, 0.1


@dataclass(frozen=True)
class Handed:
    """`root` (N, 4, 4) camera from object; `points` (N, P, 3) where the model's surface is to be, object space."""

    root: Tensor
    points: Tensor


def hang(puppet: Puppet, rest: Posture, surface: Surface) -> Tensor:
    """Weights (P, B) with which the model's surface hangs on the puppet's bones: those of near, alike vertices."""
    vertices = skinned(puppet.vertices, puppet.weights, rest.transforms(puppet))[0]
    normals = (vertex_turns(puppet.weights, rest.orientations)[0] @ puppet.normals[..., None]).squeeze(-1)
    size = float((surface.points.amax(0) - surface.points.amin(0)).max())
    theirs = torch.cat([vertices / size, _NORMAL * normals, _EMBEDDING * puppet.embedding], 1)
    mine = torch.cat([surface.points / size, _NORMAL * surface.normals, _EMBEDDING * surface.features], 1)
    near = torch.cdist(mine, theirs).topk(_NEIGHBOURS, largest=False)
    share = (-near.values / 0.02).softmax(1)
    return (share[..., None] * puppet.weights[near.indices]).sum(1)


def hand_on(puppet: Puppet, rest: Posture, moving: Posture, points: Tensor, weights: Tensor) -> Handed:
    """The motion of one puppet on the surface that hangs on another.

    Args:
        rest: the puppet on the model, one frame, object space.
        moving: the puppet on the clip's subject, N frames, camera space.
        points, weights: (P, 3) and (P, B), see :func:`hang`.
    """
    count = len(moving.orientations)
    zero = torch.zeros(count, 3)
    own = puppet.placed(rest.shape, moving.orientations, zero)
    theirs = puppet.placed(moving.shape, moving.orientations, zero)
    larger = float((own * theirs).sum() / theirs.square().sum())
    shift = larger * (moving.shift + theirs.mean(1)) - own.mean(1)
    rotation = moving.orientations @ rest.orientations.transpose(-1, -2)
    joints = puppet.placed(rest.shape, rest.orientations, rest.shift)[0]
    offset = own + shift[:, None] - (rotation @ joints[..., None]).squeeze(-1)
    posed = skinned(points, weights, torch.cat([rotation, offset[..., None]], -1))
    root = rigid(rotation[:, 0], offset[:, 0])
    return Handed(root, transform(invert_rigid(root), posed))


def follow_points(
    driven: Banmo,
    points: Tensor,
    wanted: Tensor,
    steps: int,
    learning_rate: float,
    tick: Callable[[int, int, float], None] | None = None,
) -> Tensor:
    """Move the body motion of a driven model's one video until its surface goes through given places.

    The codes move, and the head that turns them into bone motions: it holds the poses that the model was seen in, and
    another animal's may be none of them (a tail held high). With one video, the head is that video's own.

    Args:
        driven: shape, bones, skinning and root are left alone.
        points: (P, 3) of the canonical surface; `wanted` (N, P, 3) object space, at its kept frames.
        tick: hears of steps taken, of all there will be and of the mean distance left; it may raise to end the work.

    Returns:
        (N,) mean distance that is left.
    """
    for parameter in driven.parameters():
        parameter.requires_grad_(False)
    codes, head = [driven.body.code.coefficients], list(driven.body.head.parameters())
    for parameter in codes + head:
        parameter.requires_grad_()
    rates = (learning_rate, 0.1 * learning_rate)
    descent = torch.optim.Adam([{"params": p, "lr": r} for p, r in zip((codes, head), rates, strict=True)])
    frames = torch.arange(len(wanted))
    of = driven.rest_weights(points).argmax(1)
    share = torch.bincount(of)[of].float().rsqrt()  # a thin arm has few points and counts all the same
    share = share / share.sum()
    apart = torch.zeros(len(wanted))
    for k in range(steps):
        for group, rate in zip(descent.param_groups, rates, strict=True):
            group["lr"] = rate * min(1.0, k / 10 + 0.1, 2 * (1 - k / steps))
        state = driven.frames(frames)
        posed = driven.forward_points(state, points[None].expand(len(wanted), -1, -1))
        apart = (posed - wanted).square().sum(-1)
        loss = ((apart + 1e-6).sqrt() * share).sum(1).mean()
        descent.zero_grad(set_to_none=True)
        loss.backward()
        descent.step()
        if tick is not None:
            tick(k + 1, steps, float(loss.detach()))
    return apart.detach().sqrt().mean(1)
