"""Second thoughts about stretches of motion that may have been read wrongly, and a way out of them.

A limb read as its mirror image in depth covers the same pixels, so silhouettes are content and descent never leaves it;
colours and embeddings are not, but they can tell only once the other reading has been fitted, too. So the poses of
*other* frames are laid over masks, the best path through them is taken up on a copy of the model, both readings are
fitted to the pictures with the same effort, and the one that explains them better stays. Who is asked: first stretches
that are explained less well than the rest of their clip; then, as far as the effort suffices, those that another path
suits nearly as well as their own, for a clip that is misread from end to end has nothing that stands out. These must
gain clearly to be taken. Not in the paper.

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
from stages.fitting.known_poses import best_sequence, known_shapes, misfit, misfit_of_each, spread
from stages.fitting.observations import Observations
from stages.fitting.renew import imitate, posed
from stages.model.banmo import Banmo

_SMOOTH_S = 0.25  # seconds over which errors are averaged: a single bad frame is no other reading
_GAIN_S = 0.5  # ... and over which it is judged which reading is better
_LEAST_S = 0.3  # shortest stretch that is looked at, and shortest that is taken
_GAP_S = 0.4  # between two stretches that are looked at as one
_WEIGHTS = (1.0, 1.0, 0.5)  # silhouette, colour, features: a network may take left for right, too
_WORSE = 1.08  # of the clip's usual error: from here on a stretch is doubted
_MOST_SHARE = 0.35  # of a clip that is doubted: beyond that the clip, not the stretch, is at fault
_ONE_FRAME = 1.5  # of its clip's usual error: what a single frame can say at most
_APART = 0.08  # units (root mean square over the surface): nearer poses are the same reading
_LEAST_GAIN = -0.01  # of the usual error; below zero: where pictures do not tell, a pose seen elsewhere is likelier
_CLEAR_GAIN = 0.02  # ... where nothing was doubted: only that another pose would suit nearly as well
_JUMP = 0.5  # price in object sizes of misfit of a mean jump of one unit off the course of the known motion
_POINTS, _MOST_POSES, _MOST_READ, _IMITATED = 160, 400, 2000, 400
_LEVELS = 64  # of excess that are tried


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
    error = _relative(before, usual)
    doubted = worst(doubtful(error, model), error, model, most)
    room = most - int(doubted.sum())
    asked = doubted | drawn(observations, model, _MOST_READ, seed) if room > 0 else doubted
    reading = other_readings(model, observations, asked)
    close = closest(reading.excess, model, doubted, room)
    wanted = agree(torch.where(doubted | close, reading.frame, -1))
    other = deepcopy(model)
    looked_at = wanted >= 0
    if not looked_at.any():
        return Rethought(0, 0, 0.0)
    focus = replace(observations, frame_weight=observations.frame_weight * looked_at)
    redirect(other, wanted)
    same = deepcopy(model)
    for copy in (same, other):
        practise(copy, focus)
    gain = _relative(_errors(figures_of(same, focus)), usual) - _relative(_errors(figures_of(other, focus)), usual)
    least = torch.where(doubted, _LEAST_GAIN, _CLEAR_GAIN)
    taken = agree(better(gain - least, looked_at, model).long()) > 0
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
        smooth = _smoothed(told, known, window).nan_to_num(float(usual))
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
    """Frames (T,) of stretches long enough whose gain (T,) is above zero, of those that were looked at (T,)."""
    found = torch.zeros(len(gain), dtype=torch.bool)
    for mine, frames_a_second in _clips(model):
        known = looked_at[mine] & ~gain[mine].isnan()
        # Only what is known counts: beyond a stretch's ends there is nothing to gain or lose.
        smooth = _smoothed(gain[mine], known, _window(_GAIN_S * frames_a_second))
        kept = (smooth > 0) & looked_at[mine]
        found[mine] = _long_runs(kept, _LEAST_S * frames_a_second)
    return found


def drawn(observations: Observations, model: Banmo, most: int, seed: int) -> Tensor:
    """Frames (T,) of stretches that can be seen, drawn at random until there are `most`: all of them in most runs."""
    chosen = torch.zeros(len(model.time), dtype=torch.bool)
    seen = torch.nonzero(observations.frame_weight > 0)[:, 0]
    stretches = [part for run in _runs(seen, model) for part in run.split(most)]
    for i in torch.randperm(len(stretches), generator=torch.Generator().manual_seed(seed)).tolist():
        if int(chosen.sum()) + len(stretches[i]) <= most:
            chosen[stretches[i]] = True
    return chosen


class Readings(NamedTuple):
    """The best other reading of every frame that was asked about."""

    frame: Tensor  # (T,) the frame whose pose it is; -1 where there is none
    excess: Tensor  # (T,) how much worse than its own pose it lies on the mask, over what is usual; inf where none


@torch.no_grad()
def other_readings(model: Banmo, observations: Observations, asked: Tensor) -> Readings:
    """Of every frame asked about (T,) the frame whose pose lies best on its mask, along motions that were seen.

    Poses as near as `_APART` to the one that was found are left out.
    """
    found = Readings(torch.full((len(asked),), -1), torch.full((len(asked),), torch.inf))
    asked_frames = torch.nonzero(asked & (observations.frame_weight > 0))[:, 0]
    if len(asked_frames) == 0 or len(model.surface) == 0:
        return found
    seen = torch.nonzero(observations.frame_weight > 0)[:, 0]
    known = seen[spread(len(seen), _MOST_POSES)]
    points = model.surface[spread(len(model.surface), _POINTS)]
    shapes = known_shapes(model, known, points).cpu()
    jump = jumps(shapes, known_shapes(model, _next(known, model), points).cpu())
    for stretch in _runs(asked_frames, model):
        states = [model.frames(part) for part in stretch.split(64)]
        poses = (torch.cat([state.camera_from_object for state in states]) @ model.gauge[stretch]).cpu()
        intrinsics = torch.cat([state.intrinsics for state in states]).cpu()
        now = known_shapes(model, stretch, points).cpu()
        cost = misfit(shapes, poses, intrinsics, observations, stretch)
        own = misfit_of_each(now, poses, intrinsics, observations, stretch)
        cost[torch.stack([(shapes - shape).square().sum(-1).mean(-1).sqrt() for shape in now]) < _APART] = torch.inf
        if not bool(torch.isfinite(cost).any(1).all()):
            continue
        path = best_sequence(cost, jump)
        found.frame[stretch] = known[path]
        found.excess[stretch] = (cost.gather(1, path[:, None])[:, 0] - own) / own.median().clamp_min(1e-6)
    return found


def jumps(shapes: Tensor, after: Tensor) -> Tensor:
    """Price (K, K) of going from one known shape (K, N, 3) to another; `after` (K, N, 3) is what each went on to.

    Going on as the motion went on there costs nothing, resting costs what it moved: motions recur as a whole, and a
    stretch of one that was seen well elsewhere is likelier than a mix of single poses.
    """
    return _JUMP * torch.stack([(shapes - shape).norm(dim=-1).mean(-1) for shape in after])


def closest(excess: Tensor, model: Banmo, without: Tensor, most: int) -> Tensor:
    """Frames (T,) of the stretches where `excess` (T,) is least, none of `without` (T,), up to `most` in all."""
    smooth = torch.full_like(excess, torch.inf)
    clips = _clips(model)
    for mine, frames_a_second in clips:
        open_to_it = torch.isfinite(excess[mine]) & ~without[mine]
        own = _smoothed(excess[mine], open_to_it, _window(_SMOOTH_S * frames_a_second))
        smooth[mine] = torch.where(open_to_it, own, torch.inf)
    found = torch.zeros_like(without)
    levels = smooth[torch.isfinite(smooth)].sort().values
    for level in levels[spread(len(levels), _LEVELS)]:
        now = torch.zeros_like(found)
        for mine, frames_a_second in clips:
            now[mine] = _long_runs(smooth[mine] <= level, _LEAST_S * frames_a_second)
        if int(now.sum()) > most:
            break
        found = now
    return found


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


def _next(frames: Tensor, model: Banmo) -> Tensor:
    """The frame (N,) that follows each of `frames` (N,) in its clip; the last is followed by itself."""
    last = torch.as_tensor(model.starts)[1:][model.video_idx.cpu()[frames]] - 1
    return torch.minimum(frames + 1, last)


def _window(frames: float) -> int:
    """An odd number of frames, about so many."""
    return 2 * round(frames / 2) + 1


def _between(flags: Tensor) -> Tensor:
    """From the first to the last that is set of `flags` (N,)."""
    return (flags.cumsum(0) > 0) & (flags.flip(0).cumsum(0).flip(0) > 0)


def _smoothed(values: Tensor, known: Tensor, width: int) -> Tensor:
    """Moving mean (N,) over `width` frames, odd, of those `values` (N,) that are known (N,); NaN where none is."""
    both = torch.stack([torch.where(known, values, 0.0), known.to(values.dtype)])
    total, share = torch.nn.functional.avg_pool1d(both, width, stride=1, padding=width // 2)
    return torch.where(share > 0, total / share, torch.nan)


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
