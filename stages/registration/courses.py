"""Smooth courses through noisy values: Gaussian-process regression whose smoothness is read off the values themselves.

A course is a straight line in time plus a stationary wander about it (squared-exponential covariance), seen with white
noise. Where clips are filmed alike, courses are alike, too: lines lie near a common level, slopes near none (a phone is
held upright in all of them), and who goes around a subject sets out and comes to rest in the same way each time. How
large all that is against the noise, and how slowly courses wander, is common to a collection and maximises the
restricted likelihood: the likelihood of what is left when everything that nothing is known of has been taken off
(Rasmussen and Williams, Gaussian Processes for Machine Learning, sections 2.7 and 5.4). So courses that are not alike
are not made so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LENGTHS_S = (0.15, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0)
"""Length scales that are tried for the wander, seconds."""
SWINGS = (0.0, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 2.0, 4.0, 10.0, 30.0, 100.0, 1e3, 1e4)
"""Sizes of the wander that are tried, in standard deviations of the noise; 0 leaves a straight line."""
SPREADS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0, 100.0, 1e3)
"""Sizes of what courses differ by, or share, that are tried, in standard deviations of the noise. Finite ones: where
something may be anywhere, the restricted likelihood does not speak of it, so the two cannot be compared."""
_FLOOR = 1e-12  # of the wander's variance: what is less in an eigenvalue is rounding
_ROUNDS = 4  # times each size is looked for, given the others
_BETTER = 1e-9  # of the likelihood: what is less is rounding


class Courses(NamedTuple):
    """What was found."""

    made: list[np.ndarray]
    """The courses (T, C)."""
    left: list[float]
    """How far each course is expected to be from the truth but for its mean: root mean square, in the values' unit."""
    left_mean: list[float]
    """How far its mean is expected to be from the truth's, in the values' unit."""
    noise: float
    """Standard deviation of the noise, in the values' unit."""


class Basis(NamedTuple):
    """What smoothing needs of a clip's times alone; all that takes long."""

    line: np.ndarray
    """(T, 2): an offset and a slope, each of root mean square one at even times."""
    ease: np.ndarray
    """(T,): what a sweep that sets out slowly and comes to rest is ahead or behind (the third Legendre polynomial)."""
    wanders: list[tuple[np.ndarray, np.ndarray]]
    """Eigenvalues (T,) and eigenvectors (T, T) of the wander's covariance, for each of LENGTHS_S."""


class Sizes(NamedTuple):
    """What is common to the courses of a collection; but for `length` in standard deviations of the noise."""

    length: int = 0
    """Of the wander, an index of LENGTHS_S."""
    swing: float = 0.0
    """Of the wander."""
    offset: float = np.inf
    """By which lines differ about a common level; infinite: each lies anywhere."""
    slope: float = np.inf
    """Of slopes, root mean square over the course."""
    ease: float = 0.0
    """Of the ease that all courses share, each in proportion to its pace."""


def basis(time_s: np.ndarray) -> Basis:
    """The basis of a clip at times (T,) in seconds, three or more."""
    along = 2 * (time_s - time_s[0]) / (time_s[-1] - time_s[0]) - 1
    line = np.stack([np.ones_like(along), np.sqrt(3) * along], 1)
    away = time_s[:, None] - time_s[None]
    found = [np.linalg.eigh(np.exp(-0.5 * (away / length) ** 2)) for length in LENGTHS_S]
    wanders = [(np.maximum(variances, _FLOOR), vectors) for variances, vectors in found]
    return Basis(line, (5 * along**3 - 3 * along) / 2, wanders)


def smooth(values: list[np.ndarray], bases: list[Basis]) -> Courses:
    """The likeliest courses through `values` (T, C) at the times of `bases`, whose lines may lie anywhere."""
    modes = [_in_modes(values, bases, [0.0] * len(values), length) for length in range(len(LENGTHS_S))]
    return _courses(modes, _likeliest(modes, Sizes(), ()))


def smooth_alike(values: list[np.ndarray], bases: list[Basis], paced: bool = False) -> Courses:
    """The likeliest courses through `values` (T, 1) of clips that may have been filmed alike.

    `paced` courses go somewhere, each at its own pace and from where it likes, but may share how they set out and come
    to rest; others may share their level and stay there.
    """
    paces = [0.0] * len(values)
    if paced:
        slopes = [np.linalg.lstsq(base.line, one, rcond=None)[0][1, 0] for one, base in zip(values, bases, strict=True)]
        usual = max(float(np.sqrt(np.mean(np.square(slopes)))), 1e-12)
        paces = [float(slope) / usual for slope in slopes]
    modes = [_in_modes(values, bases, paces, length) for length in range(len(LENGTHS_S))]
    if paced:
        return _courses(modes, _likeliest(modes, Sizes(), ("ease",)))
    return _courses(modes, _likeliest(modes, Sizes(offset=SPREADS[-1], slope=SPREADS[-1]), ("offset", "slope")))


