"""Root poses that jitter from frame to frame, made steady: what no camera and no animal does in a fiftieth of a second.

Whoever films goes around the subject and hardly rolls or climbs. So a track of rotations is taken apart into how the
axis that the camera goes around leans in its pictures (towards it and aside, each nearly still), and how far it has
gone around it. Each of them, and the translation, follows the likeliest smooth course (`stages.registration.courses`),
where clips that seem filmed alike tell of each other; where that leaves no noise, poses move smoothly as they are and
are left alone.

Courses are sought from robust local lines through the poses, which tell what goes around how often, and single frames
that are far off, which are drawn nearer. How far a local line reaches is chosen by leaving each frame out and
predicting it from the others.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stages.registration.courses import Basis, Courses, basis, smooth, smooth_alike

REACHES_S = (0.05, 0.1, 0.2, 0.35, 0.6, 0.9, 1.4, 2.2, 5.0)
"""Reaches of local lines that are tried: standard deviations of the Gaussian neighbourhood, seconds."""
_FEWEST = 8
_NOTHING = 2e-3  # radians or units: no jitter that matters
_ROUNDS = 6
_FINISHES = 3  # times the likeliest course is sought, each time from where the last one lies
_NEAR = 0.9  # cosine: what is nearer to an axis has no longitude about it that is worth the name
_FAR = 2.0  # of the mean residual: what is further off counts in proportion less (Huber)


class Steadied(NamedTuple):
    """Poses without their jitter."""

    tracks: list[np.ndarray]
    """camera_from_object (T, 4, 4) of every clip."""
    jitter_rad: float
    """Standard deviation of the jitter that was taken out of turns about any one axis; 0: they were left alone."""
    jitter_units: float
    """... and of places along any one axis."""
    wave_rad: list[tuple[float, float, float]]
    """By how much the turns of each clip are still expected to be off about each axis of object space, but for what
    they share: root mean square."""


def steady(tracks: list[np.ndarray], times_s: list[np.ndarray]) -> Steadied:
    """Take the jitter out of camera_from_object (T, 4, 4) of every clip, at `times_s` (T,) in seconds.

    How smooth they are is read off all clips together. Clips of less than eight frames are left alone.
    """
    long = [i for i, track in enumerate(tracks) if len(track) >= _FEWEST]
    out, wave = [track.copy() for track in tracks], [(0.0, 0.0, 0.0) for _ in tracks]
    if not long:
        return Steadied(out, 0.0, 0.0, wave)
    times = [times_s[i] for i in long]
    bases = [basis(time) for time in times]
    seen = [tracks[i][:, :3, :3] for i in long]
    axis = main_axis(seen)
    turns, around, *tilts = _smooth_turns(seen, _turns_by_lines(seen, axis, times), axis, bases)
    jitter_rad = _told(max(around.noise, *(tilt.noise for tilt in tilts)))
    if jitter_rad:
        for k, (i, turn) in enumerate(zip(long, turns, strict=True)):
            out[i][:, :3, :3] = turn
            # A tilt that stays the same in camera space differs in object space, the more the camera goes around.
            shared = np.abs(np.exp(1j * around.made[k]).mean()) ** 2
            tilted = [tilt.left[k] ** 2 + (1 - shared) * tilt.left_mean[k] ** 2 for tilt in tilts]
            off = np.sqrt(around.left[k] ** 2 * axis**2 + np.mean(tilted) * (1 - axis**2))
            wave[i] = (float(off[0]), float(off[1]), float(off[2]))
    seen = [tracks[i][:, :3, 3] for i in long]
    made = _by_lines(seen, times, _places, _distance)
    for _ in range(_FINISHES):
        gaps = _bounded([one - now for one, now in zip(seen, made, strict=True)])
        places = smooth([now + gap for now, gap in zip(made, gaps, strict=True)], bases)
        made = places.made
    jitter_units = _told(places.noise)
    if jitter_units:
        for i, place in zip(long, made, strict=True):
            out[i][:, :3, 3] = place
    return Steadied(out, jitter_rad, jitter_units, wave)


def _told(noise: float) -> float:
    return noise if noise > _NOTHING else 0.0


def main_axis(turns: list[np.ndarray]) -> np.ndarray:
    """The direction (3,) in object space that moves least in camera space, over clips of rotations (T, 3, 3)."""
    spread = sum(turn.mean(0).T @ turn.mean(0) for turn in turns)
    return np.asarray(np.linalg.eigh(spread)[1][:, -1])


def _turns_by_lines(seen: list[np.ndarray], axis: np.ndarray, times_s: list[np.ndarray]) -> list[np.ndarray]:
    """Rotations (T, 3, 3) `seen` made steady by local lines: where `axis` points, then the way around it."""
    aside = _by_lines([turn @ axis for turn in seen], times_s, _directions, _angle_between)
    still = [_turned_onto(turn @ axis, made) @ turn for turn, made in zip(seen, aside, strict=True)]
    frames = [_frames_around(axis, made, turn) for made, turn in zip(aside, still, strict=True)]
    gone = [_rotvec(frame.transpose(0, 2, 1) @ turn) @ axis for frame, turn in zip(frames, still, strict=True)]
    ways = _by_lines(gone, times_s, _headings, _angle_apart)
    return [frame @ _spin(axis, way) for frame, way in zip(frames, ways, strict=True)]


def _by_lines(
    seen: list[np.ndarray],
    times_s: list[np.ndarray],
    lines: Callable[[np.ndarray, np.ndarray], np.ndarray],
    misses: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> list[np.ndarray]:
    """What `lines` of the reach that predicts left-out frames best make of each clip."""
    errors = []
    for reach in REACHES_S:
        left_out = [(one, _neighbourhood(time, reach, leave_out=True)) for one, time in zip(seen, times_s, strict=True)]
        errors.append(float(np.concatenate([misses(lines(one, near), one) for one, near in left_out]).mean()))
    reach = REACHES_S[int(np.argmin(errors))]
    return [lines(one, _neighbourhood(time, reach)) for one, time in zip(seen, times_s, strict=True)]


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


def _smooth_turns(
    seen: list[np.ndarray], made: list[np.ndarray], axis: np.ndarray, bases: list[Basis]
) -> tuple[list[np.ndarray], Courses, Courses, Courses]:
    """Rotations (T, 3, 3) `seen` on smooth courses, from those `made` so far; the way around `axis`, and its tilts.

    All are read off the turn from what is made to what is seen: a tilt that is far off is none around the axis.
    """
    for _ in range(_FINISHES):
        gaps = _bounded([_rotvec(now.transpose(0, 2, 1) @ one) for one, now in zip(seen, made, strict=True)])
        points = [now @ axis for now in made]
        frames = [_frames_around(axis, point, now) for point, now in zip(points, made, strict=True)]
        ways = [
            np.unwrap(_rotvec(frame.transpose(0, 2, 1) @ now) @ axis) + gap @ axis
            for frame, now, gap in zip(frames, made, gaps, strict=True)
        ]
        around = smooth_alike([way[:, None] for way in ways], bases, paced=True)
        moves = [
            np.cross((now @ gap[..., None])[..., 0], point) for now, gap, point in zip(made, gaps, points, strict=True)
        ]
        aside, towards, across = _smooth_directions(points, moves, bases)
        made = [
            _turned_onto(point, moved) @ frame @ _spin(axis, way[:, 0])
            for frame, point, moved, way in zip(frames, points, aside, around.made, strict=True)
        ]
    return made, around, towards, across


def _smooth_directions(
    points: list[np.ndarray], moves: list[np.ndarray], bases: list[Basis]
) -> tuple[list[np.ndarray], Courses, Courses]:
    """Directions (T, 3) through `points` that are moved by `moves` (T, 3), and their courses as latitude and longitude.

    About the camera's z axis: how an upright axis leans towards the camera, and aside. About its x axis where
    directions come near z.
    """
    nearest = np.abs(np.concatenate(points)).max(0)
    order = [0, 1, 2] if nearest[2] <= max(nearest[0], _NEAR) else [2, 1, 0]
    latitudes, longitudes = [], []
    for point, move in zip(points, moves, strict=True):
        x, y, z = point[:, order].T
        flat = np.hypot(x, y)
        dx, dy, dz = move[:, order].T
        latitudes.append((np.arctan2(z, flat) + dz / flat)[:, None])
        longitudes.append((np.unwrap(np.arctan2(x, -y)) + (x * dy - y * dx) / flat**2)[:, None])
    usual = longitudes[0].mean()
    longitudes = [one - 2 * np.pi * np.round((one.mean() - usual) / (2 * np.pi)) for one in longitudes]
    towards, across = smooth_alike(latitudes, bases), smooth_alike(longitudes, bases)
    made = []
    for latitude, longitude in zip(towards.made, across.made, strict=True):
        flat = np.cos(latitude)
        point = np.concatenate([flat * np.sin(longitude), -flat * np.cos(longitude), np.sin(latitude)], 1)
        made.append(point[:, order])
    return made, towards, across


def _bounded(gaps: list[np.ndarray]) -> list[np.ndarray]:
    """Gaps (T, 3), those far above what is usual shortened to it: single frames may be anywhere."""
    sizes = [np.linalg.norm(gap, axis=1, keepdims=True) for gap in gaps]
    most = _FAR * np.concatenate(sizes).mean()
    return [gap * np.minimum(1.0, most / np.maximum(size, 1e-12)) for gap, size in zip(gaps, sizes, strict=True)]


def _rotvec(turns: np.ndarray) -> np.ndarray:
    return np.asarray(Rotation.from_matrix(turns).as_rotvec())


def _spin(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) about `axis` by angles (T,)."""
    return np.asarray(Rotation.from_rotvec(angle[:, None] * axis).as_matrix())


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
