"""Parts of a shape that are chosen at random: what dressing hides and what spoilt masks lack. Maps are (B, 1, S, S)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from training.wardrobe import Random


def sometimes(count: int, chance: float, draw: Random) -> Tensor:
    """(B, 1, 1, 1) bool."""
    return draw.chance(count, chance)[:, None, None, None]


def field(count: int, cells: int, side: int, draw: Random) -> Tensor:
    """(B, 1, S, S) smooth noise of about unit spread."""
    few = draw.normal(count, 1, cells, cells)
    return functional.interpolate(few, (side, side), mode="bicubic", align_corners=False)


def an_end(mask: Tensor, down_chance: float, longest: float, draw: Random) -> Tensor:
    """(B, 1, S, S) bool: what sticks out furthest in one direction, of `mask` or beside it: feet, hands, tail, head.

    The direction is about straight down with `down_chance`; the end takes up to `longest` of the shape's extent.
    """
    count, side = len(mask), mask.shape[-1]
    at = torch.linspace(-1, 1, side)
    y, x = at[:, None].expand(side, side), at[None].expand(side, side)
    turn = draw.uniform(count, 1, 1, 1, high=6.2832)
    down = torch.full_like(turn, 1.5708) + 0.25 * draw.normal(count, 1, 1, 1)
    turn = torch.where(sometimes(count, down_chance, draw), down, turn)
    along = x * torch.cos(turn) + y * torch.sin(turn) + 0.06 * field(count, 8, side, draw)
    reach = torch.where(mask > 0.5, along, -9.0).amax((2, 3), keepdim=True)
    least = torch.where(mask > 0.5, along, 9.0).amin((2, 3), keepdim=True)
    return along > reach - draw.uniform(count, 1, 1, 1, low=0.02, high=longest) * (reach - least).clamp_min(0)
