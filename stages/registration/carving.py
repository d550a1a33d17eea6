"""From posed pictures to a volume: a soft visual hull by votes, coloured by the views that see its surface."""

from __future__ import annotations

import torch
from torch.nn.functional import avg_pool3d, grid_sample

from stages.registration.volume import Picture, ViewBank, Volume


def _sample(images: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
    return grid_sample(images, at[:, :, None], align_corners=False)[..., 0]  # (P, C, points)


def carve(
    bank: ViewBank, mask: torch.Tensor, weight: torch.Tensor, share: float = 0.75, softness: float = 0.06
) -> torch.Tensor:
    """Occupancy (N, N, N): voxels that at least `share` of the (weighted) masks contain.

    `mask` (P, S, S) is the mean mask of the frames in each view, `weight` (P,) how many frames those are. Each view's
    say saturates with its weight, so that a long look from one side does not outvote the others.
    """
    used = torch.nonzero(weight > 1e-3)[:, 0]
    say = weight[used] / (weight[used] + weight[used].mean())
    votes = torch.zeros(bank.voxels**3)
    for some, its_say in zip(used.split(24), say.split(24), strict=True):
        at, _ = bank.project(some)
        votes += (_sample(mask[some][:, None], at)[:, 0] * its_say[:, None]).sum(0)
    fraction = (votes / say.sum().clamp(min=1e-6)).reshape((bank.voxels,) * 3)
    return torch.sigmoid((fraction - share) / softness)


def paint(
    bank: ViewBank,
    occupancy: torch.Tensor,
    seen: Picture,
    mask: torch.Tensor,
    colour: torch.Tensor,
    weight: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Colour (C, N, N, N) and how well it is known (N, N, N) for voxels near the surface.

    `seen` is the bank's picture of the occupancy (for its relief), `mask` (P, S, S) and `colour` (P, C, S, S, times
    mask) the mean pictures of each view, `weight` (P,) their numbers of frames. A voxel takes the colours of the views
    in which it lies at the visible surface.
    """
    used = torch.nonzero(weight > 1e-3)[:, 0]
    solid = torch.nonzero(occupancy.reshape(-1) > 0.02)[:, 0]
    channels = colour.shape[1]
    total, sum_weight = torch.zeros(channels, len(solid)), torch.zeros(len(solid))
    reach = 2.0 * 2 * 1.25 / bank.voxels
    for some in used.split(24):
        at, relief = bank.project(some)
        at, relief = at[:, solid], relief[:, solid]
        values = _sample(torch.cat([mask[some][:, None], seen.relief[some][:, None], colour[some]], 1), at)
        front = torch.sigmoid((relief - values[:, 1] + reach) / (0.25 * reach))  # not behind what this view sees
        say = front * weight[some][:, None]
        total += (say[:, None] * values[:, 2:]).sum(0)
        sum_weight += (say * values[:, 0]).sum(0)
    known = sum_weight / (sum_weight + 0.5)
    size = bank.voxels**3
    out, out_known = torch.zeros(channels, size), torch.zeros(size)
    out[:, solid] = total / sum_weight.clamp(min=1e-4)
    out_known[solid] = known
    shape = (bank.voxels,) * 3
    return out.reshape(channels, *shape), out_known.reshape(shape)


def build(
    bank: ViewBank, mask: torch.Tensor, colour: torch.Tensor, weight: torch.Tensor, share: float = 0.75
) -> Volume:
    """The volume that the mean pictures of each view describe; see :func:`carve` and :func:`paint`."""
    occupancy = carve(bank, mask, weight, share)
    occupancy = avg_pool3d(occupancy[None, None], 3, 1, 1)[0, 0] * 0.5 + occupancy * 0.5
    blank = Volume(occupancy, torch.zeros(0, *occupancy.shape), torch.zeros_like(occupancy))
    seen = bank.render(blank)
    painted, known = paint(bank, occupancy, seen, mask, colour, weight)
    return Volume(occupancy, painted, known)
