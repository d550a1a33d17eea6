"""Pinhole cameras (OpenCV axes: x right, y down, z forward) in torch.

``x_cam = R x_obj + t``; a pixel is ``K x_cam / z``; the centre of pixel (column c, row r) is (c + 0.5, r + 0.5).
"""

from __future__ import annotations

import torch
from torch import Tensor


def transform(transforms: Tensor, points: Tensor) -> Tensor:
    """Apply rigid (or affine) transforms (..., 4, 4) to points (..., N, 3); leading dimensions broadcast."""
    return points @ transforms[..., :3, :3].transpose(-1, -2) + transforms[..., None, :3, 3]


def project(intrinsics: Tensor, points: Tensor, min_depth: float = 1e-3) -> Tensor:
    """Pixels (..., N, 2) of camera-space points (..., N, 3) under `intrinsics` (..., 3, 3).

    Depth is clamped to `min_depth`, so that a point at or behind the camera gives a finite, far-off pixel.
    """
    depth = points[..., 2:].clamp_min(min_depth)
    focal = torch.stack([intrinsics[..., 0, 0], intrinsics[..., 1, 1]], -1)[..., None, :]
    return points[..., :2] / depth * focal + intrinsics[..., None, :2, 2]


def pixel_directions(intrinsics: Tensor, pixels: Tensor) -> Tensor:
    """Camera-space directions (..., N, 3) with unit z through `pixels` (..., N, 2) under `intrinsics` (..., 3, 3).

    A point at depth d on the ray is ``d * direction``.
    """
    focal = torch.stack([intrinsics[..., 0, 0], intrinsics[..., 1, 1]], -1)[..., None, :]
    xy = (pixels - intrinsics[..., None, :2, 2]) / focal
    return torch.cat([xy, torch.ones_like(xy[..., :1])], -1)


def ray_box(origins: Tensor, directions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where rays ``o + s d`` enter and leave axis-aligned boxes (slab method).

    All arguments (..., 3), broadcast. Returns near (...), far (...), hit (...) bool. A ray that misses gets the
    interval around its closest approach to the box's centre, as long as the box's half diagonal: rays outside
    the object need samples too, to learn that there is nothing.
    """
    safe = torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (low - origins) / safe, (high - origins) / safe
    near, far = torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)
    hit = (far > near) & (far > 0)
    centre, half = (low + high) / 2, (high - low).norm(dim=-1) / 2
    speed = directions.norm(dim=-1)
    closest = ((centre - origins) * directions).sum(-1) / (speed * speed)
    radius = half / speed
    near = torch.where(hit, near, closest - 0.5 * radius)
    far = torch.where(hit, far, closest + 0.5 * radius)
    near = near.clamp_min(1e-3)
    return near, torch.maximum(far, near + 1e-4), hit
