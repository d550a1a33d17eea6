"""Motion that recurs: a stride seen from the side, and the like of it seen from behind.

One view leaves a limb's depth open, or hides it; another view of the same moment does not. Strides, jumps and gestures
recur, within a clip and from clip to clip, so stretches that may show one motion are looked for, fitted to both
stretches' pictures at once on a copy of the model, and the motion found so is taken up where it explains the pictures
nearly as well as two free ones do. From there on both are free again: what differs between two strides is fitted, but
from one start. Not in the paper.

Axes: T all kept frames, N frames of a stretch.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from stages.fitting.diagnose import FrameFigures, relative_error, unexplained
from stages.fitting.known_poses import (
    best_sequence,
    known_motion,
    known_shapes,
    misfit,
    misfit_of_each,
    spread,
    views,
)
from stages.fitting.observations import Observations
from stages.fitting.renew import imitate, pose_codes, posed, steer_codes
from stages.fitting.stretches import clips, drawn, runs, smoothed, window
from stages.model.banmo import Banmo

_APART_S = 0.5  # seconds: nearer frames of one clip show the same moment anyway
_LEAST_S = 0.6  # shortest stretch that counts as a motion
_SLACK_S = 0.2  # of time by which a recurring motion may run ahead or behind
_SMOOTH_S = 0.6  # over which it is judged whose motion both start from
_ALIKE = 0.1  # share by which frame rates may differ
_EVERY = 10  # steps after which both are brought together again
_TOLERATED = 0.17  # of the usual error: what one motion may explain less than two, each free to follow its own pictures
_POINTS, _MOST_POSES, _MOST_READ, _IMITATED = 160, 400, 2000, 400


class Recurred(NamedTuple):
    """What was found, in frames."""

    paired: int
    taken: int
    left: float  # units (root mean square): how far the motion is from the one that was chosen


class Pair(NamedTuple):
    """Two stretches that may show one motion."""

    first: Tensor  # (N,) frames, one after the other
    second: Tensor  # (N,) the frame that shows the same moment as each of them


def share_motion(
    model: Banmo,
    observations: Observations,
    figures_of: Callable[[Banmo, Observations], FrameFigures],
    practise: Callable[[Banmo, Observations, Callable[[Banmo, int], None]], None],
    most: int,
    seed: int,
    agree: Callable[[Tensor], Tensor] = lambda tensor: tensor,
) -> Recurred:
    """Find stretches that show one motion, fit it to the pictures of both, and take it up where it explains them.

    Args:
        figures_of: how well a model explains each frame with weight.
        practise: fits the motion of a model, and nothing else, to the frames with weight; the same effort each time;
            calls what it is given after every step, with the model and the number of steps made.
        most: frames for which that effort suffices; those that are furthest apart come first.
        agree: makes processes that share the work decide alike (see :mod:`stages.fitting.team`).
    """
    partner = agree(recurring(model, observations, most, seed))
    paired = partner >= 0
    if not paired.any():
        return Recurred(0, 0, 0.0)
    focus = replace(observations, frame_weight=observations.frame_weight * paired)
    usual = unexplained(figures_of(model, focus)).nanmedian(0).values.clamp_min(1e-4)
    apart, together = deepcopy(model), deepcopy(model)
    practise(apart, focus, lambda some, step: None)
    meet(together, partner, agree(suits_both(model, observations, partner).float()))
    practise(together, focus, lambda some, step: meet(some, partner) if step % _EVERY == 0 else None)
    meet(together, partner)
    gain = relative_error(figures_of(apart, focus), usual) - relative_error(figures_of(together, focus), usual)
    taken = agree(tolerable(gain, partner, model).long()) > 0
    left = 0.0
    if taken.any():
        points = model.surface[spread(len(model.surface), _IMITATED)]
        target = torch.where(taken[:, None, None].to(points.device), posed(together, points), posed(model, points))
        steer_codes(model, torch.where(taken[:, None].to(points.device), pose_codes(together) - pose_codes(model), 0.0))
        left = imitate(model, points, target, seed, steps=max(200, len(target) // 12))
    return Recurred(int(paired.sum()), int(taken.sum()), left)


@torch.no_grad()
def recurring(model: Banmo, observations: Observations, most: int, seed: int) -> Tensor:
    """The frame that may show the same moment of a motion as each (T,), and -1 where none does; mutual.

    Where a path through the known motions follows one of them at its own pace for long enough, over masks of another
    stretch, the two may be one motion. Those that are furthest apart now come first, up to `most` frames in all: what
    is alike already has little to gain.
    """
    pairs = uncontested(candidates(model, observations, seed), model)
    points = model.surface[spread(len(model.surface), _POINTS)]
    apart = [known_shapes(model, pair.first, points) - known_shapes(model, pair.second, points) for pair in pairs]
    gap = [float(some.square().sum(-1).mean(-1).sqrt().sum()) for some in apart]
    partner = torch.full((len(model.time),), -1)
    for i in sorted(range(len(pairs)), key=lambda i: -gap[i]):
        room = (most - int((partner >= 0).sum())) // 2
        first, second = (side[:room] for side in pairs[i])
        if len(first) >= _least(model, int(pairs[i].first[0])):
            partner[first], partner[second] = second, first
    return partner


def uncontested(pairs: list[Pair], model: Banmo) -> list[Pair]:
    """Pairs that share no frame: where some want the same ones, the longest have them."""
    free, found = torch.ones(len(model.time), dtype=torch.bool), []
    for pair in sorted(pairs, key=lambda some: -len(some.first)):
        both = free[pair.first] & free[pair.second]
        for part in runs(pair.first[both], model):
            second = pair.second[torch.isin(pair.first, part)]
            if len(part) >= _least(model, int(part[0])) and not bool(torch.isin(part, second).any()):
                found.append(Pair(part, second))
                free[part] = free[second] = False
    return found


def candidates(model: Banmo, observations: Observations, seed: int) -> list[Pair]:
    """Stretches of all clips, each with the one whose known motion suits it best, at one pace."""
    visible = observations.frame_weight > 0
    seen = torch.nonzero(visible)[:, 0]
    if len(seen) == 0 or len(model.surface) == 0:
        return []
    motion = known_motion(model, seen, _MOST_POSES)
    rates = torch.tensor([rate for _, rate in clips(model)])
    video, found = model.video_idx.cpu(), []
    for stretch in runs(torch.nonzero(drawn(observations, model, _MOST_READ, seed))[:, 0], model):
        mine = int(video[stretch[0]])
        cost = misfit(motion.shapes, *views(model, stretch), observations, stretch)
        moment = (motion.frames - stretch[:, None]).abs() < _APART_S * float(rates[mine])
        other_pace = (rates[video[motion.frames]] / rates[mine] - 1).abs() >= _ALIKE
        cost[(moment & (video[motion.frames] == mine)) | other_pace] = torch.inf
        if not bool(torch.isfinite(cost).any(1).all()):
            continue
        path = motion.frames[best_sequence(cost, motion.jump)]
        for first, delay in at_one_pace(stretch, path, video, _SLACK_S * float(rates[mine])):
            second = first + delay
            inside = (second >= 0) & (second < len(video))
            inside &= video[second.clamp(0, len(video) - 1)] == video[path[stretch == first[0]]]
            keep = inside & visible[second.clamp(0, len(video) - 1)]
            if int(keep.sum()) >= _least(model, int(stretch[0])):
                found.append(Pair(first[keep], second[keep]))
    return found


def at_one_pace(stretch: Tensor, path: Tensor, video: Tensor, slack: float) -> list[tuple[Tensor, int]]:
    """Parts (N,) of a stretch (T,) of frames whose `path` (T,) stays in one clip at about one delay, and that delay."""
    found, start = [], 0
    for end in range(1, len(stretch) + 1):
        delay = int((path - stretch)[start:end].median())
        if end < len(stretch):
            goes_on = video[path[end]] == video[path[start]] and abs(int(path[end] - stretch[end]) - delay) <= slack
            if goes_on:
                continue
        found.append((stretch[start:end], delay))
        start = end
    return found


@torch.no_grad()
def suits_both(model: Banmo, observations: Observations, partner: Tensor) -> Tensor:
    """Frames (T,) whose pose suits both masks worse than that of their partner (T,) does."""
    paired = torch.nonzero(partner >= 0)[:, 0]
    points, view = model.surface[spread(len(model.surface), _POINTS)], views(model, paired)
    misfits = torch.zeros(2, len(partner))
    for i, frames in enumerate((paired, partner[paired])):
        shapes = known_shapes(model, frames, points).cpu()
        misfits[i, paired] = misfit_of_each(shapes, *view, observations, paired)
    own, other = misfits
    back = partner.clamp_min(0)
    gain = torch.where(partner >= 0, own + other[back] - other - own[back], 0.0)
    worse = torch.zeros(len(partner), dtype=torch.bool)
    for mine, rate in clips(model):
        worse[mine] = smoothed(gain[mine], partner[mine] >= 0, window(_SMOOTH_S * rate)).nan_to_num() > 0
    return worse & (partner >= 0)


@torch.no_grad()
def meet(model: Banmo, partner: Tensor, share: Tensor | float = 0.5) -> None:
    """Bring pose codes of frames towards those of their partners (T,), by a share of the way (T,) or one for all."""
    codes = pose_codes(model)
    way = share[:, None].to(codes.device) if isinstance(share, Tensor) else share
    other = codes[partner.clamp_min(0).to(codes.device)]
    steer_codes(model, torch.where((partner >= 0)[:, None].to(codes.device), way * (other - codes), 0.0))


def tolerable(gain: Tensor, partner: Tensor, model: Banmo) -> Tensor:
    """Frames (T,) of pairs that one motion explains nearly as well as two do: mean gain (T,) of both stretches."""
    found = torch.zeros(len(partner), dtype=torch.bool)
    for stretch in runs(torch.nonzero(partner >= 0)[:, 0], model):
        delay = (partner - torch.arange(len(partner)))[stretch]
        for part in torch.tensor_split(stretch, torch.nonzero(delay[1:] != delay[:-1])[:, 0] + 1):
            mean = torch.cat([gain[part], gain[partner[part]]]).nanmean()
            found[part] = bool(mean >= -_TOLERATED)  # not where nothing is known
    return found


def _least(model: Banmo, frame: int) -> int:
    """Frames that the shortest motion takes in the clip of a frame."""
    return max(6, round(_LEAST_S * clips(model)[int(model.video_idx[frame])][1]))
