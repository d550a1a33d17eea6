"""How fast a clip's object turns before the camera, from flow and a guess of its relief."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from stages.registration.cues import Cues, inflate
from stages.registration.placing import smooth

_LEAST_PIXELS = 12.0


def expected_turns(cues: Cues) -> np.ndarray:
    """(T,) turn about the vertical from each frame to the next, radians, as the flow suggests. Rough, but signed.

    Half from a rigid body's motion (right for stiff objects), half from what each row of pixels does about its own
    mean (for bodies that bend and sway, where only the convexity within a row tells). Row-wise turns overshoot and
    are noisy, hence the factor and the longer smoothing.
    """
    relief = inflate(cues.mask) * 2 / cues.mask.shape[1]
    rigid = smooth(turn_rates(cues, relief)[0][:, 1], 2.0)
    bending = smooth(row_turns(cues, relief), 6.0)
    return np.clip(0.5 * rigid + 0.3 * bending, -0.15, 0.15)


def turn_rates(cues: Cues, relief: np.ndarray, centroid_weight: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Rotation from each frame to the next, (T, 3) radians about the camera's x, y, z axes, and its trust (T,).

    `relief` (T, S, S) is how far each crop pixel's surface lies in front of the object's centre, in units of half the
    crop's side. A rigid turn `w` moves the surface point (x, y, -relief) by ``w x point``; with shift and zoom that
    is a linear least-squares problem a frame, solved with reweighting. The visible surface is always the near side,
    so the mean motion against the outline's own motion carries the sign of the turn: the shift is held (with
    `centroid_weight` of all pixels) to that of the mask's centroid, which is what fixes the depth-reversal ambiguity.
    The last frames repeat the one before.
    """
    count, size, step = len(cues), cues.mask.shape[1], cues.flow_step
    axis = (2 * (np.arange(size) + 0.5) / size - 1).astype(np.float64)
    grid_x, grid_y = np.meshgrid(axis, axis)
    area = np.maximum(cues.mask.sum(axis=(1, 2)), 1e-6)
    centroid = np.stack([(cues.mask * g).sum(axis=(1, 2)) / area for g in (grid_x, grid_y)], 1)
    centroid_px = cues.centre_px + centroid * cues.half_px[:, None]
    rates, trust = np.zeros((count, 3)), np.zeros(count)
    for i in range(count - step):
        weight = (cues.flow_confidence[i] * (cues.mask[i] > 0.5)).ravel().astype(np.float64)
        if weight.sum() < _LEAST_PIXELS or not (cues.known[i] and cues.known[i + step]):
            continue
        keep = weight > 0.02
        weight = weight[keep]
        x = grid_x.ravel()[keep] - centroid[i, 0]
        y = grid_y.ravel()[keep] - centroid[i, 1]
        near = relief[i].ravel()[keep].astype(np.float64)
        shift = (centroid_px[i + step] - centroid_px[i]) / cues.half_px[i]
        motion = cues.flow_px[i].reshape(-1, 2)[keep] / cues.half_px[i] - shift
        zero, one = np.zeros_like(x), np.ones_like(x)
        # unknowns: turn about x, y, z; shift x, y beyond the centroid's; zoom
        rows_u = np.stack([zero, -near, -y, one, zero, x], 1)
        rows_v = np.stack([near, zero, x, zero, one, y], 1)
        rows, target = np.concatenate([rows_u, rows_v]), np.concatenate([motion[:, 0], motion[:, 1]])
        robust = np.concatenate([weight, weight])
        prior = np.diag([0.002, 0.002, 0.02, centroid_weight, centroid_weight, 0.02]) * weight.sum()
        for _ in range(6):
            normal = (rows * robust[:, None]).T @ rows + prior
            solution = np.linalg.solve(normal, (rows * robust[:, None]).T @ target)
            residual = np.abs(target - rows @ solution)
            scale = max(1.5 * float(np.median(residual)), 1e-4)
            robust = np.concatenate([weight, weight]) / (1.0 + (residual / scale) ** 2)
        rates[i] = solution[:3] / step
        trust[i] = min(1.0, weight.sum() / max(float((cues.mask[i] > 0.5).sum()), 1.0))
    if count > step:
        rates[-step:], trust[-step:] = rates[-step - 1], trust[-step - 1]
    return rates, trust


def row_turns(cues: Cues, relief: np.ndarray, band: int = 3) -> np.ndarray:
    """Turn about the vertical from each frame to the next (T,), radians, from the motion within rows alone.

    In every band of `band` rows the mean motion and the mean relief are taken off; the nearer part of a row then moves
    by minus turn times relief. Sideways sway, bending and stepping drop out; the intercept's evidence is given up.
    """
    step = cues.flow_step
    turns = np.zeros(len(cues))

    def row_mean(values: np.ndarray) -> np.ndarray:
        return uniform_filter1d(values.sum(1, keepdims=True), band, axis=0, mode="constant")

    for i in range(len(cues) - step):
        weight = (cues.flow_confidence[i] * (cues.mask[i] > 0.5)).astype(np.float64)
        if weight.sum() < _LEAST_PIXELS or not (cues.known[i] and cues.known[i + step]):
            continue
        motion = cues.flow_px[i, ..., 0] / cues.half_px[i]
        total = row_mean(weight) + 1e-9
        motion = motion - row_mean(weight * motion) / total
        near = relief[i] - row_mean(weight * relief[i]) / total
        robust = weight
        for _ in range(5):
            turn = -(robust * motion * near).sum() / ((robust * near**2).sum() + 2e-5 * weight.sum())
            residual = np.abs(motion + turn * near)
            scale = max(1.5 * float(np.median(residual[weight > 0.02])), 1e-4)
            robust = weight / (1 + (residual / scale) ** 2)
        turns[i] = turn / step
    if len(cues) > step:
        turns[-step:] = turns[-step - 1]
    return turns
