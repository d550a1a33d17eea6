"""What of a clip a puppet is fitted to: some points of the subject in every frame, with their embeddings."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from stages.retargeting.fitting import Seen
from stages.retargeting.puppet import Puppet

POINTS = 256


def look(
    puppet: Puppet,
    maps: np.ndarray,
    crops: np.ndarray,
    usable: np.ndarray,
    intrinsics: np.ndarray,
    time_s: np.ndarray,
    rng: np.random.Generator,
    points: int = POINTS,
) -> Seen:
    """Points of every frame, more of them where limbs are thin.

    Args:
        maps: (N, S, S, 16) embeddings on square crops, zero off the subject.
        crops: (N, 4) x0, y0, x1, y1 in pixels.
        usable: (N,) 0..1, how far a frame's mask is to be trusted; at zero the frame is not looked at.
        intrinsics: (3, 3) pixels; `time_s` (N,).
    """
    count, side = maps.shape[:2]
    part = puppet.weights.argmax(1).numpy()
    codes = puppet.embedding.numpy()
    pixels, features = np.zeros((count, points, 2), np.float32), np.zeros((count, points, 16), np.float32)
    weight, size = np.zeros((count, points), np.float32), np.ones(count, np.float32)
    outside = np.zeros((count, side, side), np.float32)
    for i in range(count):
        values = np.asarray(maps[i], np.float32)
        inside = np.abs(values).sum(-1) > 1e-3
        cell = float(crops[i, 2] - crops[i, 0]) / side
        rows, columns = np.nonzero(inside)
        if usable[i] <= 0 or len(rows) < 16:
            continue
        seen = values[rows, columns]
        alike = seen @ codes.T
        of = part[alike.argmax(1)]
        share = 1 / np.sqrt(np.bincount(of, minlength=puppet.weights.shape[1])[of] + 0.02 * len(rows))
        chosen = rng.choice(len(rows), points, replace=len(rows) < points, p=share / share.sum())
        pixels[i] = crops[i, :2] + (np.stack([columns, rows], 1)[chosen] + 0.5) * cell
        features[i] = seen[chosen]
        weight[i] = usable[i] * np.clip((alike.max(1)[chosen] - 0.5) / 0.4, 0, 1)
        size[i] = max(np.ptp(rows), np.ptp(columns), 1) * cell
        outside[i] = distance_transform_edt(~inside) * cell
    seen_size = float(np.median(size[weight[:, 0] > 0])) if (weight > 0).any() else 1.0
    size[weight[:, 0] <= 0] = seen_size
    return Seen(
        pixels=torch.from_numpy(pixels),
        features=torch.from_numpy(features),
        weight=torch.from_numpy(weight),
        intrinsics=torch.from_numpy(np.asarray(intrinsics)).float(),
        size_px=torch.from_numpy(size),
        time_s=torch.from_numpy(np.asarray(time_s, np.float64)).float(),
        outside=torch.from_numpy(outside),
        boxes=torch.from_numpy(np.asarray(crops)).float(),
    )
