"""Root poses of a new clip on a known model: every way of looking at its known shapes, compared with the masks.

Directions on a grid, articulations from the known clips, size and place from the mask's box; a smooth path through
time. Silhouettes alone cannot tell near from far side: colours of the known surface, where the clip shows the same
subject, weigh in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.fitting.known_poses import best_sequence, misfit_in_frame, spread
from stages.fitting.observations import Observations
from stages.geometry.cameras import project
from stages.geometry.rotations import geodesic_angle, matrix_to_quaternion, quaternion_to_matrix

_TURN_PRICE = 0.08
"""Misfit, in object sizes, that a turn by one radian a frame may cost: a jump to the far side must pay over frames."""


@dataclass(frozen=True)
class Placed:
    """Root poses (T, 4, 4) camera_from_object, how far to trust each (T,) in 0..1, mean misfit in object sizes."""

    poses: Tensor
    confidence: Tensor
    misfit: float


def directions(azimuths: int = 24, elevations_deg: tuple[float, ...] = (-15.0, 0.0, 20.0, 45.0)) -> Tensor:
    """Rotations (N, 3, 3), camera_from_object, of cameras all round an upright object (y up, OpenCV cameras)."""
    found = []
    for elevation in np.radians(elevations_deg):
        for azimuth in 2 * np.pi * np.arange(azimuths) / azimuths:
            back = np.array(
                [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
            )
            right = np.cross(-back, (0.0, 1.0, 0.0))
            right /= np.linalg.norm(right)
            found.append(np.stack([right, np.cross(-back, right), -back]))
    return torch.from_numpy(np.stack(found)).float()


def place_in_box(shapes: Tensor, rotations: Tensor, box_px: Tensor, intrinsics: Tensor, rounds: int = 3) -> Tensor:
    """Poses (N, 4, 4) that put shapes (N, P, 3), turned by (N, 3, 3), into a mask's box (4,), x0 y0 x1 y1.

    Begins with a flat object and then corrects for perspective, a few `rounds`.
    """
    turned = shapes @ rotations.transpose(1, 2)
    low, high = turned.amin(1), turned.amax(1)
    side = (box_px[2:] - box_px[:2]).amax().clamp_min(1.0)
    focal = torch.stack([intrinsics[0, 0], intrinsics[1, 1]])
    wanted = (box_px[:2] + box_px[2:]) / 2
    depth = focal.mean() * (high - low)[:, :2].amax(1) / side
    shift = torch.cat([(wanted - intrinsics[:2, 2]) / focal * depth[:, None], depth[:, None]], 1) - (low + high) / 2
    for _ in range(rounds):
        camera = turned + shift[:, None]
        pixels = project(intrinsics, camera)
        first, last = pixels.amin(1), pixels.amax(1)
        grown = (last - first).amax(1) / side
        middle = camera[..., 2].mean(1)
        off = (wanted - (first + last) / 2) / focal * middle[:, None]
        shift = shift + torch.cat([off, torch.zeros_like(off[:, :1])], 1)
        shift[:, 2] += middle * (grown - 1).clamp(-0.5, 1.0)
    pose = torch.eye(4).repeat(len(shapes), 1, 1)
    pose[:, :3, :3] = rotations
    pose[:, :3, 3] = shift
    return pose


@torch.no_grad()
def register(
    shapes: Tensor, intrinsics: Tensor, observations: Observations, boxes_px: np.ndarray, every: int = 3
) -> Placed:
    """Root poses of all frames of one clip on shapes (A, P, 3) of a known model, object space.

    Args:
        intrinsics: (3, 3) pixels. boxes_px: (T, 4) of the masks.
        every: one frame in so many is searched; the others are interpolated.
    """
    count = len(boxes_px)
    chosen = spread(count, max(2, count // every))
    chosen = chosen[observations.frame_weight[chosen] > 0]
    if len(chosen) == 0:
        raise ValueError("no frame shows the object")
    look = directions()
    rotations = look.repeat_interleave(len(shapes), 0)
    candidates = shapes.repeat(len(look), 1, 1)
    costs, poses = [], []
    for frame in chosen.tolist():
        box = torch.from_numpy(np.asarray(boxes_px[frame], np.float32))
        pose = place_in_box(candidates, rotations, box, intrinsics)
        cost = misfit_in_frame(candidates, pose, intrinsics, observations, frame)
        best = cost.reshape(len(look), len(shapes)).min(1)
        costs.append(best.values)
        poses.append(pose.reshape(len(look), len(shapes), 4, 4)[torch.arange(len(look)), best.indices])
    cost = torch.stack(costs)
    angle = geodesic_angle(look[:, None], look[None])
    gap = float((chosen[1:] - chosen[:-1]).float().mean()) if len(chosen) > 1 else 1.0
    path = best_sequence(cost, _TURN_PRICE * (angle / gap).clamp_max(1.4))
    picked = torch.stack([poses[i][int(k)] for i, k in enumerate(path)])
    margin = cost.topk(min(8, cost.shape[1]), largest=False).values
    trust = torch.exp(-4 * cost[torch.arange(len(path)), path]) * (0.5 + 0.5 * (margin[:, -1] > margin[:, 0] * 1.2))
    every_frame = torch.arange(count)
    misfit = float(cost[torch.arange(len(path)), path].mean())
    return Placed(_between(picked, chosen, every_frame), _nearest(trust, chosen, every_frame), misfit)


@torch.no_grad()
def turn_onto(
    shapes: Tensor,
    rotations: Tensor,
    intrinsics: Tensor,
    observations: Observations,
    boxes_px: np.ndarray,
    turns: int = 36,
    samples: int = 14,
) -> Placed:
    """Root poses from rotations in another frame that is upright, too: turned as a whole onto the known shapes.

    Args:
        shapes: (A, P, 3) of the known model. rotations: (T, 3, 3) camera_from_object in the other frame.
        turns: turns about the upright axis that are tried, evenly; the best is then halved into.
        samples: frames that decide.
    """
    usable = torch.nonzero(observations.frame_weight > 0)[:, 0]
    if len(usable) == 0:
        raise ValueError("no frame shows the object")
    chosen = usable[spread(len(usable), samples)]
    step = 2 * np.pi / turns

    def price(angle: float) -> float:
        cost = _turned_cost(shapes, rotations[chosen] @ _about_y(angle), chosen, intrinsics, observations, boxes_px)
        return float(cost.min(1).values.mean())

    tried = [(price(k * step), k * step) for k in range(turns)]
    for width in (step / 2, step / 4):
        middle = min(tried)[1]
        tried += [(price(middle + d), middle + d) for d in (-width, width)]
    best, angle = min(tried)
    turned = rotations @ _about_y(angle)
    poses = torch.eye(4).repeat(len(rotations), 1, 1)
    every = torch.arange(len(rotations))
    cost = _turned_cost(shapes, turned, every, intrinsics, observations, boxes_px)
    known = observations.frame_weight > 0
    for t in every[known].tolist():
        box = torch.from_numpy(np.asarray(boxes_px[t], np.float32))
        shape = shapes[int(cost[t].argmin())][None]
        poses[t] = place_in_box(shape, turned[t][None], box, intrinsics)[0]
    poses = _between(poses[known], every[known], every)
    poses[:, :3, :3] = turned
    return Placed(poses, torch.exp(-4 * cost.min(1).values) * known, best)


def _about_y(angle: float) -> Tensor:
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _turned_cost(
    shapes: Tensor,
    rotations: Tensor,
    frames: Tensor,
    intrinsics: Tensor,
    observations: Observations,
    boxes_px: np.ndarray,
) -> Tensor:
    """Misfit (N, A) of every shape at rotations (N, 3, 3) of frames (N,), each placed in its mask's box."""
    rows = []
    for rotation, frame in zip(rotations, frames.tolist(), strict=True):
        if float(observations.frame_weight[frame]) <= 0:
            rows.append(torch.zeros(len(shapes)))
            continue
        box = torch.from_numpy(np.asarray(boxes_px[frame], np.float32))
        pose = place_in_box(shapes, rotation.expand(len(shapes), 3, 3), box, intrinsics)
        rows.append(misfit_in_frame(shapes, pose, intrinsics, observations, frame))
    return torch.stack(rows)


