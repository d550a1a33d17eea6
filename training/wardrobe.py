"""Coats, clothes and light for a bank's buffers; see :mod:`training.dressing`, which makes pictures of them.

Everything random comes from one torch generator, so that a seed gives the same pictures. Colours are sRGB in 0..1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from synthetic.bank import NOTHING, PARTS, Shard


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


def coloured(bank: Bank, count: int, draw: Random) -> tuple[Tensor, Tensor, Tensor]:
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
    rgba = torch.cat([colour * mask, mask], 2).transpose(1, 2).reshape(count, 4, *vertex.shape[1:])
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
