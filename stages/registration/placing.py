"""Where the object is: intrinsics, translation from mask boxes, and rotations from azimuth, elevation and roll.

Conventions: OpenCV camera (x right, y down, z forward); object space y up, z front, about 2 units long, centred on
its origin; ``x_cam = R x_obj + t``. Azimuth is the camera's bearing round the object's y axis (0 = camera in front,
positive towards the object's +x), elevation its height above the object's horizon, roll the turn of the picture.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

OBJECT_SIZE = 2.0
"""Length of the object, units."""
OBJECT_DEPTH = 3.0
"""Distance of the object, units: the median over a collection of clips."""


def default_intrinsics(width: int, height: int, focal_px: float | None = None) -> np.ndarray:
    """Pinhole camera with the principal point at the centre; without a hint the focal length is ``max(W, H)`` px."""
    focal = float(focal_px) if focal_px else float(max(width, height))
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def view_rotation(azimuth: np.ndarray, elevation: np.ndarray, roll: np.ndarray | float = 0.0) -> np.ndarray:
    """Object-to-camera rotations (..., 3, 3) of a camera that looks at the object's centre. Angles in radians."""
    azimuth, elevation, roll = np.broadcast_arrays(azimuth, elevation, roll)
    sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
    sin_e, cos_e = np.sin(elevation), np.cos(elevation)
    right = np.stack([cos_a, np.zeros_like(sin_a), -sin_a], -1)
    forward = -np.stack([sin_a * cos_e, sin_e, cos_a * cos_e], -1)
    down = np.cross(forward, right)
    sin_r, cos_r = np.sin(roll)[..., None], np.cos(roll)[..., None]
    return np.stack([cos_r * right - sin_r * down, sin_r * right + cos_r * down, forward], -2)


def view_angles(rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Azimuth, elevation and roll (radians) of object-to-camera rotations (..., 3, 3); inverse of view_rotation."""
    back = -rotation[..., 2, :]
    azimuth = np.arctan2(back[..., 0], back[..., 2])
    elevation = np.arcsin(np.clip(back[..., 1], -1, 1))
    level = view_rotation(azimuth, elevation)
    roll = np.arctan2(
        (rotation[..., 1, :] * level[..., 0, :]).sum(-1), (rotation[..., 0, :] * level[..., 0, :]).sum(-1)
    )
    return azimuth, elevation, roll


def ray_rotation(centre_px: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) that turn the optical axis onto the rays through (T, 2) pixels, without twist.

    A picture cropped round the object is what a camera turned this way would see, so a rotation found in the crop
    becomes the real camera's by this matrix on its left.
    """
    ray = np.concatenate([centre_px, np.ones((len(centre_px), 1))], 1) @ np.linalg.inv(intrinsics).T
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    out = np.empty((len(ray), 3, 3))
    for i, (x, y, z) in enumerate(ray):  # the least rotation from (0, 0, 1) to the ray (z > 0, never opposite)
        out[i] = [[1 - x * x / (1 + z), -x * y / (1 + z), x], [-x * y / (1 + z), 1 - y * y / (1 + z), y], [-x, -y, z]]
    return out


def upright_frame(up: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) from a frame in which `up` (3,) points upwards to one whose y axis does."""
    y = up / np.linalg.norm(up)
    z = np.cross([1.0, 0, 0] if abs(y[0]) < 0.9 else [0, 0, 1.0], y)
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z])


def fill_gaps(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Linear interpolation of (T, ...) values over frames that are not `known`; constant beyond the ends."""
    if known.all() or not known.any():
        return values.copy()
    flat = values.reshape(len(values), -1)
    idx = np.arange(len(values))
    filled = np.stack([np.interp(idx, idx[known], flat[known, k]) for k in range(flat.shape[1])], 1)
    return filled.reshape(values.shape)


def smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian smoothing along the first axis, in frames; straight lines stay straight up to the ends."""
    if sigma <= 0 or len(values) < 3:
        return values.copy()
    pad = min(len(values) - 1, round(4 * sigma) + 1)
    before = 2 * values[:1] - values[pad:0:-1]
    after = 2 * values[-1:] - values[-2 : -pad - 2 : -1]
    padded = np.concatenate([before, values, after])
    return gaussian_filter1d(padded, sigma, axis=0, mode="nearest")[pad : pad + len(values)]


def mask_boxes(masks: np.ndarray, threshold: int = 128) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (T, 4) x0 y0 x1 y1 in pixels of (T, H, W) uint8 masks, and which frames have an object at all.

    The outer half percent of the mask's rows and columns is left out, so that specks do not move the box.
    """
    boxes, known = np.zeros((len(masks), 4)), np.zeros(len(masks), bool)
    for i, mask in enumerate(masks):
        inside = mask >= threshold
        if inside.sum() < 16:
            continue
        for axis, (low, high) in ((0, (0, 2)), (1, (1, 3))):
            cumulative = np.cumsum(inside.sum(axis=axis)) / inside.sum()
            boxes[i, low] = np.searchsorted(cumulative, 0.0025)
            boxes[i, high] = np.searchsorted(cumulative, 0.9975) + 1
        known[i] = True
    return fill_gaps(boxes, known), known


def place(origin_px: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Translations (T, 3) that put the object's origin at `depth` (T,) on the rays through (T, 2) pixels."""
    ray = np.concatenate([origin_px, np.ones((len(origin_px), 1))], 1) @ np.linalg.inv(intrinsics).T
    return ray * depth[:, None]


def depth_from_size(boxes: np.ndarray, intrinsics: np.ndarray, extent: float | np.ndarray = OBJECT_SIZE) -> np.ndarray:
    """Depth (T,) at which an object whose picture is `extent` units across fills the boxes' longer side."""
    size = np.maximum(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1])
    return np.sqrt(intrinsics[0, 0] * intrinsics[1, 1]) * extent / np.maximum(size, 1.0)


def transforms(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Rigid 4x4 matrices (T, 4, 4) from (T, 3, 3) rotations and (T, 3) translations."""
    out = np.tile(np.eye(4), (len(rotation), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = rotation, translation
    return out
