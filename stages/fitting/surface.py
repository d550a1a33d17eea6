"""The current surface as points, and the boxes that hold it in every frame."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from stages.model.banmo import Banmo


@torch.no_grad()
def sample_volume(model: Banmo, resolution: int) -> tuple[np.ndarray, Tensor, Tensor]:
    """Signed distance on a regular grid over the canonical box, about `resolution` nodes along its longest edge.

    Returns values (X, Y, Z), the first node (3,) and the spacing (3,).
    """
    low, high = model.bounds[0], model.bounds[1]
    step = float((high - low).max()) / (resolution - 1)
    counts = [max(4, round(float(high[k] - low[k]) / step) + 1) for k in range(3)]
    axes = [torch.linspace(float(low[k]), float(high[k]), counts[k]) for k in range(3)]
    prepared = model.field.prepare()
    y, z = torch.meshgrid(axes[1], axes[2], indexing="ij")
    slabs = []
    for x in axes[0]:
        points = torch.stack([x.expand_as(y), y, z], -1).reshape(-1, 3).to(low.device)
        slabs.append(model.field.sdf(prepared, points).reshape(y.shape).cpu())
    spacing = torch.tensor([float(a[1] - a[0]) for a in axes])
    return torch.stack(slabs).numpy(), low.cpu().clone(), spacing


def surface_points(model: Banmo, resolution: int = 64, most: int = 2048) -> Tensor:
    """Up to `most` points (N, 3) spread over the zero level of the canonical shape; none if there is no surface."""
    from skimage.measure import marching_cubes

    volume, low, spacing = sample_volume(model, resolution)
    if not (volume.min() < 0 < volume.max()):
        return torch.zeros(0, 3)
    vertices, _, _, _ = marching_cubes(volume, 0.0, spacing=tuple(float(s) for s in spacing))
    stride = max(1, -(-len(vertices) // most))
    return torch.from_numpy(vertices[::stride].astype(np.float32)) + low


@torch.no_grad()
def frame_boxes(model: Banmo, margin: float = 0.15, chunk: int = 64) -> Tensor:
    """Object-space box (T, 2, 3) of the posed surface in every kept frame, enlarged by `margin` (units)."""
    count = len(model.time)
    points = model.surface
    if len(points) == 0:
        return model.bounds[None].repeat(count, 1, 1)
    points = points[:: max(1, len(points) // 700)]
    boxes = []
    for start in range(0, count, chunk):
        index = torch.arange(start, min(start + chunk, count))
        state = model.frames(index)
        posed = model.forward_points(state, points[None].expand(len(index), -1, -1))
        boxes.append(torch.stack([posed.amin(1) - margin, posed.amax(1) + margin], 1))
    return torch.cat(boxes)
