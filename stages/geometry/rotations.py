"""Rotations and rigid transforms, in torch.

Matrices act on column vectors from the left (``y = R x``); quaternions are (w, x, y, z), unit length; rotation
vectors are axis times angle in radians. Leading dimensions are free: `...` below.
"""

from __future__ import annotations

import torch
from torch import Tensor


def skew(v: Tensor) -> Tensor:
    """Cross-product matrix of `v` (..., 3): ``skew(v) @ x == cross(v, x)``. Returns (..., 3, 3)."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def so3_exp(v: Tensor) -> Tensor:
    """Rotation of a rotation vector `v` (..., 3), by Rodrigues' formula; smooth at zero. Returns (..., 3, 3)."""
    square = (v * v).sum(-1)[..., None, None]
    small = square < 1e-6
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    a = torch.where(small, 1 - square / 6, angle.sin() / angle)
    b = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / safe)
    k = skew(v)
    return torch.eye(3, dtype=v.dtype, device=v.device) + a * k + b * (k @ k)


def so3_log(rotation: Tensor) -> Tensor:
    """Rotation vector (..., 3) of a rotation (..., 3, 3); angles up to pi."""
    quaternion = matrix_to_quaternion(rotation)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    sine = xyz.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    scale = torch.where(sine > 1e-7, angle / sine.clamp_min(1e-12), torch.full_like(sine, 2.0))
    return xyz * scale


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Rotation (..., 3, 3) of a quaternion (..., 4) of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quaternion.shape[:-1], 3, 3)


def matrix_to_quaternion(rotation: Tensor) -> Tensor:
    """Quaternion (..., 4) with w >= 0 of a rotation (..., 3, 3); picks the best conditioned of the four forms."""
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    forms = torch.stack(
        [
            torch.stack([squares[..., 0], a, b, c], -1),
            torch.stack([a, squares[..., 1], d, e], -1),
            torch.stack([b, d, squares[..., 2], f], -1),
            torch.stack([c, e, f, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = torch.nn.functional.normalize(forms.gather(-2, best).squeeze(-2), dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def geodesic_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle in radians between rotations `a` and `b` (..., 3, 3)."""
    relative = a.transpose(-1, -2) @ b
    sine = torch.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        -1,
    ).norm(dim=-1)
    return torch.atan2(sine, relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """4x4 transform (..., 4, 4) of a rotation (..., 3, 3) and a translation (..., 3)."""
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.tensor([0.0, 0, 0, 1], dtype=top.dtype, device=top.device).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def invert_rigid(transform: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4)."""
    rotation = transform[..., :3, :3].transpose(-1, -2)
    return rigid(rotation, -(rotation @ transform[..., :3, 3:]).squeeze(-1))


def interpolate_rigid(transforms: Tensor, times: Tensor, at: Tensor) -> Tensor:
    """Rigid track (T, 4, 4) known at increasing `times` (T,), read at `at` (N,): slerp between, constant beyond.

    Returns (N, 4, 4).
    """
    if len(times) == 1:
        return transforms.expand(len(at), 4, 4)
    right = torch.searchsorted(times.contiguous(), at.contiguous()).clamp(1, len(times) - 1)
    left = right - 1
    span = (times[right] - times[left]).clamp_min(1e-12)
    share = ((at - times[left]) / span).clamp(0, 1)[:, None].to(transforms.dtype)
    start, end = transforms[left], transforms[right]
    turn = so3_log(start[:, :3, :3].transpose(-1, -2) @ end[:, :3, :3])
    rotation = start[:, :3, :3] @ so3_exp(share * turn)
    return rigid(rotation, start[:, :3, 3] * (1 - share) + end[:, :3, 3] * share)
