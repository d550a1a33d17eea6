"""Dresses a bank's buffers: coat or clothes, light, background, things in the way, camera; a batch of pictures at once.

Everything random comes from one torch generator, so that a seed gives the same pictures. Pictures are sRGB in 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from training.shapes import an_end, sometimes
from training.wardrobe import Bank, Random, coloured

LABEL_SHARE = 4
"""Pixels of a picture to one label."""


@dataclass
class Batch:
    """What one training step sees of one category. S = side of the bank's pictures, L = S / 4."""

    image: Tensor  # (B, 3, S, S) sRGB 0..1
    mask: Tensor  # (B, 1, S, S) coverage
    label: Tensor  # (B, L, L) canonical vertex, -1 where there is none
    view: Tensor  # (B, 3) radians
    present: Tensor  # (B,) bool: the object is in the picture
    shown: Tensor  # (B, 1, S, S) what a mask given as a prompt would cover: the object, or a thing in its place
    hidden: Tensor  # (B, 1, S, S) where the object was given the looks of its background

    def to(self, device: torch.device) -> Batch:
        """The same on another device."""
        return Batch(*(value.to(device) for value in vars(self).values()))


def dress(
    banks: list[Bank], things: Bank, backgrounds: Tensor, count: int, draw: Random, hard: float = 1.0,
    hide: float = 0.0,
) -> list[Batch]:  # fmt: skip
    """`count` fresh pictures of each category.

    `things` stand about in the background, and now and then in the object's place. `backgrounds` (M, 3, S', S') uint8;
    `hard` in 0..1 scales the faults; with the chance `hide` an end of the object has the colour of what lies behind it.
    """
    dressed = [coloured(bank, count, draw) for bank in banks]
    lumps = coloured(things, (count + 1) // 2, draw)[0].repeat(2, 1, 1, 1)[:count]
    out = []
    for k, (bank, (rgba, vertex, view)) in enumerate(zip(banks, dressed, strict=True)):
        foreign = draw.chance(count, 0.35)[:, None, None, None]
        other = torch.where(foreign, dressed[(k + 1) % len(dressed)][0], lumps.roll(k, 0))
        out.append(_pictured(bank, rgba, vertex, view, other, lumps, backgrounds, draw, hard, hide))
    return out


# --------------------------------------------------------------------------------------------- the picture


def _grid(scale: Tensor, shift: Tensor, flip: Tensor, side: int, stretch: Tensor | None = None) -> Tensor:
    """Sampling grid (B, side, side, 2): crops `scale` times the buffer, moved by `shift` (B, 2), mirrored by `flip`."""
    count = len(scale)
    theta = torch.zeros(count, 2, 3)
    theta[:, 0, 0], theta[:, 1, 1] = scale * flip, scale
    if stretch is not None:
        theta[:, 0, 0] = theta[:, 0, 0] * stretch
    theta[:, :, 2] = shift
    return functional.affine_grid(theta, [count, 1, side, side], align_corners=False)


def _pictured(
    bank: Bank,
    rgba: Tensor,
    vertex: Tensor,
    view: Tensor,
    other: Tensor,
    lumps: Tensor,
    backgrounds: Tensor,
    draw: Random,
    hard: float,
    hide: float,
) -> Batch:
    count, side = len(rgba), rgba.shape[-1]
    few = side // LABEL_SHARE
    flip = 1.0 - 2.0 * draw.chance(count, 0.5).float()
    wide = draw.chance(count, 0.2)
    scale = torch.where(wide, draw.uniform(count, low=1.4, high=2.2), draw.uniform(count, low=0.98, high=1.45))
    scale = torch.where(draw.chance(count, 0.08 * hard), draw.uniform(count, low=0.6, high=1.0), scale)
    room = (scale - 0.95).clamp_min(0.03)[:, None]
    shift = draw.uniform(count, 2, low=-1, high=1) * torch.where(wide[:, None], 0.8 * room, 0.6 * room)
    cut = draw.chance(count, 0.12 * hard)[:, None]
    shift = torch.where(cut, draw.uniform(count, 2, low=-0.75, high=0.75), shift)
    stretch = torch.exp(0.06 * draw.normal(count))
    grid = _grid(scale, shift, flip, side, stretch)
    present = ~draw.chance(count, 0.12)
    instead = (~present & draw.chance(count, 0.75))[:, None, None, None]
    seen = functional.grid_sample(torch.where(instead, lumps, rgba), grid, align_corners=False)
    seen = seen * (present[:, None, None, None] | instead)
    coarse = _grid(scale, shift, flip, few, stretch)
    nothing = len(bank.rest)
    numbers = functional.grid_sample((vertex - nothing).float()[:, None], coarse, mode="nearest", align_corners=False)
    label = numbers[:, 0].long() + nothing
    swapped = torch.cat([bank.mirror, torch.tensor([nothing])])[label]
    label = torch.where(flip[:, None, None] < 0, swapped, label)

    back = _behind(backgrounds, count, side, draw)
    stranger = draw.chance(count, 0.45 * hard)[:, None, None, None]
    place = draw.uniform(count, 2, low=-1.6, high=1.6)
    another = functional.grid_sample(
        other, _grid(draw.uniform(count, low=1.0, high=2.6), place, flip, side), align_corners=False
    )
    another = another * stranger
    back = back * (1 - another[:, 3:]) + another[:, :3]
    alpha = seen[:, 3:]
    back = back * _shadow(alpha, draw)
    colour, hidden = seen[:, :3], torch.zeros_like(alpha)
    if hide > 0:
        colour, hidden = _hidden(colour, alpha, back, hide, draw)
    image = back * (1 - alpha) + colour
    image, alpha = _occlude(image, alpha, backgrounds, draw, hard)
    shown = (alpha > 0.5).float()
    mask = shown * present[:, None, None, None]
    covered = functional.interpolate(alpha, (few, few), mode="area")[:, 0] < 0.5
    label = torch.where(covered | (label >= nothing) | ~present[:, None, None], -1, label)
    angles = torch.stack([view[:, 0] * flip, view[:, 1], view[:, 2] * flip], 1)
    visible = mask.mean((1, 2, 3)) > 0.015
    return Batch(_camera(image, draw, hard), mask, label, angles, present & visible, shown, hidden)


def _behind(backgrounds: Tensor, count: int, side: int, draw: Random) -> Tensor:
    """(B, 3, S, S) windows into random backgrounds, their colours changed."""
    chosen = backgrounds[draw.below(len(backgrounds), count)].float() / 255
    scale = draw.uniform(count, low=0.45, high=1.0)
    flip = 1.0 - 2.0 * draw.chance(count, 0.5).float()
    shift = (1 - scale)[:, None] * draw.uniform(count, 2, low=-1, high=1)
    image = functional.grid_sample(chosen, _grid(scale, shift, flip, side), align_corners=False)
    return (image * draw.uniform(count, 3, 1, 1, low=0.75, high=1.25) * draw.uniform(count, 1, 1, 1, low=0.7)).clamp(
        0, 1
    )


def _shadow(alpha: Tensor, draw: Random) -> Tensor:
    """(B, 1, S, S) factor on the background: a blurred, shifted, flattened copy of the object's shape darkens it."""
    count = len(alpha)
    theta = torch.zeros(count, 2, 3)
    theta[:, 0, 0], theta[:, 0, 1] = 1.0, draw.uniform(count, low=-0.8, high=0.8)
    theta[:, 1, 1] = draw.uniform(count, low=1.2, high=3.5)
    theta[:, 1, 2] = -0.75 * (theta[:, 1, 1] - 1)
    grid = functional.affine_grid(theta, list(alpha.shape), align_corners=False)
    cast = functional.avg_pool2d(functional.grid_sample(alpha, grid, align_corners=False), 7, 1, 3)
    strength = draw.uniform(count, 1, 1, 1, high=0.65) * draw.chance(count, 0.6)[:, None, None, None]
    return 1 - strength * cast


def _hidden(colour: Tensor, alpha: Tensor, back: Tensor, chance: float, draw: Random) -> tuple[Tensor, Tensor]:
    """Dark shoes on dark ground: now and then an end of the object takes the colour of what is behind and around it.

    Its own light and shade stay. Colours (B, 3, S, S) are premultiplied; also returns where, (B, 1, S, S).
    """
    count, side = len(alpha), alpha.shape[-1]
    end = an_end(alpha, 0.75, 0.2, draw) & sometimes(count, chance, draw)
    cells = side // 16
    near = functional.interpolate(back, (cells, cells), mode="area")
    near = functional.interpolate(near, (side, side), mode="bilinear", align_corners=False)
    near = near * draw.uniform(count, 1, 1, 1, low=0.8, high=1.2) + 0.02 * draw.normal(count, 3, 1, 1)
    inside = end.float() * alpha
    light = colour.mean(1, keepdim=True) / alpha.clamp_min(1e-3)
    mean = (light * inside).sum((2, 3), keepdim=True) / inside.sum((2, 3), keepdim=True).clamp_min(1)
    shade = (light / mean.clamp_min(0.02)).clamp(0.4, 1.7) ** draw.uniform(count, 1, 1, 1, low=0.2, high=1.0)
    share = draw.uniform(count, 1, 1, 1, low=0.75, high=1.0) * end
    return colour + share * (alpha * (near * shade).clamp(0, 1) - colour), (inside > 0.5).float()


def _occlude(image: Tensor, alpha: Tensor, backgrounds: Tensor, draw: Random, hard: float) -> tuple[Tensor, Tensor]:
    """Something stands in front: a box or a bar that shows another background."""
    count, side = len(image), image.shape[-1]
    some = int(count * 0.15 * hard)
    if not some:
        return image, alpha
    centre = draw.uniform(some, 2, 1, 1, high=float(side))
    half = draw.uniform(some, 2, 1, 1, low=2, high=0.22 * side)
    half[:, 1:] = torch.where(draw.chance(some, 0.3)[:, None, None, None], float(side), half[:, 1:])
    y, x = torch.arange(side)[:, None] + 0.5, torch.arange(side)[None] + 0.5
    box = (((x - centre[:, 0]).abs() < half[:, 0]) & ((y - centre[:, 1]).abs() < half[:, 1])).float()[:, None]
    front = _behind(backgrounds, some, side, draw)
    image = torch.cat([image[:some] * (1 - box) + front * box, image[some:]])
    return image, torch.cat([alpha[:some] * (1 - box), alpha[some:]])


def _camera(image: Tensor, draw: Random, hard: float) -> Tensor:
    """Blur, low resolution, exposure, colour temperature, contrast, noise."""
    count, side = len(image), image.shape[-1]

    def where(chance: float) -> Tensor:
        return draw.chance(count, chance)[:, None, None, None]

    soft = functional.avg_pool2d(functional.pad(image, (1, 1, 1, 1), mode="replicate"), 3, 1)
    image = torch.where(where(0.35), soft, image)
    smeared = functional.avg_pool2d(functional.pad(image, (3, 3, 0, 0), mode="replicate"), (1, 7), 1)
    image = torch.where(where(0.08 * hard), smeared, image)
    small = functional.interpolate(image, (side // 2, side // 2), mode="area")
    image = torch.where(
        where(0.18 * hard), functional.interpolate(small, (side, side), mode="bilinear", align_corners=False), image
    )
    contrast = draw.uniform(count, 1, 1, 1, low=0.75, high=1.3)
    image = (image - 0.45) * contrast + 0.45 + 0.07 * draw.normal(count, 1, 1, 1) * hard
    image = image * (1 + 0.08 * draw.normal(count, 3, 1, 1))
    grey = image.mean(1, keepdim=True)
    image = torch.where(where(0.06), grey.expand_as(image), image)
    noise = draw.uniform(count, 1, 1, 1, high=0.04) * where(0.5) * hard
    return (image + noise * draw.normal(count, 3, side, side)).clamp(0, 1)
