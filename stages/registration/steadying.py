"""Root poses that jitter from frame to frame, made steady: what no camera and no animal does in a fiftieth of a second.

Whoever films goes around the subject and hardly rolls or climbs. So a track of rotations is taken apart into where the
axis points that the camera goes around (in camera space, nearly still), and how far it has gone around it. Each of
them, and the translation, is replaced by a robust local line through its neighbours. How far the neighbourhood reaches
is chosen by leaving each frame out and predicting it from the others: poses that move smoothly as they are predict
each other best from close by, and are left alone.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

REACHES_S = (0.05, 0.1, 0.2, 0.35, 0.6, 0.9, 1.4, 2.2, 5.0)
"""Reaches that are tried: standard deviations of the Gaussian neighbourhood, seconds."""
SLOW_S = 0.75
"""What jitter leaves in steady poses is slower than this (seconds, a Gaussian's width): a wave."""
_FEWEST = 8
_WORTH = 0.95  # share of the closest neighbours' error that a farther reach has to get below
_NOTHING = 1e-4  # radians or units: no jitter at all
_ROUNDS = 6
_FAR = 2.0  # of the mean residual: what is further off counts in proportion less (Huber)


def steady(tracks: list[np.ndarray], times_s: list[np.ndarray]) -> tuple[list[np.ndarray], tuple[float, float], float]:
    """Steadied camera_from_object (T, 4, 4) of every clip; reaches (s) of the axis and of the way around it, of places.

    `times_s` (T,) are the frames' times in seconds. A reach fits all clips; 0 means left alone.
    """
    long = [i for i, track in enumerate(tracks) if len(track) >= _FEWEST]
    out = [track.copy() for track in tracks]
    if not long:
        return out, (0.0, 0.0), 0.0
    times = [times_s[i] for i in long]
    turns = [tracks[i][:, :3, :3] for i in long]
    axis = main_axis(turns)
    axis_s, aside = _steadied([turn @ axis for turn in turns], times, _directions, _angle_between)
    still = [_turned_onto(turn @ axis, made) @ turn for turn, made in zip(turns, aside, strict=True)]
    frames = [_frames_around(axis, made, turn) for made, turn in zip(aside, still, strict=True)]
    gone = [
        Rotation.from_matrix(frame.transpose(0, 2, 1) @ turn).as_rotvec() @ axis
        for frame, turn in zip(frames, still, strict=True)
    ]
    around_s, smooth = _steadied(gone, times, _headings, _angle_apart)
    placed_s, places = _steadied([tracks[i][:, :3, 3] for i in long], times, _places, _distance)
    for k, i in enumerate(long):
        if axis_s or around_s:
            out[i][:, :3, :3] = frames[k] @ Rotation.from_rotvec(smooth[k][:, None] * axis).as_matrix()
        if placed_s:
            out[i][:, :3, 3] = places[k]
    return out, (axis_s, around_s), placed_s


def wave_left(given: np.ndarray, made: np.ndarray, time_s: np.ndarray) -> tuple[float, float, float]:
    """Root mean square turn (radians) about each axis that independent errors leave in rotations made steady.

    `given` (T, 4, 4) are the poses and `made` what `steady` made of them; of what was taken out, white noise, this much
    is slower than SLOW_S.
    """
    turns = Rotation.from_matrix(given[:, :3, :3]).inv() * Rotation.from_matrix(made[:, :3, :3])
    spacing_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else SLOW_S
    slow = spacing_s / (2 * np.sqrt(np.pi) * SLOW_S)
    wave = float(np.sqrt(np.mean(turns.magnitude() ** 2) * slow / 3))
    return wave, wave, wave


def main_axis(turns: list[np.ndarray]) -> np.ndarray:
    """The direction (3,) in object space that moves least in camera space, over clips of rotations (T, 3, 3)."""
    spread = sum(turn.mean(0).T @ turn.mean(0) for turn in turns)
    return np.asarray(np.linalg.eigh(spread)[1][:, -1])


def _steadied(
    seen: list[np.ndarray],
    times_s: list[np.ndarray],
    lines: Callable[[np.ndarray, np.ndarray], np.ndarray],
    misses: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[float, list[np.ndarray]]:
    """The reach whose `lines` predict left-out frames best, and what they make of each clip.

    If no reach does better than the closest neighbours: 0, and the clips as they are.
    """
    errors = []
    for reach in REACHES_S:
        left_out = [(one, _neighbourhood(time, reach, leave_out=True)) for one, time in zip(seen, times_s, strict=True)]
        errors.append(float(np.concatenate([misses(lines(one, near), one) for one, near in left_out]).mean()))
    best = int(np.argmin(errors))
    if errors[best] >= _WORTH * errors[0] or errors[0] <= _NOTHING:
        return 0.0, seen
    reach = REACHES_S[best]
    return reach, [lines(one, _neighbourhood(time, reach)) for one, time in zip(seen, times_s, strict=True)]


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


def _robust(weight: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """`weight` (T, T), less where the residual (T, T) is far above what is usual: single frames may be anywhere."""
    usual = (weight * residual).sum() / weight.sum()
    return np.asarray(weight * np.where(residual <= _FAR * usual, 1.0, _FAR * usual / np.maximum(residual, 1e-12)))


def _directions(seen: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Directions (T, 3) of the local lines through `seen` (T, 3), on the sphere."""
    weight, away = near
    made = _unit(weight @ seen)
    for _ in range(_ROUNDS):
        gaps = seen[None] - made[:, None]
        made = _unit(made + _line(_robust(weight, np.linalg.norm(gaps, axis=-1)), away, gaps))
    return made


def _headings(seen: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Angles (T,) of the local lines through `seen` (T,), radians, on the circle."""
    weight, away = near
    made = np.angle(weight @ np.exp(1j * seen))
    for _ in range(_ROUNDS):
        apart = np.angle(np.exp(1j * (seen[None] - made[:, None])))
        made = made + _line(_robust(weight, np.abs(apart)), away, apart[..., None])[:, 0]
    return np.asarray(made)


def _places(seen: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Translations (T, 3) of the local lines through `seen` (T, 3)."""
    weight, away = near
    made = (weight @ seen) / weight.sum(1, keepdims=True)
    for _ in range(_ROUNDS):
        gaps = seen[None] - made[:, None]
        made = made + _line(_robust(weight, np.linalg.norm(gaps, axis=-1)), away, gaps)
    return made


def _angle_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Radians (T,) between directions (T, 3); exact also where they are close."""
    return np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(1))


def _angle_apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * (one - other))))


def _distance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.linalg.norm(one - other, axis=-1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _turned_onto(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The least rotations (T, 3, 3) that take directions (T, 3) onto others."""
    turns = _unit(np.cross(one, other)) * _angle_between(one, other)[:, None]
    return Rotation.from_rotvec(turns).as_matrix()


def _frames_around(axis: np.ndarray, aside: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) that take `axis` to where it is seen, `aside` (T, 3), and turn about it as little as can be.

    They start from the mean of `turns` (T, 3, 3), so that what is left to go around the axis does not wrap early.
    """
    middle = Rotation.from_matrix(turns).mean().as_matrix()
    start = np.broadcast_to(middle @ axis, aside.shape)
    return _turned_onto(start, aside) @ middle
