"""Root poses that jitter from frame to frame, made steady: what no camera and no animal does in a fiftieth of a second.

Each pose is replaced by a robust local line through its neighbours (local regression on the group of rotations). How
far the neighbourhood reaches is chosen by leaving each frame out and predicting it from the others: poses that move
smoothly as they are predict each other best from close by, and are left alone.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

REACHES_S = (0.05, 0.1, 0.2, 0.35, 0.6, 0.9)
"""Reaches that are tried: standard deviations of the Gaussian neighbourhood, seconds."""
_FEWEST = 8
_WORTH = 0.95  # share of the closest neighbours' error that a farther reach has to get below
_NOTHING = 1e-4  # radians or units: no jitter at all
_ROUNDS = 6
_CORNER_RAD, _CORNER = 0.05, 0.02  # residuals below these count fully: radians, units


def steady(tracks: list[np.ndarray], times_s: list[np.ndarray]) -> tuple[list[np.ndarray], float, float]:
    """Steadied camera_from_object (T, 4, 4) of every clip, and the reaches (s) of rotations and of translations.

    `times_s` (T,) are the frames' times in seconds. A reach fits all clips; 0 means left alone.
    """
    turned_s = _reach(tracks, times_s, _turn_misses)
    placed_s = _reach(tracks, times_s, _place_misses)
    out = [track.copy() for track in tracks]
    for made, track, time in zip(out, tracks, times_s, strict=True):
        if turned_s and len(track) >= _FEWEST:
            made[:, :3, :3] = _turns(track[:, :3, :3], _neighbourhood(time, turned_s))
        if placed_s and len(track) >= _FEWEST:
            made[:, :3, 3] = _places(track[:, :3, 3], _neighbourhood(time, placed_s))
    return out, turned_s, placed_s


def _reach(
    tracks: list[np.ndarray],
    times_s: list[np.ndarray],
    misses: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> float:
    """The reach whose lines predict left-out frames best; 0 if none does better than the closest neighbours."""
    long = [(track, time) for track, time in zip(tracks, times_s, strict=True) if len(track) >= _FEWEST]
    if not long:
        return 0.0
    errors = []
    for reach in REACHES_S:
        found = [misses(track, _neighbourhood(time, reach, leave_out=True)) for track, time in long]
        errors.append(float(np.concatenate(found).mean()))
    best = int(np.argmin(errors))
    return REACHES_S[best] if errors[best] < _WORTH * errors[0] and errors[0] > _NOTHING else 0.0


def _turn_misses(track: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Angles (T,) between each frame and its line, radians."""
    rest = _turns(track[:, :3, :3], weight).transpose(0, 2, 1) @ track[:, :3, :3]
    return np.linalg.norm(Rotation.from_matrix(rest).as_rotvec(), axis=-1)


def _place_misses(track: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Distances (T,) between each frame and its line, units."""
    return np.linalg.norm(_places(track[:, :3, 3], weight) - track[:, :3, 3], axis=-1)


def _neighbourhood(time: np.ndarray, reach: float, leave_out: bool = False) -> np.ndarray:
    """Weights (T, T) of every frame's neighbours, and their times as seen from it."""
    away = time[None] - time[:, None]
    weight = np.exp(-0.5 * (away / reach) ** 2) + 1e-12
    if leave_out:
        np.fill_diagonal(weight, 0.0)
    return np.stack([weight, away])


def _line(weight: np.ndarray, away: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(T, C): at each frame the weighted line through its neighbours' `values` (T, T, C)."""
    s0, s1, s2 = weight.sum(1), (weight * away).sum(1), (weight * away**2).sum(1)
    y0, y1 = (weight[..., None] * values).sum(1), ((weight * away)[..., None] * values).sum(1)
    determinant = np.maximum(s0 * s2 - s1**2, 1e-9 * s0**2)
    return (s2[:, None] * y0 - s1[:, None] * y1) / determinant[:, None]


def _turns(seen: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) of the local lines through `seen` (T, 3, 3)."""
    weight, away = near
    u, _, v = np.linalg.svd(np.einsum("ts,sij->tij", weight, seen))
    u[..., -1] *= np.linalg.det(u @ v)[:, None]
    made = u @ v
    for _ in range(_ROUNDS):
        turns = made.transpose(0, 2, 1)[:, None] @ seen[None]
        vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(len(seen), len(seen), 3)
        robust = weight / (np.linalg.norm(vectors, axis=-1) + _CORNER_RAD)
        made = made @ Rotation.from_rotvec(_line(robust, away, vectors)).as_matrix()
    return made


def _places(seen: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Translations (T, 3) of the local lines through `seen` (T, 3)."""
    weight, away = near
    made = (weight @ seen) / weight.sum(1, keepdims=True)
    for _ in range(_ROUNDS):
        gaps = seen[None] - made[:, None]
        robust = weight / (np.linalg.norm(gaps, axis=-1) + _CORNER)
        made = made + _line(robust, away, gaps)
    return made
