"""A small coloured volume seen from a bank of views, rendered differentiably.

The volume is a cube of N^3 voxels about the object's origin, side ``2 EXTENT`` units, index order (z, y, x) as
``grid_sample`` wants it, in object space (y up). A view looks at the origin from OBJECT_DEPTH away; its picture is the
S x S window that spans ``+-EXTENT`` units at that depth. All tensors float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn.functional import grid_sample

from stages.registration.placing import OBJECT_DEPTH, view_rotation

EXTENT = 1.25
"""Half the side of the volume and of the pictures' window, units."""
_ABSORPTION = 12.0
"""Per unit of full occupancy: a sixth of a unit is nearly opaque."""


@dataclass
class Picture:
    """P rendered views: opacity (P, S, S), colour times opacity (P, C, S, S), relief (P, S, S) in units.

    Relief is how far the visible surface lies in front of the object's origin.
    """

    opacity: torch.Tensor
    colour: torch.Tensor
    relief: torch.Tensor


class ViewBank:
    """Views on a grid of azimuths times elevations (radians): view ``a * len(elevation) + e``."""

    def __init__(self, azimuth: np.ndarray, elevation: np.ndarray, size: int) -> None:
        self.azimuth, self.elevation = np.asarray(azimuth, np.float64), np.asarray(elevation, np.float64)
        self.shape = (len(self.azimuth), len(self.elevation))
        self.size = size
        grid_a, grid_e = np.meshgrid(self.azimuth, self.elevation, indexing="ij")
        self.rotation = torch.as_tensor(view_rotation(grid_a.ravel(), grid_e.ravel()), dtype=torch.float32)
        axis = pixel_axis(size)
        self.depth = axis * EXTENT  # of the steps along a ray, beyond the origin
        zoom = (OBJECT_DEPTH + self.depth) / OBJECT_DEPTH * EXTENT
        shape = (size, size, size)  # row, column, depth
        parts = [axis[None, :, None] * zoom, axis[:, None, None] * zoom, self.depth]
        self._ray = torch.stack([p.expand(shape) for p in parts], -1).reshape(-1, 3)

    def __len__(self) -> int:
        return len(self.rotation)

    def render(self, occupancy: torch.Tensor, colour: torch.Tensor, rotation: torch.Tensor | None = None) -> Picture:
        """Pictures of occupancy (N, N, N) in 0..1 and colour (C, N, N, N) from (P, 3, 3) rotations (all views).

        Light is absorbed along the ray; each step's share is ``T (1 - exp(-k o))``.
        """
        rotation = self.rotation if rotation is None else rotation
        channels = torch.cat([occupancy[None], colour])[None]
        size = self.size
        strength = _ABSORPTION * 2 * EXTENT / size
        opacity, colours, reliefs = [], [], []
        for some in rotation.split(16):
            at = (self._ray @ some) / EXTENT  # x_obj = R^T x_cam
            sampled = grid_sample(
                channels.expand(len(some), -1, -1, -1, -1),
                at.reshape(len(some), size * size, -1, 1, 3),
                align_corners=False,
            ).reshape(len(some), channels.shape[1], size, size, size)
            thickness = strength * sampled[:, 0]
            before = torch.cumsum(thickness, -1) - thickness
            weight = torch.exp(-before) * (1 - torch.exp(-thickness))
            total = weight.sum(-1)
            opacity.append(total)
            colours.append((weight[:, None] * sampled[:, 1:]).sum(-1))
            reliefs.append(-(weight.detach() * self.depth).sum(-1) / total.detach().clamp(min=1e-3))
        return Picture(torch.cat(opacity), torch.cat(colours), torch.cat(reliefs))


def pixel_axis(size: int) -> torch.Tensor:
    """Centres of `size` pixels across -1..1, (size,)."""
    return (torch.arange(size, dtype=torch.float32) + 0.5) * (2 / size) - 1


def pixel_grid(size: int) -> torch.Tensor:
    """Centres of the pixels of a square picture, (size, size, 2) as x, y in -1..1."""
    axis = pixel_axis(size)
    return torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1)


def centre_and_area(opacity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Centroid (P, 2) and area (P,) of soft masks (P, S, S), where the picture spans -1..1 (so its area is 4)."""
    axis = pixel_axis(opacity.shape[-1])
    total = opacity.sum((1, 2)).clamp(min=1.0)
    centre = torch.stack([(opacity * axis).sum((1, 2)), (opacity * axis[:, None]).sum((1, 2))], 1) / total[:, None]
    return centre, total * (2 / opacity.shape[-1]) ** 2
