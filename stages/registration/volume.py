"""A small coloured volume seen from a bank of views: rendering, and its way back from pictures to volume.

The volume is a cube of N^3 voxels about the object's origin, side ``2 EXTENT`` units, index order (z, y, x) as
``grid_sample`` wants it, in object space (y up). A view looks at the origin from OBJECT_DEPTH away; its picture is the
S x S window that spans ``+-EXTENT`` units at that depth. All tensors float32 on one device.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn.functional import grid_sample

from stages.registration.placing import OBJECT_DEPTH, view_rotation

EXTENT = 1.25
"""Half the side of the volume and of the pictures' window, units."""


@dataclass
class Volume:
    """Occupancy (N, N, N) in 0..1, colour (C, N, N, N) and how well the colour is known (N, N, N) in 0..1."""

    occupancy: torch.Tensor
    colour: torch.Tensor
    known: torch.Tensor

    def channels(self) -> torch.Tensor:
        """All of it, (1, C + 2, N, N, N): occupancy, known, colour."""
        return torch.cat([self.occupancy[None], self.known[None], self.colour])[None]


@dataclass
class Picture:
    """P rendered views: opacity (P, S, S), known (P, S, S), colour (P, C, S, S), relief (P, S, S) in units.

    Relief is the surface's distance in front of the object's origin; colour and known are times opacity.
    """

    opacity: torch.Tensor
    known: torch.Tensor
    colour: torch.Tensor
    relief: torch.Tensor


class ViewBank:
    """Views by azimuth and elevation (P,) radians, with the sampling positions both ways worked out once."""

    def __init__(self, azimuth: np.ndarray, elevation: np.ndarray, size: int, voxels: int) -> None:
        self.azimuth, self.elevation = np.asarray(azimuth, np.float64), np.asarray(elevation, np.float64)
        self.size, self.voxels = size, voxels
        self.rotation = torch.as_tensor(view_rotation(self.azimuth, self.elevation), dtype=torch.float32)
        axis = (torch.arange(size, dtype=torch.float32) + 0.5) * (2 / size) - 1
        steps = size
        depth = ((torch.arange(steps, dtype=torch.float32) + 0.5) * (2 / steps) - 1) * EXTENT
        self.depth = depth  # relative to the origin, away from the camera
        zoom = (OBJECT_DEPTH + depth) / OBJECT_DEPTH * EXTENT
        shape = (size, size, steps)  # row, column, depth
        self.ray = torch.stack(
            [
                (axis[None, :, None] * zoom).expand(shape),
                (axis[:, None, None] * zoom).expand(shape),
                depth.expand(shape),
            ],
            -1,
        ).reshape(-1, 3)
        centre = ((torch.arange(voxels, dtype=torch.float32) + 0.5) * (2 / voxels) - 1) * EXTENT
        z, y, x = torch.meshgrid(centre, centre, centre, indexing="ij")
        self.point = torch.stack([x, y, z], -1).reshape(-1, 3)

    def __len__(self) -> int:
        return len(self.rotation)

    def render(self, volume: Volume, view_idx: torch.Tensor | None = None) -> Picture:
        """Pictures of the volume from the views (all of them by default)."""
        rotation = self.rotation if view_idx is None else self.rotation[view_idx]
        channels = volume.channels()
        out: list[list[torch.Tensor]] = [[], [], [], []]
        sharp = 12.0 * 2 * EXTENT / self.size  # opacity of one step through full occupancy: nearly opaque in 0.2 units
        for some in rotation.split(16):
            at = (self.ray @ some) / EXTENT  # x_obj = R^T x_cam
            sampled = grid_sample(
                channels.expand(len(some), -1, -1, -1, -1),
                at.reshape(len(some), self.size * self.size, -1, 1, 3),
                align_corners=False,
            )
            sampled = sampled.reshape(len(some), channels.shape[1], self.size, self.size, -1)
            passing = torch.exp(-sharp * sampled[:, 0])
            through = torch.cumprod(torch.cat([torch.ones_like(passing[..., :1]), passing[..., :-1]], -1), -1)
            weight = through * (1 - passing)
            out[0].append(weight.sum(-1))
            out[1].append((weight * sampled[:, 1]).sum(-1))
            out[2].append((weight[:, None] * sampled[:, 2:]).sum(-1))
            out[3].append(-(weight * self.depth).sum(-1) / weight.sum(-1).clamp(min=1e-3))
        return Picture(*(torch.cat(part) for part in out))

    def project(self, view_idx: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Every voxel's place in each view's window, (P, N^3, 2) in -1..1, and its relief (P, N^3) in units."""
        camera = self.point @ self.rotation[view_idx].transpose(1, 2)
        scale = OBJECT_DEPTH / (OBJECT_DEPTH + camera[..., 2]) / EXTENT
        return camera[..., :2] * scale[..., None], -camera[..., 2]
