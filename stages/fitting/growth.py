"""Grow the limbs that the average of all frames lost, by voting again under the motion found so far.

The rigid hull holds what stays put: torso, head, stubs of the limbs. Fit its motion, then let every voxel around it
vote again, *carried along by the bones*: where a stub now follows its limb, the voxels beyond it gain votes and the
limb grows outward. Shape, bones and motion take turns for a few rounds.
"""

from __future__ import annotations

import torch
from scipy.ndimage import binary_dilation
from torch import Tensor

from stages.fitting import hull
from stages.fitting.batches import step_generator
from stages.fitting.initialise import Hull, usable_frames
from stages.fitting.observations import Observations
from stages.geometry.cameras import transform
from stages.model.banmo import Banmo
from stages.model.skeleton import Bones


def posed_placement(model: Banmo, points: Tensor) -> hull.Placement:
    """Canonical points (N, 3) carried by the model's bones and root."""

    @torch.no_grad()
    def place(f: int) -> Tensor:
        state = model.frames(torch.tensor([f]))
        return transform(state.camera_from_object[0], model.forward_points(state, points[None])[0])

    return place


def vote_again(
    model: Banmo, observations: Observations, intrinsics: Tensor, before: Hull, reach: float, frames: int = 200
) -> Hull:
    """The hull under the model's motion, looked for within `reach` (units) of the present one."""
    voxel = float(before.nodes[1, 0, 0, 0] - before.nodes[0, 0, 0, 0])
    around = torch.from_numpy(binary_dilation(before.solid.numpy(), iterations=max(1, round(reach / voxel))))
    points = before.nodes[around]
    place = posed_placement(model, points)
    share = hull.votes(place, len(points), observations, intrinsics, usable_frames(observations, frames))
    level = hull.choose_level(share, place, voxel, observations, intrinsics, usable_frames(observations, 40))
    cube = torch.zeros_like(before.share)
    cube[around] = share
    solid = torch.from_numpy(hull.largest_component((cube >= level).numpy()))
    return Hull(before.nodes, cube, solid, level)


def shell(solid: Tensor, nodes: Tensor) -> Tensor:
    """Surface voxels (N, 3) of a solid (X, Y, Z)."""
    inner = torch.zeros_like(solid)
    inner[1:-1, 1:-1, 1:-1] = (
        solid[1:-1, 1:-1, 1:-1]
        & solid[2:, 1:-1, 1:-1] & solid[:-2, 1:-1, 1:-1]
        & solid[1:-1, 2:, 1:-1] & solid[1:-1, :-2, 1:-1]
        & solid[1:-1, 1:-1, 2:] & solid[1:-1, 1:-1, :-2]
    )  # fmt: skip
    return nodes[solid & ~inner]


def change_bones(model: Banmo, bones: Bones, points: Tensor, seed: int, steps: int = 200) -> float:
    """Give the model new bones (as many as before) and fit them to the motion of the old ones at `points` (N, 3).

    Returns the root mean square difference of the two motions (units).
    """
    every = torch.arange(len(model.time))
    with torch.no_grad():
        old = []
        sample = points[torch.randperm(len(points), generator=step_generator(seed, 0, rank=3))[:400]]
        for chunk in every.split(64):
            state = model.frames(chunk)
            old.append(model.forward_points(state, sample[None].expand(len(chunk), -1, -1)))
        target = torch.cat(old)
        model.bones.load_state_dict(bones.state_dict())
        model.body.head.out.weight.mul_(0.3)
        model.body.head.out.bias.mul_(0.3)
    optimiser = torch.optim.Adam(model.body.parameters(), lr=3e-3)
    error = torch.zeros(())
    for step in range(steps):
        generator = step_generator(seed, step, rank=5)
        index = torch.randint(len(every), (48,), generator=generator)
        pick = torch.randint(len(sample), (200,), generator=generator)
        state = model.frames(index)
        moved = model.forward_points(state, sample[pick][None].expand(len(index), -1, -1))
        error = (moved - target[index][:, pick]).square().sum(-1).mean()
        optimiser.zero_grad(set_to_none=True)
        error.backward()
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 * (1 - 0.9 * step / steps)
        optimiser.step()
    return float(error.detach().sqrt())
