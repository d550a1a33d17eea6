"""Which part of the motion is the root's: object space is settled so that most of the surface stays where it is.

Pictures only see ``G(t) J_b(t)``; a rigid motion can move from the root pose G to all bones J at once and nothing
rendered changes. What the fit leaves there is whatever the first root poses had wrong, so it is settled afterwards:
object space is the frame in which the bulk of the surface (a trunk, not limbs) is nearly at rest.

A trunk sways by itself, too: a dancer's turns to and fro under her head. Where it is known how far root poses may be
off (those that somebody gave and that jittered, those of a network), a sway is divided: of what the trunk does about an
axis, as much goes to the root as its error about that axis may explain (a Wiener filter, one matrix a clip).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from torch import Tensor

from stages.geometry.rotations import invert_rigid, matrix_to_quaternion, quaternion_to_matrix, rigid
from stages.model.banmo import Banmo

SLOW_S = 0.75
"""What jitter leaves in steady poses is slower than this (seconds, a Gaussian's width): a wave."""
SWAY_SOFTNESS = 0.12
"""As `softness` below, where a trunk that does sway must not be told from one that seems to: more of the body votes."""


@torch.no_grad()
def settle(
    model: Banmo,
    most: int = 500,
    softness: float = 0.05,
    rounds: int = 25,
    steady_s: float = 0.1,
) -> float:
    """Set ``model.gauge`` so that the surface moves least in object space; root poses that are held stay as they are.

    Of those that somebody gave and that may move (``root_given``) object space is meant: they lose a slow wave at most.
    Of estimated ones whose error is known (``root_wave_rad``) places settle, and turns as far as the error goes.

    `softness` (units) is the distance from which a point counts as moving limb. What a trunk does faster than about
    `steady_s` (seconds, a Gaussian's width) stays with the bones: a hand-held camera and a body's heading are slower.
    Returns the mean turn made (radians) over the frames whose root poses are free.
    """
    points = model.surface
    if len(points) < 10:
        return 0.0
    points = points[:: max(1, -(-len(points) // most))]
    placed, poses = [], []
    for some in torch.arange(len(model.time), device=points.device).split(64):
        state = model.frames(some)
        placed.append(model.forward_points(state, points[None].expand(len(some), -1, -1)).cpu())
        poses.append(state.camera_from_object.cpu())
    posed, whole = torch.cat(placed), torch.cat(poses)
    may = model.root_free > 0
    free = (may & ~model.root_given)[model.video_idx].cpu()
    motion = torch.eye(4).repeat(len(whole), 1, 1)
    if free.any():
        motion = rigid_parts(posed, free, softness, rounds)
    middle = posed.median(0).values.mean(0)
    for i, video in enumerate(model.videos):
        mine, time_s, wave = slice(model.starts[i], model.starts[i + 1]), np.asarray(video.time_s), video.root_wave_rad
        if free[mine].all():
            if wave is not None:
                motion[mine] = divided(motion[mine], middle, time_s, wave)
            steady = steadied(whole[mine] @ invert_rigid(motion[mine]), time_s, steady_s)
            motion[mine] = invert_rigid(steady) @ whole[mine]
        elif video.root_given and wave is not None and any(wave) and may[i]:
            free[mine] = True
            rest = rigid_parts(posed[mine], torch.ones(mine.stop - mine.start, dtype=torch.bool), SWAY_SOFTNESS, rounds)
            motion[mine] = rigid(unswayed(rest, time_s, wave, SLOW_S), torch.zeros(len(rest), 3))
    if not free.any():
        return 0.0
    model.gauge.copy_(motion.to(model.gauge) @ model.gauge)
    trace = motion[free, :3, :3].diagonal(dim1=1, dim2=2).sum(-1)
    return float(((trace - 1) / 2).clamp(-1, 1).acos().mean())


def divided(rest: Tensor, middle: Tensor, time_s: np.ndarray, wave_rad: tuple[float, float, float]) -> Tensor:
    """Motions (T, 4, 4) that bring `middle` (3,) to rest as `rest` (T, 4, 4) does, but leave a trunk its own turns.

    What all frames share of the turn stays, too: it is no sway.
    """
    usual = torch.from_numpy(Rotation.from_matrix(rest[:, :3, :3].double().numpy()).mean().as_matrix()).to(rest)
    turn = usual @ unswayed(rest, time_s, wave_rad)
    before = _moved(middle[None], invert_rigid(rest))
    return rigid(turn, middle - (turn @ before.transpose(1, 2)).squeeze(-1))


def unswayed(rest: Tensor, time_s: np.ndarray, wave_rad: tuple[float, float, float], slow_s: float = 0.0) -> Tensor:
    """Turns (T, 3, 3) of object space that take a trunk's sway off it, as far as it is not its own.

    `rest` (T, 4, 4) brings the trunk from object space to rest; only what it does slower than `slow_s` (seconds, a
    Gaussian's width) is asked about. The root's error is known, `wave_rad` about each axis; what the trunk itself does
    is not, and is taken to be all that is seen. So about each axis, of a sway that the error explains alone a half
    goes, of a smaller one more, of a larger one less.
    """
    turns = Rotation.from_matrix(rest[:, :3, :3].double().numpy())
    sway = (turns.mean().inv() * turns).as_rotvec()
    if slow_s:
        spacing_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else slow_s
        sway = gaussian_filter1d(sway, slow_s / max(spacing_s, 1e-6), axis=0, mode="nearest")
    wave = np.diag(np.square(wave_rad)) + 1e-12 * np.eye(3)
    share = wave @ np.linalg.inv(wave + sway.T @ sway / len(sway))
    return torch.from_numpy(Rotation.from_rotvec(sway @ share.T).as_matrix()).to(rest)


def rigid_parts(posed: Tensor, free: Tensor, softness: float, rounds: int) -> Tensor:
    """Rigid motions (T, 4, 4) that bring the frames' points (T, N, 3) to one common shape, identity where not `free`.

    Generalised Procrustes analysis with a Geman-McClure cost: points further than `softness` from the common shape
    hardly count. The softness starts wide; at the end each frame is aligned anew from where its neighbours ended and
    from plain least squares, and keeps what explains most of it.
    """
    motion = torch.eye(4).repeat(len(posed), 1, 1)
    shape = posed.median(0).values
    for i in range(rounds):
        found = _descend(posed, shape, motion, max(softness, 0.3 * 0.8**i), 1)
        motion[free] = found[free]
        shape = _moved(posed, motion).median(0).values
    everywhere = torch.ones(posed.shape[:2])
    starts = [align(posed, shape, everywhere), motion.roll(1, 0), motion.roll(-1, 0)]
    for start in starts:
        found = _descend(posed, shape, start, 3 * softness, 6)
        found = _descend(posed, shape, found, softness, 6)
        better = free & (_cost(posed, shape, found, softness) < _cost(posed, shape, motion, softness))
        motion[better] = found[better]
    return motion


def steadied(poses: Tensor, time_s: np.ndarray, width_s: float) -> Tensor:
    """Rigid motions (T, 4, 4) smoothed over `width_s` (a Gaussian's), as quaternions and shifts; even turns stay."""
    spacing = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    sigma = width_s / max(spacing, 1e-6)
    if len(poses) < 3 or sigma < 0.1:
        return poses
    turns = matrix_to_quaternion(poses[:, :3, :3].double())
    turns = turns * torch.cumprod(torch.cat([turns.new_ones(1), _sign((turns[1:] * turns[:-1]).sum(-1))]), 0)[:, None]
    track = torch.cat([turns, poses[:, :3, 3].double()], 1).numpy()
    pad = min(len(track) - 1, int(4 * sigma) + 1)
    # Mirrored through its ends, a steady course goes on beyond them.
    before, after = 2 * track[:1] - track[pad:0:-1], 2 * track[-1:] - track[-2 : -pad - 2 : -1]
    smooth = gaussian_filter1d(np.concatenate([before, track, after]), sigma, axis=0, mode="nearest")
    smooth = torch.from_numpy(smooth[pad : pad + len(track)])
    quaternion = torch.nn.functional.normalize(smooth[:, :4], dim=1)
    return rigid(quaternion_to_matrix(quaternion), smooth[:, 4:]).to(poses.dtype)


def _sign(value: Tensor) -> Tensor:
    return torch.where(value < 0, -1.0, 1.0).to(value.dtype)


def _moved(points: Tensor, motion: Tensor) -> Tensor:
    return points @ motion[:, :3, :3].transpose(1, 2) + motion[:, None, :3, 3]


def _distance(points: Tensor, shape: Tensor, motion: Tensor, width: float) -> Tensor:
    return (_moved(points, motion) - shape).square().sum(-1) / width**2


def _cost(points: Tensor, shape: Tensor, motion: Tensor, width: float) -> Tensor:
    distance = _distance(points, shape, motion, width)
    return (distance / (1 + distance)).mean(1)


def _descend(points: Tensor, shape: Tensor, motion: Tensor, width: float, steps: int) -> Tensor:
    """Iteratively reweighted least squares from `motion` (T, 4, 4)."""
    for _ in range(steps):
        motion = align(points, shape, (1 + _distance(points, shape, motion, width)).pow(-2))
    return motion


def align(points: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Rigid motions (T, 4, 4) from points (T, N, 3) to a target (N, 3), weighted (T, N) least squares (Kabsch)."""
    share = weight / weight.sum(1, keepdim=True)
    here = (share[..., None] * points).sum(1)
    there = share @ target
    covariance = torch.einsum("tn,tni,tnj->tij", share, target[None] - there[:, None], points - here[:, None])
    u, _, vt = torch.linalg.svd(covariance.double())
    flip = torch.ones(len(points), 3, dtype=torch.float64)
    flip[:, 2] = torch.linalg.det(u @ vt)
    rotation = ((u * flip[:, None]) @ vt).float()
    return rigid(rotation, there - (rotation @ here[..., None]).squeeze(-1))
