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

from stages.fitting.diagnose import FrameFigures, relative_error, unexplained
from stages.fitting.known_poses import best_sequence, known_motion, known_shapes, misfit, misfit_of_each, spread, views
from stages.fitting.observations import Observations
from stages.fitting.renew import imitate, pose_codes, posed, steer_codes
from stages.fitting.stretches import between, clips, drawn, long_runs, runs, smoothed, window
from stages.model.banmo import Banmo

_SMOOTH_S = 0.25  # seconds over which errors are averaged: a single bad frame is no other reading
_GAIN_S = 0.5  # ... and over which it is judged which reading is better
_LEAST_S = 0.3  # shortest stretch that is looked at, and shortest that is taken
_GAP_S = 0.4  # between two stretches that are looked at as one
_WORSE = 1.08  # of the clip's usual error: from here on a stretch is doubted
_MOST_SHARE = 0.35  # of a clip that is doubted: beyond that the clip, not the stretch, is at fault
_ONE_FRAME = 1.5  # of its clip's usual error: what a single frame can say at most
_APART = 0.08  # units (root mean square over the surface): nearer poses are the same reading
_LEAST_GAIN = -0.01  # of the usual error; below zero: where pictures do not tell, a pose seen elsewhere is likelier
_CLEAR_GAIN = 0.02  # ... where nothing was doubted: only that another pose would suit nearly as well
_MOST_POSES, _MOST_READ, _IMITATED = 400, 2000, 400
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
    before = figures_of(model, observations)
    usual = unexplained(before).nanmedian(0).values.clamp_min(1e-4)
    error = relative_error(before, usual)
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
    gain = relative_error(figures_of(same, focus), usual) - relative_error(figures_of(other, focus), usual)
    least = torch.where(doubted, _LEAST_GAIN, _CLEAR_GAIN)
    taken = agree(better(gain - least, looked_at, model).long()) > 0
    left = 0.0
    if taken.any():
        points = model.surface[spread(len(model.surface), _IMITATED)]
        target = torch.where(taken[:, None, None].to(points.device), posed(other, points), posed(model, points))
        redirect(model, torch.where(taken, wanted, -1))
        left = imitate(model, points, target, seed, steps=max(200, len(target) // 12))
    return Rethought(int(looked_at.sum()), int(taken.sum()), left)


def doubtful(error: Tensor, model: Banmo) -> Tensor:
    """Frames (T,) of stretches whose error (T,), relative to what is usual, stands out from their clip's."""
    found = torch.zeros(len(error), dtype=torch.bool)
    for mine, frames_a_second in clips(model):
        own = error[mine]
        known = ~own.isnan()
        if int(known.sum()) < 8:
            continue
        usual = own[known].median()
        # However bad one frame is, it says no more than a bad stretch does.
        told = torch.where(known, own.clamp_max(_ONE_FRAME * usual), 0.0)
        width = window(_SMOOTH_S * frames_a_second)
        smooth = smoothed(told, known, width).nan_to_num(float(usual))
        bad = smooth > max(_WORSE * float(smooth.median()), float(smooth.quantile(1 - _MOST_SHARE)))
        joined = bad | (between(bad) & ~long_runs(~bad, _GAP_S * frames_a_second))
        found[mine] = long_runs(joined, max(_LEAST_S * frames_a_second, width + 1))
    return found


def worst(frames: Tensor, error: Tensor, model: Banmo, most: int) -> Tensor:
    """Of the stretches in `frames` (T,) those with the largest mean error (T,), about `most` frames in all, as (T,)."""
    stretches = runs(torch.nonzero(frames)[:, 0], model)
    kept = torch.zeros_like(frames)
    for stretch in sorted(stretches, key=lambda some: -float(error[some].nanmean())):
        if int(kept.sum()) + len(stretch) <= most or not kept.any():
            kept[stretch[:most]] = True
    return kept


def better(gain: Tensor, looked_at: Tensor, model: Banmo) -> Tensor:
    """Frames (T,) of stretches long enough whose gain (T,) is above zero, of those that were looked at (T,)."""
    found = torch.zeros(len(gain), dtype=torch.bool)
    for mine, frames_a_second in clips(model):
        known = looked_at[mine] & ~gain[mine].isnan()
        # Only what is known counts: beyond a stretch's ends there is nothing to gain or lose.
        smooth = smoothed(gain[mine], known, window(_GAIN_S * frames_a_second))
        kept = (smooth > 0) & looked_at[mine]
        found[mine] = long_runs(kept, _LEAST_S * frames_a_second)
    return found


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
    motion = known_motion(model, seen, _MOST_POSES)
    for stretch in runs(asked_frames, model):
        view, now = views(model, stretch), known_shapes(model, stretch, motion.points).cpu()
        cost = misfit(motion.shapes, *view, observations, stretch)
        apart = torch.stack([(motion.shapes - shape).square().sum(-1).mean(-1).sqrt() for shape in now])
        cost[apart < _APART] = torch.inf
        if not bool(torch.isfinite(cost).any(1).all()):
            continue
        path = best_sequence(cost, motion.jump)
        found.frame[stretch] = motion.frames[path]
        own = misfit_of_each(now, *view, observations, stretch)
        found.excess[stretch] = (cost.gather(1, path[:, None])[:, 0] - own) / own.median().clamp_min(1e-6)
    return found


def closest(excess: Tensor, model: Banmo, without: Tensor, most: int) -> Tensor:
    """Frames (T,) of the stretches where `excess` (T,) is least, none of `without` (T,), up to `most` in all."""
    smooth = torch.full_like(excess, torch.inf)
    for mine, frames_a_second in clips(model):
        open_to_it = torch.isfinite(excess[mine]) & ~without[mine]
        own = smoothed(excess[mine], open_to_it, window(_SMOOTH_S * frames_a_second))
        smooth[mine] = torch.where(open_to_it, own, torch.inf)
    found = torch.zeros_like(without)
    levels = smooth[torch.isfinite(smooth)].sort().values
    for level in levels[spread(len(levels), _LEVELS)]:
        now = torch.zeros_like(found)
        for mine, frames_a_second in clips(model):
            now[mine] = long_runs(smooth[mine] <= level, _LEAST_S * frames_a_second)
        if int(now.sum()) > most:
            break
        found = now
    return found


def redirect(model: Banmo, wanted: Tensor) -> None:
    """Give frames the pose codes of others: frame t that of frame ``wanted[t]`` (T,); where it is -1, its own."""
    codes = pose_codes(model)
    wanted = wanted.to(codes.device)
    steer_codes(model, torch.where((wanted >= 0)[:, None], codes[wanted.clamp_min(0)] - codes, 0.0))