class _Modes(NamedTuple):
    """A course in the eigenvectors of the wander's covariance."""

    vectors: np.ndarray  # (T, T)
    variances: np.ndarray  # (T,)
    value: np.ndarray  # (T, C)
    line: np.ndarray  # (T, 2): an offset and a slope
    common: np.ndarray  # (T, 2): a level and an ease that all courses share


class _Rest(NamedTuple):
    """What is left of courses when all that is fitted is taken off, and how certain that is, noise being one."""

    rests: list[np.ndarray]  # (T, C) of each clip, times precision, in modes
    own: list[np.ndarray]  # (T, T) of each clip: takes off what is the clip's own, and is the precision of what is left
    common: list[np.ndarray]  # (T, K) of each clip: what is common, taken off and weighed likewise
    spread: np.ndarray  # (K, K) covariance of what is common
    noise: float
    likelihood: float


def _in_modes(values: list[np.ndarray], bases: list[Basis], paces: list[float], length: int) -> list[_Modes]:
    made = []
    for value, base, pace in zip(values, bases, paces, strict=True):
        variances, vectors = base.wanders[length]
        common = np.stack([np.ones(len(value)), pace * base.ease], 1)
        made.append(_Modes(vectors, variances, vectors.T @ value, vectors.T @ base.line, vectors.T @ common))
    return made


def _likeliest(modes: list[list[_Modes]], sizes: Sizes, names: tuple[str, ...]) -> Sizes:
    """From `sizes`, the wander's size and length, and those in `names`, in turn, as long as that gains."""
    best = -np.inf
    for _ in range(_ROUNDS if names else 1):
        before = best
        for name in ("swing", *names):
            grid = SWINGS if name == "swing" else SPREADS
            lengths = range(len(LENGTHS_S)) if name == "swing" else (sizes.length,)
            for some in [_with(sizes, length, name, size) for length in lengths for size in grid]:
                likelihood = _fit(modes[some.length], some).likelihood
                if likelihood > best + _BETTER:
                    best, sizes = likelihood, some
        if best <= before + _BETTER:
            break
    return sizes


def _with(sizes: Sizes, length: int, name: str, size: float) -> Sizes:
    return Sizes(**{**sizes._asdict(), "length": length, name: size})


def _fit(clips: list[_Modes], sizes: Sizes, whole: bool = False) -> _Rest:
    """Mixed-model equations: a clip's own line first, then what is common; noise at its best.

    `whole` keeps the matrices that tell how certain the courses are.
    """
    spreads, shared = np.array([sizes.offset, sizes.slope]), np.array([np.inf, sizes.ease])
    has = np.array([np.isfinite(sizes.offset), sizes.ease > 0])  # a level is common unless each line lies anywhere
    channels = clips[0].value.shape[1]
    square, spoken, volume = 0.0, 0, 0.0
    precise, right = np.diag(1 / shared[has] ** 2), np.zeros((int(has.sum()), channels))
    rests, own, commons = [], [], []
    for modes in clips:
        precision = 1 / (1 + sizes.swing**2 * modes.variances)
        line, common = modes.line[:, spreads > 0], modes.common[:, has]
        weighed = precision[:, None] * line
        held = 1 / spreads[spreads > 0] ** 2
        among = weighed.T @ line + np.diag(held)
        rest, left = (
            precision[:, None] * some - weighed @ np.linalg.solve(among, weighed.T @ some)
            for some in (modes.value, common)
        )
        square += float((modes.value * rest).sum())
        spoken += channels * (len(precision) - int((held == 0).sum()))
        volume += float(np.linalg.slogdet(among)[1] - np.log(precision).sum() - np.log(held[held > 0]).sum())
        precise, right = precise + common.T @ left, right + common.T @ rest
        rests.append(rest)
        commons.append(left)
        if whole:
            own.append(np.diag(precision) - weighed @ np.linalg.solve(among, weighed.T))
    spread = np.linalg.inv(precise)
    common_size = spread @ right
    held = 1 / shared[has] ** 2
    square -= float((right * common_size).sum())
    spoken -= channels * int((held == 0).sum())
    volume += float(np.linalg.slogdet(precise)[1] - np.log(held[held > 0]).sum())
    variance = max(square / max(spoken, 1), 1e-30)
    rests = [rest - left @ common_size for rest, left in zip(rests, commons, strict=True)]
    likelihood = -0.5 * (spoken * np.log(variance) + channels * volume)
    return _Rest(rests, own, commons, spread, float(np.sqrt(variance)), likelihood)


def _courses(modes: list[list[_Modes]], sizes: Sizes) -> Courses:
    clips = modes[sizes.length]
    found = _fit(clips, sizes, whole=True)
    made, left, left_mean = [], [], []
    for one, rest, own, common in zip(clips, found.rests, found.own, found.common, strict=True):
        made.append(one.vectors @ (one.value - rest))
        covariance = np.eye(len(own)) - own + common @ found.spread @ common.T
        covariance = one.vectors @ covariance @ one.vectors.T
        mean = max(0.0, float(covariance.mean()))
        left.append(found.noise * float(np.sqrt(max(0.0, float(np.diag(covariance).mean()) - mean))))
        left_mean.append(found.noise * float(np.sqrt(mean)))
    return Courses(made, left, left_mean, found.noise)
