"""Dresses a bank's buffers: coat or clothes, light, background, things in the way, camera; a batch of pictures at once.

Everything random comes from one torch generator, so that a seed gives the same pictures. Pictures are sRGB in 0..1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from synthetic.bank import NOTHING, PARTS, SIDE_PX, Shard
from training.network import INPUT_PX

LABEL_PX = INPUT_PX // 4


@dataclass
class Bank:
    """A category's renderings as tensors, and what is needed to dress them. N pictures, V canonical vertices."""

    category: str
    vertex: Tensor  # (N, S, S) int16, V where nothing is
    part: Tensor  # (N, S, S) uint8
    normal: Tensor  # (N, S, S, 3) int8
    view: Tensor  # (N, 3) azimuth, elevation, roll in radians
    rest: Tensor  # (V, 3) canonical vertices
    mirror: Tensor  # (V,) canonical vertex on the other side

    @classmethod
    def of(cls, category: str, shards: list[Shard], rest: Tensor, mirror: Tensor) -> Bank:
        """Join shards."""
        joined = []
        for shard in shards:
            v = torch.from_numpy(shard.vertex.astype("int32"))
            joined.append(torch.where(v == NOTHING, len(rest), v).to(torch.int16))
        return cls(
            category,
            torch.cat(joined),
            torch.cat([torch.from_numpy(s.part) for s in shards]),
            torch.cat([torch.from_numpy(s.normal) for s in shards]),
            torch.cat([torch.from_numpy(s.view) for s in shards]),
            rest,
            mirror,
        )


@dataclass
class Batch:
    """What one training step sees of one category. S = INPUT_PX, L = LABEL_PX."""

    image: Tensor  # (B, 3, S, S) sRGB 0..1
    mask: Tensor  # (B, 1, S, S) coverage
    label: Tensor  # (B, L, L) canonical vertex, -1 where there is none
    view: Tensor  # (B, 3) radians
    present: Tensor  # (B,) bool: the object is in the picture
    shown: Tensor  # (B, 1, S, S) what a mask given as a prompt would cover: the object, or a thing in its place

    def to(self, device: torch.device) -> Batch:
        """The same on another device."""
        return Batch(*(value.to(device) for value in vars(self).values()))


class Random:
    """Draws from one generator."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return torch.rand(shape, generator=self.generator) * (high - low) + low

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator)

    def chance(self, count: int, probability: float) -> Tensor:
        """(count,) bool."""
        return torch.rand(count, generator=self.generator) < probability

    def below(self, limit: int, *shape: int) -> Tensor:
        return torch.randint(limit, shape, generator=self.generator)


def dress(
    banks: list[Bank], things: Bank, backgrounds: Tensor, count: int, draw: Random, hard: float = 1.0
) -> list[Batch]:
    """`count` fresh pictures of each category.

    `things` stand about in the background, and now and then in the object's place. `backgrounds` (M, 3, S', S') uint8;
    `hard` in 0..1 scales the faults.
    """
    dressed = [_coloured(bank, count, draw) for bank in banks]
    lumps = _coloured(things, (count + 1) // 2, draw)[0].repeat(2, 1, 1, 1)[:count]
    out = []
    for k, (bank, (rgba, vertex, view)) in enumerate(zip(banks, dressed, strict=True)):
        foreign = draw.chance(count, 0.35)[:, None, None, None]
        other = torch.where(foreign, dressed[(k + 1) % len(dressed)][0], lumps.roll(k, 0))
        out.append(_pictured(bank, rgba, vertex, view, other, lumps, backgrounds, draw, hard))
    return out


# --------------------------------------------------------------------------------------------- coats and clothes


def _coloured(bank: Bank, count: int, draw: Random) -> tuple[Tensor, Tensor, Tensor]:
    """(B, 4, S, S) premultiplied colour and coverage, (B, S, S) canonical vertices (V: none), (B, 3) views."""
    chosen = draw.below(len(bank.view), count)
    vertex = bank.vertex[chosen].long()
    on = vertex < len(bank.rest)
    coat, noise = _coat(bank, count, draw)
    colours, weight = _DRESS[bank.category](count, draw)
    flat = vertex.clamp_max(len(bank.rest) - 1).reshape(count, -1)
    part = bank.part[chosen].long().reshape(count, -1)
    of_coat = coat.gather(1, flat[..., None].expand(-1, -1, 3))
    grain = noise.gather(1, flat)[..., None]
    of_part = colours.gather(1, part[..., None].expand(-1, -1, 3)) * (1 + grain)
    alpha = weight.gather(1, part)[..., None]
    colour = of_coat + (of_part - of_coat) * alpha
    normal = bank.normal[chosen].reshape(count, -1, 3).float() / 127
    colour = (colour.clamp(0.02, 0.98) * _light(normal, draw)).clamp(0, 1)
    mask = on.reshape(count, -1, 1).float()
    rgba = torch.cat([colour * mask, mask], 2).transpose(1, 2).reshape(count, 4, SIDE_PX, SIDE_PX)
    return rgba, vertex, bank.view[chosen]


def _light(normal: Tensor, draw: Random) -> Tensor:
    """(B, P, 1) brightness of normals (B, P, 3) in the camera's frame: a lamp, mostly from above, and the sky."""
    count = len(normal)
    lamp = draw.normal(count, 3) * torch.tensor([0.8, 0.5, 0.6]) + torch.tensor([0.0, -0.8, -0.5])
    lamp = functional.normalize(lamp, dim=1)[:, :, None]
    flatness = draw.uniform(count, 1, 1) ** 0.7
    sun = (normal @ lamp).clamp_min(0) * draw.uniform(count, 1, 1, low=0.5, high=1.0)
    sky = 0.5 - 0.5 * normal[..., 1:2]
    shade = (1 - flatness) * (0.25 + sun) + flatness * (0.65 + 0.4 * sky)
    rim = 1 - draw.uniform(count, 1, 1, high=0.5) * (1 + normal[..., 2:3]).clamp(0, 1) ** 2
    return shade * rim


