"""Camera paths: a turntable, a path from a file, a circle about one frozen moment.

A camera is ``camera_from_object`` (4, 4), OpenCV (x right, y down, z forward), looking at an object with y up.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp


class PathError(ValueError):
    """A camera path that cannot be used; the message is one sentence."""


@dataclass(frozen=True)
class Shot:
    """Pictures to take: N cameras, the moment (s) of the clip that each shows, intrinsics for a picture's size.

    camera_from_object: (N, 4, 4). time_s: (N,) in the clip. intrinsics: (N, 3, 3) pixels. at_s: (N,) when each picture
    is shown in the film.
    """

    camera_from_object: np.ndarray
    time_s: np.ndarray
    intrinsics: np.ndarray
    at_s: np.ndarray


def look_at(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    """camera_from_object (4, 4) of a camera at `place` (3,) that looks at `target` (3,), upright.

    Raises PathError where the two coincide.
    """
    forward = np.asarray(target, np.float64) - place
    length = np.linalg.norm(forward)
    if length < 1e-9:
        raise PathError("a camera stands on the point it looks at")
    forward /= length
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.999 else np.array([0.0, 0.0, -np.sign(forward[1])])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose


def orbit_place(centre: np.ndarray, distance: float, azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Where a camera stands (3,): azimuth 0 in front (+z), 90 at the object's left (+x)."""
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return centre + distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


def pinhole(width_px: int, height_px: int, fov_deg: float) -> np.ndarray:
    """K (3, 3) for a vertical field of view, the principal point in the middle."""
    focal = height_px / 2 / np.tan(np.radians(fov_deg) / 2)
    return np.array([[focal, 0, width_px / 2], [0, focal, height_px / 2], [0, 0, 1.0]])


def fitting_distance(points: np.ndarray, centre: np.ndarray, intrinsics: np.ndarray, fill: float = 0.9) -> float:
    """The nearest distance from which points (N, 3) stay in the picture from every side at middling heights."""
    reach = np.abs(points - centre)
    across = float(np.hypot(reach[:, 0], reach[:, 2]).max())
    above = float(reach[:, 1].max())
    focal, half_x, half_y = intrinsics[0, 0], intrinsics[0, 2], intrinsics[1, 2]
    return max(focal * across / (fill * half_x) + across, focal * (above + 0.25 * across) / (fill * half_y) + across)


def circle(
    centre: np.ndarray, distance: float, elevation_deg: float, turns: float, start_deg: float, count: int
) -> np.ndarray:
    """(count, 4, 4): cameras evenly round the object."""
    angles = start_deg + 360.0 * turns * np.arange(count) / count
    return np.stack([look_at(orbit_place(centre, distance, a, elevation_deg), centre) for a in angles])


def parse_path(text: str) -> dict[str, Any]:
    """A camera path file, checked; see :func:`shot_of_path` for its form. Raises PathError."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise PathError(f"is not JSON ({error})") from error
    if not isinstance(document, dict) or not isinstance(document.get("keys"), list) or not document["keys"]:
        raise PathError("needs a list `keys` of cameras")
    return document


def shot_of_path(document: dict[str, Any], centre: np.ndarray, width_px: int, height_px: int, fps: float) -> Shot:
    """A film along key cameras, smooth between them.

    A key is ``{"at": seconds in the film, "time": seconds in the clip (default: at), "position": [x, y, z], "target":
    [x, y, z] (default: the object's middle), "fov": degrees (default 35)}``; in place of a position ``"azimuth"``,
    ``"elevation"`` (degrees) and ``"distance"`` may be given, or ``"object_to_camera"``, a rigid 4 x 4. Object space:
    y up, front towards +z, the object about 2 units long.
    """
    rows = [_key(row, k, centre) for k, row in enumerate(document["keys"])]
    at = np.array([row[0] for row in rows])
    if (np.diff(at) <= 0).any():
        raise PathError("its keys need increasing times `at`")
    count = max(1, round((at[-1] - at[0]) * fps) + 1)
    moments = np.clip(at[0] + np.arange(count) / fps, at[0], at[-1])
    fov = np.interp(moments, at, [row[3] for row in rows])
    shown = np.interp(moments, at, [row[1] for row in rows])
    poses = np.stack([row[2] for row in rows])
    if len(rows) > 1:
        places = -(np.swapaxes(poses[:, :3, :3], 1, 2) @ poses[:, :3, 3:])[..., 0]
        place = np.stack([np.interp(moments, at, column) for column in places.T], axis=1)
        turn = Slerp(at, Rotation.from_matrix(poses[:, :3, :3]))(moments).as_matrix()
        poses = np.repeat(np.eye(4)[None], count, axis=0)
        poses[:, :3, :3] = turn
        poses[:, :3, 3] = -(turn @ place[..., None])[..., 0]
    else:
        poses = np.repeat(poses, count, axis=0)
    intrinsics = np.stack([pinhole(width_px, height_px, f) for f in fov])
    return Shot(poses, shown, intrinsics, moments - moments[0])


def _key(row: Any, number: int, centre: np.ndarray) -> tuple[float, float, np.ndarray, float]:
    if not isinstance(row, dict):
        raise PathError(f"key {number} is no object")
    known = {"at", "time", "position", "target", "fov", "azimuth", "elevation", "distance", "object_to_camera"}
    if set(row) - known:
        raise PathError(f"key {number} has {sorted(set(row) - known)[0]!r}; known: {', '.join(sorted(known))}")
    at = _number(row.get("at", 0.0), "at", number)
    shown = _number(row.get("time", at), "time", number)
    fov = _number(row.get("fov", 35.0), "fov", number)
    if not 1 <= fov <= 170:
        raise PathError(f"key {number}: fov is an angle of 1 to 170 degrees")
    if "object_to_camera" in row:
        pose = _array(row["object_to_camera"], (4, 4), number)
        turn = pose[:3, :3]
        if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
            raise PathError(f"key {number}: object_to_camera is not rigid")
        return at, shown, pose, fov
    target = _array(row["target"], (3,), number) if "target" in row else centre
    if "position" in row:
        place = _array(row["position"], (3,), number)
    else:
        distance = _number(row.get("distance", 4.0), "distance", number)
        azimuth, elevation = (_number(row.get(k, 0.0), k, number) for k in ("azimuth", "elevation"))
        place = orbit_place(target, distance, azimuth, elevation)
    return at, shown, look_at(place, target), fov


def _number(value: Any, name: str, number: int) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise PathError(f"key {number}: {name} is not a number")
    return float(value)


def _array(value: Any, shape: tuple[int, ...], number: int) -> np.ndarray:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise PathError(f"key {number}: {'x'.join(map(str, shape))} finite numbers are needed")
    return array
