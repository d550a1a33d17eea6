"""Second thoughts about stretches of motion that may have been read wrongly, and a way out of them.

A limb read as its mirror image in depth covers the same pixels, so silhouettes are content and descent never leaves it;
colours and embeddings are not, but they can tell only once the other reading has been fitted, too. So where a stretch
of a clip is explained less well than the rest of it, the poses of *other* frames are laid over its masks, the best path
through them is taken up on a copy of the model, both readings are fitted to the pictures with the same effort, and the
one that explains them better stays. Not in the paper.

Axes: T all kept frames, V videos, C channels of the pose code.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from stages.fitting.diagnose import FrameFigures
from stages.fitting.known_poses import best_sequence, known_shapes, misfit, spread
from stages.fitting.observations import Observations
from stages.fitting.renew import imitate, posed
from stages.model.banmo import Banmo

_SMOOTH_S = 0.25  # seconds over which errors are averaged: a single bad frame is no other reading
_GAIN_S = 0.5  # ... and over which it is judged which reading is better
_LEAST_S = 0.3  # shortest stretch that is looked at, and shortest that is taken
_GAP_S = 0.4  # between two stretches that are looked at as one
_WEIGHTS = (1.0, 1.0, 0.5)  # silhouette, colour, features: a network may take left for right, too
_WORSE = 1.08  # of the clip's usual error: from here on a stretch is looked at
_MOST_SHARE = 0.35  # of a clip that is looked at: beyond that the clip, not the stretch, is at fault
_ONE_FRAME = 1.5  # of its clip's usual error: what a single frame can say at most
_APART = 0.08  # units (root mean square over the surface): nearer poses are the same reading
_LEAST_GAIN = -0.01  # of the usual error; below zero: where pictures do not tell, a pose seen elsewhere is likelier
_JUMP = 0.5  # price in object sizes of misfit of a mean jump of one unit between successive frames
_POINTS, _MOST_POSES, _IMITATED = 160, 400, 400


class Rethought(NamedTuple):
    """What second thoughts came to, in frames."""

    looked_at: int
    taken: int
    left: float  # units (root mean square): how far the motion is from the one that was chosen


def second_thoughts(
    model: Banmo,
    observations: Observations,
    figures_of: Callable[[Banmo, Observations], FrameFigures],
    practise: Callable[[Banmo, Observations], None],
    most: int,
    seed: int,
    agree: Callable[[Tensor], Tensor] = lambda tensor: tensor,
) -> Rethought:
    """Take up the motion of stretches that another reading explains better, and hold all other motion.

    Args:
        figures_of: how well a model explains each frame with weight.
        practise: fits the motion of a model, and nothing else, to the frames with weight; the same effort each time.
        most: frames for which that effort suffices; stretches that are explained worst come first.
        agree: makes processes that share the work decide alike (see :mod:`stages.fitting.team`).
    """
    before = _errors(figures_of(model, observations))
    usual = before.nanmedian(0).values.clamp_min(1e-4)
    found = _relative(before, usual)
    other = deepcopy(model)
    wanted = agree(other_reading(model, observations, worst(doubtful(found, model), found, model, most)))
    looked_at = wanted >= 0
    if not looked_at.any():
        return Rethought(0, 0, 0.0)
    focus = replace(observations, frame_weight=observations.frame_weight * looked_at)
    redirect(other, wanted)
    same = deepcopy(model)
    for copy in (same, other):
        practise(copy, focus)
    gain = _relative(_errors(figures_of(same, focus)), usual) - _relative(_errors(figures_of(other, focus)), usual)
    taken = agree(better(gain, looked_at, model).long()) > 0
    left = 0.0
    if taken.any():
        points = model.surface[spread(len(model.surface), _IMITATED)]
        target = torch.where(taken[:, None, None].to(points.device), posed(other, points), posed(model, points))
        redirect(model, torch.where(taken, wanted, -1))
        left = imitate(model, points, target, seed, steps=max(200, len(target) // 12))
    return Rethought(int(looked_at.sum()), int(taken.sum()), left)


def _errors(figures: FrameFigures) -> Tensor:
    """(T, 3): what of silhouette, colour and features is not explained; NaN where nothing was compared."""
    return torch.stack([1 - figures.overlap, figures.colour, figures.feature], 1)


def _relative(errors: Tensor, usual: Tensor) -> Tensor:
    """(T,) weighted mean of errors (T, 3) over what is usual (3,), of those that are known; NaN where none is."""
    ratio = errors / usual
    weight = torch.tensor(_WEIGHTS) * ~ratio.isnan()
    return (ratio.nan_to_num() * weight).sum(1) / torch.where(weight.any(1), weight.sum(1), torch.nan)


def doubtful(error: Tensor, model: Banmo) -> Tensor:
    """Frames (T,) of stretches whose error (T,), relative to what is usual, stands out from their clip's."""
    found = torch.zeros(len(error), dtype=torch.bool)
    for mine, frames_a_second in _clips(model):
        own = error[mine]
        known = ~own.isnan()
        if int(known.sum()) < 8:
            continue
        usual = own[known].median()
        # However bad one frame is, it says no more than a bad stretch does.
        told = torch.where(known, own.clamp_max(_ONE_FRAME * usual), 0.0)
        window = _window(_SMOOTH_S * frames_a_second)
        share = _smoothed(known.float(), window)
        smooth = torch.where(share > 0, _smoothed(told, window) / share.clamp_min(1e-6), usual)
        bad = smooth > max(_WORSE * float(smooth.median()), float(smooth.quantile(1 - _MOST_SHARE)))
        joined = bad | (_between(bad) & ~_long_runs(~bad, _GAP_S * frames_a_second))
        found[mine] = _long_runs(joined, max(_LEAST_S * frames_a_second, window + 1))
    return found


