"""Poses that a model has already been seen in, tried on other frames: how badly each lies on a mask, the best path.

Codes found by descent alone stay in the swing they begin in. A model has been seen in hundreds of articulations; each
is placed at a frame's root pose and compared with its mask as points: what falls outside the mask, and what of the
mask no point comes near. Dynamic programming over time picks a sequence.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from stages.fitting.observations import Observations
from stages.fitting.renew import posed
from stages.geometry.cameras import project, transform
from stages.geometry.rotations import invert_rigid
from stages.model.banmo import Banmo

_JUMP = 0.5  # price in object sizes of misfit of a mean jump of one unit off the course of the known motion
_POINTS = 160


def spread(count: int, most: int) -> Tensor:
    """Up to `most` indices (N,) spread evenly over `count`."""
    return torch.linspace(0, count - 1, min(count, most)).round().long().unique()


@torch.no_grad()
def known_shapes(model: Banmo, frames: Tensor, points: Tensor) -> Tensor:
    """Surface points (N, 3) posed as in kept frames (K,) of the known model, (K, N, 3), by the bones alone.

    The part of a motion that was moved from the bones to the root pose (``model.gauge``) is taken off again: codes
    drive bones.
    """
    return transform(invert_rigid(model.gauge[frames]), posed(model, points, frames))


def mask_distance(silhouette: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance in pixels (H, W) to the object, zero on it; and some of its pixels (M, 2), column and row centres.

    The pixels are spread evenly, so that a thin limb counts by its length.
    """
    inside = silhouette > 127
    rows, columns = np.nonzero(inside)
    step = max(1, len(rows) // 96)
    some = np.stack([columns[::step], rows[::step]], axis=1).astype(np.float32) + 0.5
    return distance_transform_edt(~inside).astype(np.float32), some


@torch.no_grad()
def misfit(shapes: Tensor, poses: Tensor, intrinsics: Tensor, observations: Observations, frames: Tensor) -> Tensor:
    """How badly each known shape (K, N, 3) fits each of `frames` (T,): (T, K), in object sizes; zero is perfect.

    Args:
        poses: (T, 4, 4) camera_from_object of those frames.
        intrinsics: (T, 3, 3) pixels of those frames.
    """
    cost = torch.zeros(len(frames), len(shapes))
    for t, frame in enumerate(frames.tolist()):
        if float(observations.frame_weight[frame]) > 0:
            cost[t] = misfit_in_frame(shapes, poses[t : t + 1], intrinsics[t], observations, frame)
    return cost


def misfit_of_each(
    shapes: Tensor, poses: Tensor, intrinsics: Tensor, observations: Observations, frames: Tensor
) -> Tensor:
    """How badly the shape of each of `frames` (T,) fits that frame: (T,) of shapes (T, N, 3); as in :func:`misfit`."""
    told = [
        misfit(shapes[i : i + 1], poses[i : i + 1], intrinsics[i : i + 1], observations, frames[i : i + 1])[0]
        for i in range(len(frames))
    ]
    return torch.cat(told)


def misfit_in_frame(
    shapes: Tensor, poses: Tensor, intrinsics: Tensor, observations: Observations, frame: int, chunk: int = 512
) -> Tensor:
    """How badly each known shape (K, N, 3) fits one frame: (K,), in object sizes; zero is perfect, or nothing is seen.

    Args:
        poses: (K, 4, 4) camera_from_object of each shape, or (1, 4, 4) of all.
        intrinsics: (3, 3) pixels.
        chunk: shapes that are looked at at once.
    """
    scale = float(observations.silhouette_scale[frame])
    outside, wanted = mask_distance(observations.silhouettes[frame].numpy())
    if len(wanted) == 0:  # too small to be seen at the size of the silhouettes
        return torch.zeros(len(shapes))
    height, width = outside.shape
    far, some = torch.from_numpy(outside), torch.from_numpy(wanted)
    size = max(8.0, float(np.sqrt((outside == 0).sum())))
    poses = poses.expand(len(shapes), 4, 4)
    found = []
    for start in range(0, len(shapes), chunk):
        points = transform(poses[start : start + chunk], shapes[start : start + chunk])
        pixels = project(intrinsics, points) * scale
        column = pixels[..., 0].floor().long().clamp(0, width - 1)
        row = pixels[..., 1].floor().long().clamp(0, height - 1)
        bare = torch.cdist(some[None].expand(len(pixels), -1, -1), pixels).amin(-1)
        found.append((far[row, column].mean(1) + 1.5 * (bare - 1.0).clamp_min(0).mean(1)) / size)
    return torch.cat(found)


class KnownMotion(NamedTuple):
    """What a model has been seen in, and how it went on from there."""

    frames: Tensor  # (K,)
    points: Tensor  # (N, 3) canonical
    shapes: Tensor  # (K, N, 3) as by known_shapes
    jump: Tensor  # (K, K) price of going from one to another, in object sizes of misfit


@torch.no_grad()
def known_motion(model: Banmo, frames: Tensor, most: int) -> KnownMotion:
    """Up to `most` of kept `frames` (T,), spread evenly."""
    known = frames[spread(len(frames), most)]
    points = model.surface[spread(len(model.surface), _POINTS)]
    shapes = known_shapes(model, known, points).cpu()
    return KnownMotion(known, points, shapes, jumps(shapes, known_shapes(model, following(known, model), points).cpu()))


def jumps(shapes: Tensor, after: Tensor) -> Tensor:
    """Price (K, K) of going from one known shape (K, N, 3) to another; `after` (K, N, 3) is what each went on to.

    Going on as the motion went on there costs nothing, resting costs what it moved: motions recur as a whole, and a
    stretch of one that was seen well elsewhere is likelier than a mix of single poses.
    """
    return _JUMP * torch.stack([(shapes - shape).norm(dim=-1).mean(-1) for shape in after])


@torch.no_grad()
def views(model: Banmo, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Where known shapes are seen from in kept frames (T,): camera_from_object (T, 4, 4) and intrinsics (T, 3, 3)."""
    states = [model.frames(part) for part in frames.split(64)]
    poses = torch.cat([state.camera_from_object for state in states]) @ model.gauge[frames]
    return poses.cpu(), torch.cat([state.intrinsics for state in states]).cpu()


def following(frames: Tensor, model: Banmo) -> Tensor:
    """The frame (N,) that follows each of `frames` (N,) in its clip; the last is followed by itself."""
    last = torch.as_tensor(model.starts)[1:][model.video_idx.cpu()[frames]] - 1
    return torch.minimum(frames + 1, last)


def best_sequence(cost: Tensor, jump: Tensor) -> Tensor:
    """Indices (T,) of least total cost (T, K) plus price of going from one to the next (K, K) (Viterbi)."""
    total, back = cost[0].clone(), []
    for t in range(1, len(cost)):
        ways = total[:, None] + jump
        best, where = ways.min(0)
        back.append(where)
        total = best + cost[t]
    path = [int(total.argmin())]
    for where in reversed(back):
        path.append(int(where[path[-1]]))
    return torch.tensor(path[::-1])
