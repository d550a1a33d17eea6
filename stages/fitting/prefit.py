"""Motion before rendering: move surface points until they cover the masks, in seconds, with the shape held.

A renderer carves away a limb whose motion it does not know yet. So the motion is fitted first, on a few hundred
surface points a frame: every mask pixel wants a projected point nearby (coverage), no projected point may lie
outside the mask (overshoot, by the mask's distance transform), and bones hold together at their joints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from stages.fitting.batches import step_generator
from stages.fitting.objective import motion_terms
from stages.fitting.observations import Observations
from stages.fitting.schedule import PhaseSettings
from stages.geometry.cameras import project, transform
from stages.model.banmo import Banmo, FrameState


SCALE, LR = 40, 4e-3


class Coverage(NamedTuple):
    """How well posed surface points explain the masks, per kept frame, in pixels of a 256-pixel image side."""

    uncovered: Tensor  # (T,) mean distance from a mask pixel to the nearest projected point
    overshoot: Tensor  # (T,) mean distance by which projected points miss the mask


def outside_distances(observations: Observations) -> Tensor:
    """Distance in silhouette pixels to the mask, zero inside: (T, h, w) float32."""
    out = np.zeros(observations.silhouettes.shape, np.float32)
    for f, mask in enumerate(observations.silhouettes.numpy()):
        out[f] = distance_transform_edt(mask <= 127) if (mask > 127).any() else 0.0
    return torch.from_numpy(out)


def mask_pixels(observations: Observations, frame_idx: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """`count` random pixel centres (F, count, 2) inside the mask of each frame."""
    chosen = []
    for f in frame_idx.tolist():
        rows = slice(int(observations.offsets[f]), int(observations.offsets[f + 1]))
        inside = torch.nonzero(observations.mask[rows] > 127)[:, 0]
        pick = inside[torch.randint(len(inside), (count,), generator=generator)]
        chosen.append(observations.xy[rows][pick].float() + 0.5)
    return torch.stack(chosen)


def _project(model: Banmo, state: FrameState, points: Tensor) -> Tensor:
    posed = model.forward_points(state, points[None].expand(len(state.transforms), -1, -1))
    return project(state.intrinsics, transform(state.camera_from_object, posed))


def _read_distance(distances: Tensor, observations: Observations, frame_idx: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear distance to the mask (F, N), in frame pixels; pixels off the picture are clamped to its border."""
    scale = observations.silhouette_scale[frame_idx][:, None, None]
    size = distances.shape[1]
    unit = pixels * scale / size * 2 - 1
    sampled = torch.nn.functional.grid_sample(
        distances[frame_idx][:, None], unit[:, :, None], align_corners=False, padding_mode="border"
    )
    # Pixels beyond the picture are unknown, not wrong: an object cut by the border must not be pulled inwards.
    inside = ((pixels >= 0) & (pixels <= observations.image_size[frame_idx][:, None])).all(-1)
    return sampled[:, 0, :, 0] / scale[..., 0] * inside


def fit_motion(
    model: Banmo,
    observations: Observations,
    points: Tensor,
    settings: PhaseSettings,
    iterations: int,
    seed: int,
    reach: float = 0.15,
    watch: Callable[[range], Iterator[int]] | None = None,
) -> None:
    """Fit body poses (and root poses, if they may move) to the masks, on canonical surface points (N, 3)."""
    distances = outside_distances(observations)
    image_px = float(observations.image_size.max())
    groups = [{"params": list(model.body.parameters()), "lr": LR}]
    if settings.lr_root > 0:
        groups.append({"params": list(model.root.parameters()), "lr": settings.lr_root})
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
    steps = range(iterations)
    for step in watch(steps) if watch else steps:
        generator = step_generator(seed, step, rank=7)
        frame_idx = torch.multinomial(observations.frame_weight, settings.frames_per_step, True, generator=generator)
        state = model.frames(frame_idx)
        some = points[torch.randperm(len(points), generator=generator)[:700]]
        pixels = _project(model, state, some)
        wanted = mask_pixels(observations, frame_idx, 160, generator)
        # In image sizes, with square roots: a far pixel pulls as hard as a near one, and none dominates.
        gap = (torch.cdist(wanted, pixels).amin(-1) / image_px).clamp_max(reach)
        miss = (_read_distance(distances, observations, frame_idx, pixels) / image_px).clamp_max(reach)
        terms = motion_terms(model, frame_idx, settings, generator)
        loss = SCALE * gap.mean() + SCALE * miss.mean() + torch.stack(list(terms.values())).sum()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        share = step / max(1, iterations)
        for group in optimiser.param_groups:
            group.setdefault("base", group["lr"])
            group["lr"] = group["base"] * min(1.0, (step + 1) / 20) * (1 - 0.9 * max(0.0, share - 0.5) / 0.5)
        optimiser.step()


@torch.no_grad()
def coverage(model: Banmo, observations: Observations, points: Tensor, seed: int = 0) -> Coverage:
    """Measure :class:`Coverage` of every kept frame with canonical surface points (N, 3)."""
    distances = outside_distances(observations)
    some = points[:: max(1, len(points) // 1500)]
    uncovered, overshoot = torch.zeros(len(observations)), torch.zeros(len(observations))
    for f in torch.nonzero(observations.frame_weight > 0)[:, 0].tolist():
        index = torch.tensor([f])
        pixels = _project(model, model.frames(index), some)
        wanted = mask_pixels(observations, index, 200, step_generator(seed, f))
        unit = 256.0 / float(observations.image_size[f].max())
        uncovered[f] = torch.cdist(wanted, pixels).amin(-1).mean() * unit
        overshoot[f] = _read_distance(distances, observations, index, pixels).mean() * unit
    return Coverage(uncovered, overshoot)
