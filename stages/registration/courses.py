"""Smooth courses through noisy values: Gaussian-process regression whose smoothness is read off the values themselves.

A course is a straight line in time plus a stationary wander about it (squared-exponential covariance), seen with white
noise. How large the wander is against the noise, and how slowly it goes, is common to all courses of a collection and
maximises their restricted likelihood: the likelihood of what is left when every straight line has been taken off
(Rasmussen and Williams, Gaussian Processes for Machine Learning, sections 2.7 and 5.4).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LENGTHS_S = (0.15, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0)
"""Length scales that are tried for the wander, seconds."""
SWINGS = (0.0, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 2.0, 4.0, 10.0, 30.0, 100.0, 1e3, 1e4)
"""Sizes of the wander that are tried, in standard deviations of the noise; 0 leaves a straight line."""
_FLOOR = 1e-12  # of the wander's variance: what is less in an eigenvalue is rounding


class Courses(NamedTuple):
    """What `smooth` found."""

    made: list[np.ndarray]
    """The courses (T, C)."""
    left: list[float]
    """How far each course is expected to be from the truth but for its mean: root mean square, in the values' unit."""
    noise: float
    """Standard deviation of the noise, in the values' unit."""


class Basis(NamedTuple):
    """What smoothing needs of a clip's times alone; all that takes long."""

    line: np.ndarray
    """(T, 2): an offset and a slope, orthonormal."""
    wanders: list[tuple[np.ndarray, np.ndarray]]
    """Eigenvalues (T,) and eigenvectors (T, T) of the wander's covariance, for each of LENGTHS_S."""


def basis(time_s: np.ndarray) -> Basis:
    """The basis of a clip at times (T,) in seconds, three or more."""
    middle = time_s - time_s.mean()
    line = np.linalg.qr(np.stack([np.ones_like(middle), middle], 1))[0]
    away = time_s[:, None] - time_s[None]
    found = [np.linalg.eigh(np.exp(-0.5 * (away / length) ** 2)) for length in LENGTHS_S]
    return Basis(line, [(np.maximum(variances, _FLOOR), vectors) for variances, vectors in found])


def smooth(values: list[np.ndarray], bases: list[Basis]) -> Courses:
    """The likeliest courses through `values` (T, C) at the times of `bases`."""
    likelihood, best, swing, noise = -np.inf, 0, 0.0, 0.0
    for length in range(len(LENGTHS_S)):
        modes = [_modes(value, base, length) for value, base in zip(values, bases, strict=True)]
        for size in SWINGS:
            now, spread = _restricted(modes, size)
            if now > likelihood:
                likelihood, best, swing, noise = now, length, size, spread
    made, left = [], []
    for value, base in zip(values, bases, strict=True):
        course, variance = _posterior(_modes(value, base, best), swing)
        made.append(course)
        left.append(noise * float(np.sqrt(variance)))
    return Courses(made, left, noise)


class _Modes(NamedTuple):
    """A course in the eigenvectors of the wander's covariance."""

    vectors: np.ndarray  # (T, T)
    variances: np.ndarray  # (T,)
    value: np.ndarray  # (T, C)
    line: np.ndarray  # (T, 2): an offset and a slope


def _modes(value: np.ndarray, base: Basis, length: int) -> _Modes:
    variances, vectors = base.wanders[length]
    return _Modes(vectors, variances, vectors.T @ value, vectors.T @ base.line)


def _without_line(modes: _Modes, swing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Precision (T,) of each mode in units of the noise, what the line leaves of it (T, C), the line's own (2, 2)."""
    precision = 1 / (1 + swing**2 * modes.variances)
    own = modes.line.T @ (precision[:, None] * modes.line)
    rest = modes.value - modes.line @ np.linalg.solve(own, modes.line.T @ (precision[:, None] * modes.value))
    return precision, rest, own


def _restricted(courses: list[_Modes], swing: float) -> tuple[float, float]:
    """Restricted log likelihood, up to a constant and with the noise at its best, and that noise."""
    square, spoken, volume = 0.0, 0, 0.0
    for modes in courses:
        precision, rest, own = _without_line(modes, swing)
        count, channels = modes.value.shape
        square += float((precision[:, None] * rest**2).sum())
        spoken += channels * (count - 2)
        volume += channels * float(np.linalg.slogdet(own)[1] - np.log(precision).sum())
    variance = max(square / max(spoken, 1), 1e-30)
    return -0.5 * (spoken * np.log(variance) + volume), float(np.sqrt(variance))


def _posterior(modes: _Modes, swing: float) -> tuple[np.ndarray, float]:
    """The course (T, C), and the mean variance of what differs from its mean, in units of the noise's."""
    precision, rest, own = _without_line(modes, swing)
    made = modes.vectors @ (modes.value - precision[:, None] * rest)
    leverage = modes.vectors @ (precision[:, None] * modes.line)
    covariance = (modes.vectors * (1 - precision)) @ modes.vectors.T + leverage @ np.linalg.solve(own, leverage.T)
    return made, max(0.0, float(np.diag(covariance).mean() - covariance.mean()))
