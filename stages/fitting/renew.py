"""New bones and a new box for a shape that has changed, with the motion kept (paper: supplement; reference: discarded).

Bones are placed where the shape is at the start, before limbs have grown. Later they are placed anew on the current
surface, and their motion is fitted to the motion that the old ones gave it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from stages.fitting.batches import step_generator
from stages.fitting.initialise import body_of, place_bones
from stages.model.banmo import Banmo
from stages.model.fields import GridField
from stages.model.skeleton import Bones


def change_bones(model: Banmo, bones: Bones, points: Tensor, seed: int, steps: int = 200) -> float:
    """Give the model new bones (as many as before), fitted to the motion of the old ones at `points` (N, 3).

    Returns the root mean square difference of the two motions over all kept frames (units).
    """
    sample = points[torch.randperm(len(points), generator=step_generator(seed, 0, rank=3))[:400]]
    target = posed(model, sample)
    with torch.no_grad():
        model.bones.load_state_dict(bones.state_dict())
    return imitate(model, sample, target, seed, steps)


@torch.no_grad()
def posed(model: Banmo, points: Tensor, frames: Tensor | None = None) -> Tensor:
    """Canonical points (N, 3) in object space in kept `frames` (T,), or in all of them: (T, N, 3)."""
    parts = (torch.arange(len(model.time)) if frames is None else frames).split(64)
    return torch.cat([model.forward_points(model.frames(i), points[None].expand(len(i), -1, -1)) for i in parts])


@torch.no_grad()
def pose_codes(model: Banmo) -> Tensor:
    """Pose codes (T, C) of all kept frames."""
    every = torch.arange(len(model.time), device=model.time.device).split(64)
    return torch.cat([model.body.code(model.video_idx[some], model.time[some]) for some in every])


@torch.no_grad()
def steer_codes(model: Banmo, change: Tensor, ridge: float = 1e-3) -> None:
    """Change the pose codes of all kept frames by (T, C), as far as each clip's functions of time can (ridge)."""
    for video in range(len(model.videos)):
        mine = slice(model.starts[video], model.starts[video + 1])
        if bool(change[mine].any()):
            model.body.code.steer(video, model.time[mine], change[mine], ridge)


def imitate(model: Banmo, points: Tensor, target: Tensor, seed: int, steps: int = 200) -> float:
    """Fit the bones' motion so that canonical points (N, 3) go where `target` (T, N, 3) has them.

    Returns the root mean square distance that is left (units).
    """
    for parameter in model.body.parameters():
        parameter.requires_grad_(True)
    optimiser = torch.optim.Adam(model.body.parameters(), lr=3e-3)
    for step in range(steps):
        generator = step_generator(seed, step, rank=5)
        index = torch.randint(len(target), (48,), generator=generator)
        pick = torch.randint(len(points), (200,), generator=generator)
        moved = model.forward_points(model.frames(index), points[pick][None].expand(len(index), -1, -1))
        error = (moved - target[index][:, pick]).square().sum(-1).mean()
        optimiser.zero_grad(set_to_none=True)
        error.backward()
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 * (1 - 0.9 * step / steps)
        optimiser.step()
    optimiser.zero_grad(set_to_none=True)
    return float((posed(model, points) - target).square().sum(-1).mean().sqrt())


def renew_bones(model: Banmo, seed: int) -> float:
    """Place the bones anew on ``model.surface``; returns what :func:`change_bones` does."""
    body = body_of(model.surface.cpu())
    bones = place_bones(body, len(model.bones), seed, along=True).to(model.surface.device)
    return change_bones(model, bones, model.surface, seed)


def renew_bounds(model: Banmo, margin: float) -> bool:
    """Fit the canonical box to ``model.surface`` plus `margin` (units); returns whether it changed.

    Grids are resampled; networks only take the new box as bounds of matching and extraction.
    """
    if not isinstance(model.field, GridField):
        return False
    bounds = torch.stack([model.surface.amin(0) - margin, model.surface.amax(0) + margin])
    if float((bounds - model.field.bounds).abs().max()) < 2 * model.field.voxel:
        return False
    model.field = model.field.resized(bounds)
    return True
