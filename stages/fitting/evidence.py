"""Which places of the shape the pictures vouch for: those that lie on the object's masks wherever they are posed."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.fitting.observations import Observations
from stages.geometry.cameras import project, transform
from stages.model.banmo import Banmo


@torch.no_grad()
def share_on_masks(model: Banmo, observations: Observations, points: Tensor, frames: int = 32) -> Tensor:
    """Share (N,) in 0..1 of `frames` evenly spread frames in which canonical points (N, 3) lie on the mask.

    Frames that show a point beyond the picture's edge, and frames without a trusted mask, do not count; a point that
    no frame could show gets 1, for nothing speaks against it.
    """
    usable = torch.nonzero(observations.frame_weight > 0)[:, 0]
    if len(usable) == 0 or len(points) == 0:
        return torch.ones(len(points))
    chosen = usable[torch.linspace(0, len(usable) - 1, min(frames, len(usable))).round().long()]
    state = model.frames(chosen)
    posed = model.forward_points(state, points[None].expand(len(chosen), -1, -1))
    pixels = project(state.intrinsics, transform(state.camera_from_object, posed)).cpu()
    inside = ((pixels >= 0) & (pixels < observations.image_size[chosen][:, None])).all(-1)
    side = observations.silhouettes.shape[-1]
    cell = (pixels * observations.silhouette_scale[chosen][:, None, None]).floor().clamp(0, side - 1).long()
    on = observations.silhouettes[chosen[:, None], cell[..., 1], cell[..., 0]] > 127
    shown = inside.sum(0)
    return torch.where(shown > 0, (on & inside).sum(0) / shown.clamp_min(1), 1.0)
