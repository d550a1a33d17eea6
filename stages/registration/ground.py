"""From how far above is the ground filmed? What it does under a moving camera says so, and the focal length as well.

The ground is a plane: from frame to frame its picture moves by a homography, which holds the plane's normal in the
camera's axes (Faugeras and Lustman 1988). The normal found depends on the focal length; with a wrong one, normals of
neighbouring frames disagree, and people would seem to hold their cameras askew. So the focal length is taken at which
normals agree best and roll least, over all clips; what stands on the ground is seen at the ground's elevation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

SIDE_PX = 320
"""Longer side at which points are tracked."""
STEPS = (8, 14, 20)
"""Frames from the first to the other view of a pair."""
EVERY = 3
LEAST_POINTS = 30
LEAST_VIEWS = 8
LEAST_SHIFT = 0.05
"""Of the camera between two views, over its distance from the plane; a camera that only turns sees no plane."""
FOCALS = np.geomspace(0.7, 2.2, 25)
"""Focal lengths tried, over the longer side."""
MOST_SPREAD, MOST_ROLL = np.radians(3.0), np.radians(5.0)
"""Median disagreement with neighbours, and median roll, beyond which the ground of a clip is not believed."""
PEAKED = 0.8
"""The best focal length must be this much better than the usual one, or all explain the clips as well."""
_BELOW = 0.25  # share of the object's height above its lowest point from which on down points are taken
_ROUND_TRIP_PX, _INLIER_PX = 0.5, 1.0
_NEIGHBOURS = 9  # frames
_REACH = 8.0  # frames, a Gaussian's width
_LARGEST_ROLL, _LOWEST, _HIGHEST = np.radians(40.0), np.radians(-5.0), np.radians(80.0)
_WINDOW = {"winSize": (15, 15), "maxLevel": 3}


@dataclass(frozen=True)
class PlaneView:
    """How the ground moves from a frame on.

    The homography is of coordinates from the picture's middle, over its longer side.
    """

    frame_idx: int
    homography: np.ndarray


def plane_views(count: int, frame: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> list[PlaneView]:
    """Views of the ground below a clip's object. `frame` gives picture (H, W, 3) uint8 RGB and mask (H, W) uint8."""
    kept: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def small(t: int) -> tuple[np.ndarray, np.ndarray]:
        if t not in kept:
            for old in [k for k in kept if k < t - max(STEPS) - 1]:
                del kept[old]
            image, mask = frame(t)
            scale = min(1.0, SIDE_PX / max(image.shape[:2]))
            size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
            grey = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
            covered = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 100
            kept[t] = grey, cv2.dilate(covered.astype(np.uint8), np.ones((9, 9), np.uint8))
        return kept[t]

    views = []
    for first in range(0, count - min(STEPS), EVERY):
        views += _views_from(first, min(first + max(STEPS), count - 1), small)
    return views