def _between(poses: Tensor, known: Tensor, wanted: Tensor) -> Tensor:
    """Rigid interpolation of poses at `known` frames to `wanted` ones, then smoothed over a few frames."""
    right = torch.searchsorted(known, wanted).clamp(0, len(known) - 1)
    left = (right - 1).clamp_min(0)
    left = torch.where(known[right] == wanted, right, left)
    span = (known[right] - known[left]).clamp_min(1)
    share = ((wanted - known[left]).float() / span).clamp(0, 1)[:, None]
    q = matrix_to_quaternion(poses[:, :3, :3])
    for i in range(1, len(q)):
        q[i] = torch.where((q[i] * q[i - 1]).sum() < 0, -q[i], q[i])
    mixed = torch.nn.functional.normalize((1 - share) * q[left] + share * q[right], dim=-1)
    shift = (1 - share) * poses[left, :3, 3] + share * poses[right, :3, 3]
    weight = torch.exp(-0.5 * ((wanted[:, None] - wanted[None]).float() / 2.0).square())
    weight = weight / weight.sum(1, keepdim=True)
    result = torch.eye(4).repeat(len(wanted), 1, 1)
    result[:, :3, :3] = quaternion_to_matrix(torch.nn.functional.normalize(weight @ mixed, dim=-1))
    result[:, :3, 3] = weight @ shift
    return result


def _nearest(values: Tensor, known: Tensor, wanted: Tensor) -> Tensor:
    return values[(wanted[:, None] - known[None]).abs().argmin(1)]
