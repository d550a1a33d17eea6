"""A first articulation for each frame of a new clip: the known frame whose shape fits its mask best, smooth in time."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.fitting.known_poses import best_sequence, known_shapes, misfit, spread
from stages.fitting.observations import Observations
from stages.model.banmo import Banmo


@torch.no_grad()
def first_articulation(
    model: Banmo, poses: Tensor, intrinsics: Tensor, observations: Observations, smooth: float = 0.5, most: int = 160
) -> tuple[Tensor, Tensor]:
    """Known frames (T,) whose articulation starts each frame of the new clip, and what each still misfits (T,).

    Args:
        model: the known model; ``model.surface`` holds its surface.
        poses, intrinsics, observations: of the new clip.
        smooth: price of a mean point jump of one unit between successive frames, in object sizes of misfit.
        most: known frames that are tried.
    """
    frames = spread(len(model.time), most)
    surface = model.surface[spread(len(model.surface), 160)]
    shapes = known_shapes(model, frames, surface)
    cost = misfit(shapes, poses, intrinsics.expand(len(poses), 3, 3), observations, torch.arange(len(poses)))
    # Successive known frames of one video differ by a frame's motion: moving along a known clip is never dear.
    jump = torch.stack([(shapes - shape).norm(dim=-1).mean(-1) for shape in shapes])
    path = best_sequence(cost, smooth * jump)
    return frames[path], cost[torch.arange(len(cost)), path]
