"""Stretches of clips: frames that follow each other, and what is said of them."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.fitting.observations import Observations
from stages.model.banmo import Banmo


def clips(model: Banmo) -> list[tuple[slice, float]]:
    """Where each clip's frames lie, and how many there are a second."""
    found = []
    for i, video in enumerate(model.videos):
        span = max(video.time_s[-1] - video.time_s[0], 1e-3)
        found.append((slice(model.starts[i], model.starts[i + 1]), max(1.0, (len(video.time_s) - 1) / span)))
    return found


def window(frames: float) -> int:
    """An odd number of frames, about so many."""
    return 2 * round(frames / 2) + 1


def between(flags: Tensor) -> Tensor:
    """From the first to the last that is set of `flags` (N,)."""
    return (flags.cumsum(0) > 0) & (flags.flip(0).cumsum(0).flip(0) > 0)


def smoothed(values: Tensor, known: Tensor, width: int) -> Tensor:
    """Moving mean (N,) over `width` frames, odd, of those `values` (N,) that are known (N,); NaN where none is."""
    both = torch.stack([torch.where(known, values, 0.0), known.to(values.dtype)])
    total, share = torch.nn.functional.avg_pool1d(both, width, stride=1, padding=width // 2)
    return torch.where(share > 0, total / share, torch.nan)


def long_runs(flags: Tensor, frames: float) -> Tensor:
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


def runs(frames: Tensor, model: Banmo) -> list[Tensor]:
    """Frame indices (N,), sorted, cut wherever one is missing or another clip begins."""
    video = model.video_idx.cpu()[frames]
    cut = torch.nonzero((frames[1:] != frames[:-1] + 1) | (video[1:] != video[:-1]))[:, 0] + 1
    return [part for part in torch.tensor_split(frames, cut) if len(part)]


def drawn(observations: Observations, model: Banmo, most: int, seed: int) -> Tensor:
    """Frames (T,) of stretches that can be seen, drawn at random until there are `most`: all of them in most runs."""
    chosen = torch.zeros(len(model.time), dtype=torch.bool)
    seen = torch.nonzero(observations.frame_weight > 0)[:, 0]
    stretches = [part for run in runs(seen, model) for part in run.split(most)]
    for i in torch.randperm(len(stretches), generator=torch.Generator().manual_seed(seed)).tolist():
        if int(chosen.sum()) + len(stretches[i]) <= most:
            chosen[stretches[i]] = True
    return chosen