def _coat(bank: Bank, count: int, draw: Random) -> tuple[Tensor, Tensor]:
    """(B, V, 3) colours of a patterned coat and (B, V) a field of about -0.4..0.4 to vary other colours by."""
    x = bank.rest[None].expand(count, -1, -1)
    symmetric = draw.chance(count, 0.5)[:, None]
    x = torch.cat([torch.where(symmetric, x[..., 0].abs(), x[..., 0])[..., None], x[..., 1:]], 2)
    waves = 12
    scale = torch.cat(
        [draw.uniform(count, 1, 5, low=1.0, high=4.0), draw.uniform(count, 1, 7, low=4.0, high=18.0)], 2
    ).expand(-1, 3, -1)  # fmt: skip
    way = functional.normalize(draw.normal(count, 3, waves), dim=1)
    stripes = draw.chance(count, 0.3)[:, None, None]  # all fine waves one way
    way = torch.where(stripes & (torch.arange(waves) >= 5), way[..., 5:6] + 0.12 * way, way)
    field = torch.cos(x @ (way * scale) + draw.uniform(count, 1, waves, high=6.28))
    broad, fine = field[..., :5].sum(2) / 1.6, field[..., 5:].sum(2) / 1.9
    sharp = draw.uniform(count, 1, low=1.0, high=10.0)
    first = torch.sigmoid(sharp * (broad - draw.uniform(count, 1, low=-1.2, high=1.2)))
    second = torch.sigmoid(sharp * (fine - draw.uniform(count, 1, low=-0.6, high=1.6)))
    base, other, third = (_fur(count, draw)[:, None] for _ in range(3))
    amount = (draw.uniform(count, 1, 1) * draw.chance(count, 0.6)[:, None, None]) * first[..., None]
    coat = base + (other - base) * amount
    amount = (draw.uniform(count, 1, 1) * draw.chance(count, 0.45)[:, None, None]) * second[..., None]
    coat = coat + (third - coat) * amount
    coat = coat * (1 + 0.1 * fine[..., None] * draw.uniform(count, 1, 1))
    strong = torch.where(draw.chance(count, 0.4), draw.uniform(count), draw.uniform(count, high=0.15))[:, None]
    return coat, 0.3 * strong * torch.where(draw.chance(count, 0.5)[:, None], broad, torch.tanh(3 * fine))


def _fur(count: int, draw: Random) -> Tensor:
    """(B, 3) colours: mostly those of animals, now and then any."""
    grey = draw.uniform(count, 1, low=0.06, high=0.95)
    warm = draw.uniform(count, 1) * torch.tensor([[0.28, 0.02, -0.26]]) * (1 - (2 * grey - 1).abs()).sqrt()
    natural = (grey + warm + 0.02 * draw.normal(count, 3)).clamp(0.02, 0.98)
    return torch.where(draw.chance(count, 0.25)[:, None], draw.uniform(count, 3), natural)


