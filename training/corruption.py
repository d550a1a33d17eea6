"""Masks as a rough segmentation gives them: what the refining network is shown beside the picture and has to mend.

Coarse maps, feet and hands gone, gaps filled, halos, pieces lost to a background of the same colour and pieces won
from one. Maps are (B, 1, S, S) in 0..1; everything random comes from one generator.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from training.shapes import an_end, field, sometimes
from training.wardrobe import Random


def corrupted(mask: Tensor, image: Tensor, draw: Random, hidden: Tensor | None = None) -> Tensor:
    """A rough probability (B, 1, S, S) of the object whose true coverage is `mask`, in pictures (B, 3, S, S) sRGB.

    `hidden` (B, 1, S, S) is where the object looks like its background (`Batch.hidden`).
    """
    rough = _without_ends(mask, draw)
    if hidden is not None:
        rough = _without_hidden(rough, hidden, draw)
    rough = _by_colour(rough, image, draw)
    rough = _gaps_filled(rough, draw)
    rough = _blotted(rough, draw)
    rough = _coarse(rough, draw)
    return _as_probability(rough, draw)


def _resized(maps: Tensor, side: int) -> Tensor:
    """(B, 1, side, side), by averages when smaller and bilinear when larger."""
    if side < maps.shape[-1]:
        return functional.interpolate(maps, (side, side), mode="area")
    return functional.interpolate(maps, (side, side), mode="bilinear", align_corners=False)


def _without_ends(mask: Tensor, draw: Random) -> Tensor:
    """What sticks out furthest in one to three directions is faint: feet, hands, a tail, a head."""
    out = mask
    for k in range(3):
        end = an_end(mask, 0.6 if k == 0 else 0.2, 0.17, draw)
        left = draw.uniform(len(mask), 1, 1, 1, high=0.5)
        out = torch.where(end & sometimes(len(mask), 0.6 / (k + 1), draw), out * left, out)
    return out


def _without_hidden(rough: Tensor, hidden: Tensor, draw: Random) -> Tensor:
    """What looks like its background is mostly lost, and wholly so half the time."""
    count = len(rough)
    left = draw.uniform(count, 1, 1, 1, high=0.4) * sometimes(count, 0.5, draw)
    return torch.where((hidden > 0.5) & sometimes(count, 0.8, draw), rough * left, rough)


def _by_colour(rough: Tensor, image: Tensor, draw: Random) -> Tensor:
    """Object taken for background of its colour, and the other way round, in one part of the picture."""
    count, side = len(rough), rough.shape[-1]
    rows, columns = draw.below(side, count), draw.below(side, count)
    colour = image[torch.arange(count), :, rows, columns][:, :, None, None]
    alike = (image - colour).abs().sum(1, keepdim=True) < draw.uniform(count, 1, 1, 1, low=0.1, high=0.4)
    alike = functional.avg_pool2d(alike.float(), 5, 1, 2) > 0.5
    here = field(count, 4, side, draw) > 0.0
    near = _resized(functional.max_pool2d(_resized(rough, side // 4), 7, 1, 3), side) > 0.3
    lost = alike & here & (rough > 0.5) & sometimes(count, 0.35, draw)
    won = alike & here & near & (rough < 0.5) & sometimes(count, 0.3, draw)
    level = draw.uniform(count, 1, 1, 1, high=0.45)
    return torch.where(lost, level, torch.where(won, 1 - level, rough))


def _gaps_filled(rough: Tensor, draw: Random) -> Tensor:
    """Gaps between limbs closed, or thin limbs lost."""
    count, side = len(rough), rough.shape[-1]
    half = _resized(rough, side // 2)
    for size, chance in ((5, 0.15), (9, 0.2)):
        pad = size // 2
        wide = functional.max_pool2d(half, size, 1, pad)
        closed = _resized(-functional.max_pool2d(-wide, size, 1, pad), side)
        rough = torch.where(sometimes(count, chance, draw), torch.maximum(rough, closed), rough)
    opened = _resized(functional.max_pool2d(-functional.max_pool2d(-half, 3, 1, 1), 3, 1, 1), side)
    return torch.where(sometimes(count, 0.12, draw), torch.minimum(rough, 0.3 * rough + 0.7 * opened), rough)


def _blotted(rough: Tensor, draw: Random) -> Tensor:
    """Pieces lost and stray pieces, anywhere."""
    count, side = len(rough), rough.shape[-1]
    broad = field(count, 6, side, draw)
    level = draw.uniform(count, 1, 1, 1, high=0.45)
    lost = (broad > 1.2) & sometimes(count, 0.25, draw)
    stray = (broad < -1.5) & sometimes(count, 0.25, draw)
    return torch.where(lost, rough * level, torch.where(stray, torch.maximum(rough, 1 - level), rough))


def _coarse(rough: Tensor, draw: Random) -> Tensor:
    """Seen through few cells, or shifted by an outline that wanders."""
    count, side = len(rough), rough.shape[-1]
    out = rough
    for cells, chance in ((side // 2, 0.5), (side // 4, 0.4), (side // 7, 0.25)):
        seen = _resized(_resized(rough, cells), side)
        out = torch.where(sometimes(count, chance, draw), seen, out)
    wide = functional.avg_pool2d(functional.pad(out, (3, 3, 3, 3)), 7, 1)
    halo = draw.uniform(count, 1, 1, 1, low=-0.3, high=0.4) + draw.uniform(count, 1, 1, 1, high=0.3) * field(
        count, 16, side, draw
    )
    moved = (wide + halo * (4 * wide * (1 - wide))).clamp(0, 1)
    return torch.where(sometimes(count, 0.7, draw), moved, out)


def _as_probability(rough: Tensor, draw: Random) -> Tensor:
    """Sharpened or softened, and in one case in four cut into yes and no."""
    count = len(rough)
    logit = torch.log((rough + 0.01) / (1.01 - rough)) * draw.uniform(count, 1, 1, 1, low=0.5, high=1.6)
    soft = torch.sigmoid(logit + 0.3 * draw.normal(count, 1, 1, 1))
    return torch.where(sometimes(count, 0.25, draw), (rough > 0.5).float(), soft)