def worst(frames: Tensor, error: Tensor, model: Banmo, most: int) -> Tensor:
    """Of the stretches in `frames` (T,) those with the largest mean error (T,), about `most` frames in all, as (T,)."""
    stretches = _runs(torch.nonzero(frames)[:, 0], model)
    kept = torch.zeros_like(frames)
    for stretch in sorted(stretches, key=lambda some: -float(error[some].nanmean())):
        if int(kept.sum()) + len(stretch) <= most or not kept.any():
            kept[stretch[:most]] = True
    return kept


def better(gain: Tensor, looked_at: Tensor, model: Banmo) -> Tensor:
    """Frames (T,) of stretches long enough whose gain (T,) is large enough, of those that were looked at (T,)."""
    found = torch.zeros(len(gain), dtype=torch.bool)
    for mine, frames_a_second in _clips(model):
        known = looked_at[mine] & ~gain[mine].isnan()
        # Only what is known counts: beyond a stretch's ends there is nothing to gain or lose.
        window = _window(_GAIN_S * frames_a_second)
        share = _smoothed(known.float(), window)
        smooth = _smoothed(torch.where(known, gain[mine], 0.0), window) / share.clamp_min(1e-6)
        kept = (share > 0) & (smooth > _LEAST_GAIN) & looked_at[mine]
        found[mine] = _long_runs(kept, _LEAST_S * frames_a_second)
    return found


@torch.no_grad()
def other_reading(model: Banmo, observations: Observations, frames: Tensor) -> Tensor:
    """Of every frame asked about (T,) the frame (T,) whose pose lies best on its mask, smooth in time; else -1.

    Poses as near as `_APART` to the one that was found are left out.
    """
    wanted = torch.full((len(frames),), -1)
    asked = torch.nonzero(frames & (observations.frame_weight > 0))[:, 0]
    if len(asked) == 0 or len(model.surface) == 0:
        return wanted
    seen = torch.nonzero(observations.frame_weight > 0)[:, 0]
    known = seen[spread(len(seen), _MOST_POSES)]
    points = model.surface[spread(len(model.surface), _POINTS)]
    shapes = known_shapes(model, known, points).cpu()
    jump = _JUMP * torch.stack([(shapes - shape).norm(dim=-1).mean(-1) for shape in shapes])
    for stretch in _runs(asked, model):
        states = [model.frames(part) for part in stretch.split(64)]
        poses = torch.cat([state.camera_from_object for state in states]) @ model.gauge[stretch]
        intrinsics = torch.cat([state.intrinsics for state in states])
        cost = misfit(shapes, poses.cpu(), intrinsics.cpu(), observations, stretch)
        now = known_shapes(model, stretch, points).cpu()
        apart = torch.stack([(shapes - shape).square().sum(-1).mean(-1).sqrt() for shape in now])
        cost[apart < _APART] = torch.inf
        if not bool(torch.isfinite(cost).any(1).all()):
            continue
        wanted[stretch] = known[best_sequence(cost, jump)]
    return wanted


@torch.no_grad()
def redirect(model: Banmo, wanted: Tensor, ridge: float = 1e-3) -> None:
    """Give frames the pose codes of others: frame t that of frame ``wanted[t]`` (T,); where it is -1, its own."""
    wanted = wanted.to(model.time.device)
    every = torch.arange(len(model.time), device=model.time.device).split(64)
    codes = torch.cat([model.body.code(model.video_idx[some], model.time[some]) for some in every])
    change = torch.where((wanted >= 0)[:, None], codes[wanted.clamp_min(0)] - codes, 0.0)
    for video in range(len(model.videos)):
        mine = slice(model.starts[video], model.starts[video + 1])
        if bool((wanted[mine] >= 0).any()):
            model.body.code.steer(video, model.time[mine], change[mine], ridge)


def _clips(model: Banmo) -> list[tuple[slice, float]]:
    """Where each clip's frames lie, and how many there are a second."""
    found = []
    for i, video in enumerate(model.videos):
        span = max(video.time_s[-1] - video.time_s[0], 1e-3)
        found.append((slice(model.starts[i], model.starts[i + 1]), max(1.0, (len(video.time_s) - 1) / span)))
    return found


def _window(frames: float) -> int:
    """An odd number of frames, about so many."""
    return 2 * round(frames / 2) + 1


def _between(flags: Tensor) -> Tensor:
    """From the first to the last that is set of `flags` (N,)."""
    return (flags.cumsum(0) > 0) & (flags.flip(0).cumsum(0).flip(0) > 0)


def _smoothed(values: Tensor, width: int) -> Tensor:
    """Moving mean (N,) over `width` frames, odd; the ends are averaged over what there is of them."""
    pooled = torch.nn.functional.avg_pool1d(
        values[None, None], width, stride=1, padding=width // 2, count_include_pad=False
    )
    return pooled[0, 0]


def _long_runs(flags: Tensor, frames: float) -> Tensor:
    """Those of `flags` (N,) of which about so many `frames` at least stand in a row."""
    least = max(3, round(frames))
    kept = torch.zeros_like(flags)
    start = None
    for i, flag in enumerate([*flags.tolist(), False]):
        if flag and start is None:
            start = i
        elif not flag and start is not None:
            kept[start:i] = i - start >= least
            start = None
    return kept


def _runs(frames: Tensor, model: Banmo) -> list[Tensor]:
    """Frame indices (N,), sorted, cut wherever one is missing or another clip begins."""
    video = model.video_idx.cpu()[frames]
    cut = torch.nonzero((frames[1:] != frames[:-1] + 1) | (video[1:] != video[:-1]))[:, 0] + 1
    return [part for part in torch.tensor_split(frames, cut) if len(part)]
