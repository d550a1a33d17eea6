"""How well each frame is explained, and what to do about frames that are not: trust them less, place them anew."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from stages.fitting.batches import Draws, look, step_generator
from stages.fitting.objective import render
from stages.fitting.observations import Observations
from stages.fitting.schedule import PhaseSettings
from stages.geometry.cameras import project, transform
from stages.geometry.rotations import interpolate_rigid
from stages.model.banmo import Banmo, FrameState

_RANK = 11  # of the generator: draws of its own
_SAY = (1.0, 1.0, 0.5)  # silhouette, colour, features: a network may take left for right, too


class FrameFigures(NamedTuple):
    """What T frames lack; NaN where there was nothing to compare with."""

    overlap: Tensor  # (T,) of rendered and seen silhouette near the object, as intersection over union, 0..1
    flow_px: Tensor  # (T,) median distance of rendered from seen flow where that is trusted
    feature: Tensor  # (T,) mean squared distance of rendered from seen features, 0..4
    colour: Tensor  # (T,) mean distance of rendered from seen colour, 0..1 a channel


def unexplained(figures: FrameFigures) -> Tensor:
    """(T, 3): what of silhouette, colour and features is not explained; NaN where nothing was compared."""
    return torch.stack([1 - figures.overlap, figures.colour, figures.feature], 1)


def relative_error(figures: FrameFigures, usual: Tensor) -> Tensor:
    """(T,) weighted mean of what is unexplained over what usually is (3,), of what is known; NaN where nothing is."""
    ratio = unexplained(figures) / usual
    weight = torch.tensor(_SAY) * ~ratio.isnan()
    return (ratio.nan_to_num() * weight).sum(1) / torch.where(weight.any(1), weight.sum(1), torch.nan)


@torch.no_grad()
def frame_figures(
    model: Banmo,
    observations: Observations,
    boxes: Tensor,
    settings: PhaseSettings,
    beta: float,
    most: int = 1500,
    pixels: int = 160,
    chunk: int = 24,
) -> FrameFigures:
    """Render some `pixels` of each frame (of `most` frames, evenly spread, if there are more) and compare."""
    count, device = len(observations), model.base_poses.device
    figures = torch.full((4, count), torch.nan)
    usable = torch.nonzero(observations.frame_weight > 0)[:, 0]
    usable = usable[torch.linspace(0, len(usable) - 1, min(most, len(usable))).round().long()]
    prepared = model.field.prepare()
    for part in usable.split(chunk):
        generator = step_generator(settings.seed, int(part[0]), rank=_RANK)
        batch = look(observations, part, pixels, generator).to(device)
        both = model.frames(torch.cat([batch.frame_idx, batch.partner_idx]))
        state = FrameState(*(x if len(x) == 1 else x[: len(part)] for x in both))
        partner = FrameState(*(x if len(x) == 1 else x[len(part) :] for x in both))
        draws = Draws(generator, len(part), slice(0, len(part)), device)
        seen = render(model, prepared, state, boxes[batch.frame_idx], batch.pixels, beta, settings, draws)
        union = torch.maximum(seen.opacity, batch.mask).sum(1)
        figures[0, part] = (torch.minimum(seen.opacity, batch.mask).sum(1) / union.clamp_min(1e-6)).cpu()
        inside = (batch.mask > 0.5) & (seen.opacity > 0.5)
        distance = (seen.colour - batch.rgb).abs().mean(-1)
        figures[3, part] = torch.where(inside, distance, torch.nan).nanmean(1).cpu()
        moved = transform(partner.camera_from_object, model.forward_points(partner, seen.surface))
        error = (project(partner.intrinsics, moved) - batch.pixels - batch.flow).norm(dim=-1)
        known = inside & (batch.flow_confidence > 0.5)
        figures[1, part] = torch.where(known, error, torch.nan).nanmedian(1).values.cpu()
        if batch.features is not None:
            rendered = model.field.embedding(seen.surface.reshape(-1, 3)).reshape(batch.features.shape)
            known = inside & (batch.features.abs().sum(-1) > 0.1)
            distance = (rendered - batch.features).square().sum(-1)
            figures[2, part] = torch.where(known, distance, torch.nan).nanmean(1).cpu()
    return FrameFigures(*figures)


def misfits(overlap: Tensor, video_idx: Tensor, least_gap: float = 0.2) -> Tensor:
    """Which frames (T,) overlap far less than their clip does: below the median by four times its spread.

    The spread is the median absolute deviation; `least_gap` is how far below counts at least. At most a third of a
    clip is called a misfit: beyond that the clip, not its frames, is at fault.
    """
    bad = torch.zeros(len(overlap), dtype=torch.bool)
    for video in video_idx.unique():
        mine = torch.nonzero((video_idx == video) & ~overlap.isnan())[:, 0]
        if len(mine) < 4:
            continue
        value = overlap[mine]
        middle = value.median()
        gap = max(least_gap, 4 * float((value - middle).abs().median()))
        worst = mine[value < middle - gap]
        order = overlap[worst].argsort()
        bad[worst[order[: len(mine) // 3]]] = True
    return bad


@torch.no_grad()
def replace_from_neighbours(model: Banmo, bad: Tensor) -> int:
    """Put the first root poses of `bad` frames (T,) between those of their clip's other frames, where poses are free.

    Returns how many were moved.
    """
    moved = 0
    for video in range(len(model.videos)):
        if float(model.root_free[video]) == 0:
            continue
        start, end = model.starts[video], model.starts[video + 1]
        wrong = torch.nonzero(bad[start:end])[:, 0]
        right = torch.nonzero(~bad[start:end])[:, 0]
        if len(wrong) == 0 or len(right) < 2:
            continue
        times = torch.tensor(model.videos[video].time_s, dtype=torch.float64)
        poses = model.base_poses[start:end].cpu()
        between = interpolate_rigid(poses[right], times[right], times[wrong])
        model.base_poses[start + wrong.to(model.base_poses.device)] = between.to(model.base_poses)
        moved += len(wrong)
    return moved
