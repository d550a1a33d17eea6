"""How fast a clip's object turns before the camera, from flow and a guess of its relief."""

from __future__ import annotations

import numpy as np

from stages.registration.cues import Cues


def turn_rates(cues: Cues, relief: np.ndarray, centroid_weight: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Rotation from each frame to the next, (T, 3) radians about the camera's x, y, z axes, and its trust (T,).

    `relief` (T, S, S) is how far each crop pixel's surface lies in front of the object's centre, in units of half the
    crop's side. A rigid turn `w` moves the surface point (x, y, -relief) by ``w x point``; with shift and zoom that
    is a linear least-squares problem a frame, solved with reweighting. The visible surface is always the near side,
    so the mean motion against the outline's own motion carries the sign of the turn: the shift is held (with
    `centroid_weight` of all pixels) to that of the mask's centroid, which is what fixes the depth-reversal ambiguity.
    The last frame repeats the one before.
    """
    count, size = len(cues), cues.mask.shape[1]
    axis = (2 * (np.arange(size) + 0.5) / size - 1).astype(np.float64)
    grid_x, grid_y = np.meshgrid(axis, axis)
    area = np.maximum(cues.mask.sum(axis=(1, 2)), 1e-6)
    centroid = np.stack([(cues.mask * g).sum(axis=(1, 2)) / area for g in (grid_x, grid_y)], 1)
    centroid_px = cues.centre_px + centroid * cues.half_px[:, None]
    rates, trust = np.zeros((count, 3)), np.zeros(count)
    for i in range(count - 1):
        weight = (cues.flow_confidence[i] * (cues.mask[i] > 0.5)).ravel().astype(np.float64)
        if weight.sum() < 12 or not (cues.known[i] and cues.known[i + 1]):
            continue
        keep = weight > 0.02
        weight = weight[keep]
        x = grid_x.ravel()[keep] - centroid[i, 0]
        y = grid_y.ravel()[keep] - centroid[i, 1]
        near = relief[i].ravel()[keep].astype(np.float64)
        shift = (centroid_px[i + 1] - centroid_px[i]) / cues.half_px[i]
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
        rates[i] = solution[:3]
        trust[i] = min(1.0, weight.sum() / max(float((cues.mask[i] > 0.5).sum()), 1.0))
    if count > 1:
        rates[-1], trust[-1] = rates[-2], trust[-2]
    return rates, trust