def _views_from(first: int, last: int, small: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> list[PlaneView]:
    grey, covered = small(first)
    rows = np.flatnonzero(covered.any(axis=1))
    if len(rows) == 0:
        return []
    region = np.where(covered > 0, 0, 255).astype(np.uint8)
    region[: int(rows[-1] - _BELOW * (rows[-1] - rows[0]))] = 0
    start = cv2.goodFeaturesToTrack(grey, 400, 0.01, 4, mask=region)
    if start is None:
        return []
    points, tracked = start, np.ones(len(start), bool)
    height, width = grey.shape
    views = []
    for t in range(first, last):
        (here, _), (there, covered) = small(t), small(t + 1)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(here, there, points, None, **_WINDOW)  # type: ignore[call-overload]
        back, again, _ = cv2.calcOpticalFlowPyrLK(there, here, moved, None, **_WINDOW)  # type: ignore[call-overload]
        tracked &= (found[:, 0] > 0) & (again[:, 0] > 0)
        tracked &= np.linalg.norm((back - points)[:, 0], axis=1) < _ROUND_TRIP_PX
        points = moved
        at = np.nan_to_num(points[:, 0]).round()
        columns, lines = (np.clip(at[:, k], 0, size - 1).astype(int) for k, size in ((0, width), (1, height)))
        tracked &= covered[lines, columns] == 0
        if tracked.sum() < LEAST_POINTS:
            break
        if t + 1 - first in STEPS:
            middle, scale = np.array([width, height]) / 2, float(max(width, height))
            pair = [(p[tracked, 0] + 0.5 - middle) / scale for p in (start, points)]
            homography, _ = cv2.findHomography(pair[0], pair[1], cv2.RANSAC, _INLIER_PX / scale)
            if homography is not None:
                views.append(PlaneView(first, homography))
    return views


def ground_elevations(
    clips: list[list[PlaneView]], counts: list[int], focal: float | None = None
) -> tuple[list[np.ndarray | None], float]:
    """The camera's elevation (T,) radians above the ground in each clip, None where it does not show; the focal length.

    Positive looks down. `focal`, over the longer side, is known or None; it comes back as 0 where no clip's ground is
    believed.
    """
    seen = [views for views in clips if len(views) >= LEAST_VIEWS]
    if not seen:
        return [None] * len(clips), 0.0
    if focal is None:
        scores = np.array([np.mean([sum(_judged(_tilts(views, f))) for views in seen]) for f in FOCALS])
        best = int(np.argmin(scores))
        if best in (0, len(FOCALS) - 1) or scores[best] > PEAKED * np.median(scores):
            return [None] * len(clips), 0.0
        focal = float(FOCALS[best])
    out: list[np.ndarray | None] = []
    for views, count in zip(clips, counts, strict=True):
        tilts = _tilts(views, focal)
        spread, roll = _judged(tilts)
        out.append(_path(tilts, count) if spread < MOST_SPREAD and roll < MOST_ROLL else None)
    return out, focal if any(path is not None for path in out) else 0.0


def _tilts(views: list[PlaneView], focal: float) -> np.ndarray:
    """(N, 3) frame, elevation and roll of the views' planes, of each the reading that is the most level."""
    camera = np.diag([focal, focal, 1.0])
    out = []
    for view in views:
        _, _, shifts, normals = cv2.decomposeHomographyMat(view.homography, camera)
        readings = []
        for shift, normal in zip(shifts, normals, strict=True):
            if np.linalg.norm(shift) < LEAST_SHIFT:
                continue
            x, y, z = normal[:, 0] if normal[1, 0] < 0 else -normal[:, 0]
            elevation, roll = np.arcsin(np.clip(-z, -1, 1)), np.arctan2(x, -y)
            if _LOWEST < elevation < _HIGHEST and abs(roll) < _LARGEST_ROLL:
                readings.append((view.frame_idx, elevation, roll))
        if readings:
            out.append(min(readings, key=lambda r: abs(r[2])))
    return np.array(out).reshape(-1, 3)


def _judged(tilts: np.ndarray) -> tuple[float, float]:
    """Median distance of elevations from their neighbours' median, and median size of roll; both large for too few."""
    if len(tilts) < LEAST_VIEWS:
        return float(2 * MOST_SPREAD), float(2 * MOST_ROLL)
    return float(np.median(np.abs(tilts[:, 1] - _usual(tilts)))), float(np.median(np.abs(tilts[:, 2])))


def _usual(tilts: np.ndarray) -> np.ndarray:
    """(N,) median elevation of each view and its neighbours in time."""
    return np.array([np.median(tilts[np.abs(tilts[:, 0] - t) <= _NEIGHBOURS, 1]) for t in tilts[:, 0]])


def _path(tilts: np.ndarray, count: int) -> np.ndarray:
    """Elevation (T,) of every frame: local medians of the views', blurred."""
    weight = np.exp(-0.5 * ((np.arange(count)[:, None] - tilts[None, :, 0]) / _REACH) ** 2) + 1e-9
    return np.asarray(weight @ _usual(tilts) / weight.sum(axis=1))