def _skin(count: int, draw: Random) -> Tensor:
    light, dark = torch.tensor([0.96, 0.78, 0.66]), torch.tensor([0.26, 0.15, 0.10])
    return (dark + (light - dark) * draw.uniform(count, 1) ** 0.6 + 0.03 * draw.normal(count, 3)).clamp(0.02, 0.98)


def _markings(count: int, draw: Random) -> tuple[Tensor, Tensor]:
    """Colours (B, parts, 3) of a quadruped's parts and how much (B, parts) they cover the coat."""
    names = PARTS["quadruped"]
    colours = torch.stack([_fur(count, draw) for _ in names], 1)
    weight = torch.zeros(count, len(names))
    chances = {
        "belly": 0.45, "neck": 0.15, "head": 0.2, "muzzle": 0.45, "ear": 0.35, "ear_inside": 0.5, "upper_leg": 0.1,
        "lower_leg": 0.35, "paw": 0.45, "tail": 0.2, "tail_tip": 0.45, "rump": 0.06, "mane": 0.3,
    }  # fmt: skip
    for name, chance in chances.items():
        weight[:, names.index(name)] = draw.chance(count, chance) * draw.uniform(count, low=0.4, high=1.0)
    pink = torch.tensor([0.85, 0.62, 0.58]) * draw.uniform(count, 1, low=0.6, high=1.1)
    inside = names.index("ear_inside")
    colours[:, inside] = torch.where(draw.chance(count, 0.6)[:, None], pink, colours[:, inside])
    for name, chance in (("eye", 0.92), ("nose", 0.85)):
        k = names.index(name)
        colours[:, k] = torch.where(draw.chance(count, 0.85)[:, None], draw.uniform(count, 3, high=0.16), colours[:, k])
        weight[:, k] = draw.chance(count, chance).float()
    return colours, weight


def _pieces(count: int, draw: Random) -> tuple[Tensor, Tensor]:
    """Colours (B, parts, 3) of a thing's pieces and how much they cover its own pattern."""
    pieces = len(PARTS["thing"])
    plain = _cloth(count, draw)[:, None].expand(-1, pieces, -1)
    mixed = torch.stack([_cloth(count, draw) for _ in range(pieces)], 1)
    colours = torch.where(draw.chance(count, 0.5)[:, None, None], plain, mixed)
    return colours, draw.chance(count, 0.6)[:, None] * draw.uniform(count, pieces, low=0.5)


def _clothes(count: int, draw: Random) -> tuple[Tensor, Tensor]:
    """Colours (B, parts, 3) of a person's parts; clothes cover the body wholly."""
    names = PARTS["human"]
    skin, top, bottom = _skin(count, draw), _cloth(count, draw), _cloth(count, draw)
    bottom = torch.where(draw.chance(count, 0.1)[:, None], top, bottom)  # a dress, an overall
    hair = torch.where(draw.chance(count, 0.75)[:, None], 0.75 * _fur(count, draw), draw.uniform(count, 3))
    plain = dict.fromkeys(names, top)
    plain |= {"face": skin, "neck": skin, "hand": skin, "hair": hair, "pelvis": bottom, "thigh": bottom, "shin": bottom}
    colours = torch.stack([plain[n] for n in names], 1)

    def put(name: str, value: Tensor, chance: float) -> None:
        k = names.index(name)
        colours[:, k] = torch.where(draw.chance(count, chance)[:, None], value, colours[:, k])

    put("forearm", skin, 0.5)
    sleeveless = draw.chance(count, 0.2)[:, None]
    for name in ("sleeve", "forearm"):
        k = names.index(name)
        colours[:, k] = torch.where(sleeveless, skin, colours[:, k])
    put("shin", skin, 0.25)
    put("top_front", _cloth(count, draw), 0.3)
    put("top_back", _cloth(count, draw), 0.2)
    put("pelvis", top, 0.3)
    put("shoe", _cloth(count, draw), 0.85)
    put("hand", _cloth(count, draw), 0.05)
    put("eye", draw.uniform(count, 3, high=0.3), 1.0)
    put("mouth", skin * torch.tensor([0.85, 0.45, 0.45]), 1.0)
    put("brow", 0.6 * hair, 1.0)
    put("eye", skin, 0.05)
    wild = draw.chance(count, 0.1)[:, None, None]  # any colour anywhere
    return torch.where(wild, draw.uniform(count, len(names), 3), colours), torch.ones(count, len(names))


