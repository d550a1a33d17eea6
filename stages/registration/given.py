"""Root poses that the user already has: read from a JSON document, checked, and brought to the kept frames."""

from __future__ import annotations

from typing import Any

import numpy as np


class PoseDocumentError(ValueError):
    """A pose document that cannot be used; the message is one sentence for its author."""


def parse_intrinsics(document: dict[str, Any]) -> np.ndarray:
    """Pinhole intrinsics of the source video in pixels, (3, 3) float64.

    Accepts ``K`` (3x3) or ``intrinsics`` as ``{"fx", "fy", "cx", "cy"}``, as ``[fx, fy, cx, cy]`` or as a 3x3 list.

    Raises:
        PoseDocumentError: missing, not numbers, not finite, or not a pinhole matrix.
    """
    value = document.get("K", document.get("intrinsics"))
    if value is None:
        raise PoseDocumentError("has neither K nor intrinsics")
    try:
        if isinstance(value, dict):
            value = [value["fx"], value.get("fy", value["fx"]), value["cx"], value["cy"]]
        array = np.array(value, np.float64)
    except (KeyError, TypeError, ValueError):
        raise PoseDocumentError("its intrinsics are not numbers named fx, fy, cx, cy, nor a 3x3 matrix K") from None
    if array.shape == (4,):
        fx, fy, cx, cy = array
        array = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if array.shape != (3, 3):
        raise PoseDocumentError(f"its intrinsics have shape {array.shape}, not 3x3 or four numbers")
    if not np.isfinite(array).all():
        raise PoseDocumentError("its intrinsics are not finite")
    lower = np.array([array[1, 0], array[2, 0], array[2, 1], array[2, 2] - 1.0])
    if array[0, 0] <= 0 or array[1, 1] <= 0 or np.abs(lower).max() > 1e-6:
        raise PoseDocumentError("its K is not a pinhole matrix (positive focal lengths, last row 0 0 1)")
    return array


def parse_transforms(document: dict[str, Any], count: int, tolerance: float = 1e-3) -> np.ndarray:
    """``object_to_camera`` of every source frame, (count, 4, 4) float64, rotations made exact.

    Raises:
        PoseDocumentError: missing, wrong count, not finite, not rigid, or an object behind the camera.
    """
    if "object_to_camera" not in document:
        raise PoseDocumentError("has no object_to_camera")
    try:
        poses = np.array(document["object_to_camera"], np.float64)
    except (TypeError, ValueError):
        raise PoseDocumentError("its object_to_camera is not a list of 4x4 matrices of numbers") from None
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise PoseDocumentError(f"its object_to_camera has shape {poses.shape}, not a list of 4x4 matrices")
    if len(poses) != count:
        raise PoseDocumentError(f"has {len(poses)} poses, but the video has {count} frames")
    finite = np.isfinite(poses).all(axis=(1, 2))
    if not finite.all():
        raise PoseDocumentError(f"the pose of frame {int(np.argmin(finite))} is not finite")
    rotation = poses[:, :3, :3]
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (off > tolerance) | (np.linalg.det(rotation) < 0)
    bad |= np.abs(poses[:, 3] - np.array([0, 0, 0, 1.0])).max(axis=1) > tolerance
    if bad.any():
        raise PoseDocumentError(f"the pose of frame {int(np.argmax(bad))} is not a rigid transform")
    if (poses[:, 2, 3] <= 0).any():
        frame = int(np.argmax(poses[:, 2, 3] <= 0))
        raise PoseDocumentError(f"the pose of frame {frame} puts the object behind the camera (OpenCV axes: z forward)")
    exact = poses.copy()
    exact[:, 3] = [0, 0, 0, 1]
    if off.max() > 1e-6:  # digits lost on the way through a text file: nearest rotation (orthogonal Procrustes)
        u, _, vt = np.linalg.svd(rotation)
        exact[:, :3, :3] = u @ vt
    return exact


def scale_intrinsics(intrinsics: np.ndarray, scale_x: float, scale_y: float) -> np.ndarray:
    """Intrinsics after resizing the image; with centres at +0.5 the principal point scales without an offset."""
    return np.diag([scale_x, scale_y, 1.0]) @ intrinsics