def _cloth(count: int, draw: Random) -> Tensor:
    grey = draw.uniform(count, 1, low=0.04, high=0.97)
    return (grey + draw.normal(count, 3) * draw.uniform(count, 1, high=0.4)).clamp(0.02, 0.98)


_DRESS: dict[str, Callable[[int, Random], tuple[Tensor, Tensor]]] = {
    "quadruped": _markings,
    "human": _clothes,
    "thing": _pieces,
}

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
) -> Batch:
    count, side = len(rgba), INPUT_PX
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
    coarse = _grid(scale, shift, flip, LABEL_PX, stretch)
    nothing = len(bank.rest)
    numbers = functional.grid_sample((vertex - nothing).float()[:, None], coarse, mode="nearest", align_corners=False)
    label = numbers[:, 0].long() + nothing
    swapped = torch.cat([bank.mirror, torch.tensor([nothing])])[label]
    label = torch.where(flip[:, None, None] < 0, swapped, label)

    back = _behind(backgrounds, count, draw)
    stranger = draw.chance(count, 0.45 * hard)[:, None, None, None]
    place = draw.uniform(count, 2, low=-1.6, high=1.6)
    another = functional.grid_sample(
        other, _grid(draw.uniform(count, low=1.0, high=2.6), place, flip, side), align_corners=False
    )
    another = another * stranger
    back = back * (1 - another[:, 3:]) + another[:, :3]
    alpha = seen[:, 3:]
    back = back * _shadow(alpha, draw)
    image = back * (1 - alpha) + seen[:, :3]
    image, alpha = _occlude(image, alpha, backgrounds, draw, hard)
    shown = (alpha > 0.5).float()
    mask = shown * present[:, None, None, None]
    hidden = functional.interpolate(alpha, (LABEL_PX, LABEL_PX), mode="area")[:, 0] < 0.5
    label = torch.where(hidden | (label >= nothing) | ~present[:, None, None], -1, label)
    angles = torch.stack([view[:, 0] * flip, view[:, 1], view[:, 2] * flip], 1)
    visible = mask.mean((1, 2, 3)) > 0.015
    return Batch(_camera(image, draw, hard), mask, label, angles, present & visible, shown)


def _behind(backgrounds: Tensor, count: int, draw: Random) -> Tensor:
    """(B, 3, S, S) windows into random backgrounds, their colours changed."""
    chosen = backgrounds[draw.below(len(backgrounds), count)].float() / 255
    scale = draw.uniform(count, low=0.45, high=1.0)
    flip = 1.0 - 2.0 * draw.chance(count, 0.5).float()
    shift = (1 - scale)[:, None] * draw.uniform(count, 2, low=-1, high=1)
    image = functional.grid_sample(chosen, _grid(scale, shift, flip, INPUT_PX), align_corners=False)
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


def _occlude(image: Tensor, alpha: Tensor, backgrounds: Tensor, draw: Random, hard: float) -> tuple[Tensor, Tensor]:
    """Something stands in front: a box or a bar that shows another background."""
    count, side = len(image), INPUT_PX
    some = int(count * 0.15 * hard)
    if not some:
        return image, alpha
    centre = draw.uniform(some, 2, 1, 1, high=float(side))
    half = draw.uniform(some, 2, 1, 1, low=2, high=0.22 * side)
    half[:, 1:] = torch.where(draw.chance(some, 0.3)[:, None, None, None], float(side), half[:, 1:])
    y, x = torch.arange(side)[:, None] + 0.5, torch.arange(side)[None] + 0.5
    box = (((x - centre[:, 0]).abs() < half[:, 0]) & ((y - centre[:, 1]).abs() < half[:, 1])).float()[:, None]
    front = _behind(backgrounds, some, draw)
    image = torch.cat([image[:some] * (1 - box) + front * box, image[some:]])
    return image, torch.cat([alpha[:some] * (1 - box), alpha[some:]])


def _camera(image: Tensor, draw: Random, hard: float) -> Tensor:
    """Blur, low resolution, exposure, colour temperature, contrast, noise."""
    count, side = len(image), INPUT_PX

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
