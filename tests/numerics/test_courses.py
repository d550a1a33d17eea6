"""Smooth courses: the dense formula of Gaussian-process regression, and what is read off the values."""

from __future__ import annotations

import numpy as np
import pytest

from stages.registration import courses
from stages.registration.courses import basis, smooth, smooth_alike


def wandering(rng: np.random.Generator, time: np.ndarray, length: float, size: float) -> np.ndarray:
    """A draw (T, 2) of the wander itself."""
    covariance = np.exp(-0.5 * ((time[:, None] - time[None]) / length) ** 2) + 1e-9 * np.eye(len(time))
    return size * np.linalg.cholesky(covariance) @ rng.normal(size=(len(time), 2))


def test_straight_lines_stay_and_the_noise_about_them_is_told() -> None:
    time = np.arange(50) / 10
    rng = np.random.default_rng(0)
    truth = [np.stack([a + b * time, -b * time], 1) for a, b in rng.normal(size=(20, 2))]
    found = smooth([t + rng.normal(0, 0.1, t.shape) for t in truth], [basis(time)] * 20)
    assert found.noise == pytest.approx(0.1, rel=0.06)
    error = np.sqrt(np.mean([np.square(made - t).mean() for made, t in zip(found.made, truth, strict=True)]))
    assert error < 1.4 * 0.1 * np.sqrt(2 / 50)  # of a straight line: two numbers from fifty


def test_values_without_noise_are_left_as_they_are() -> None:
    time = np.cumsum(np.random.default_rng(0).uniform(0.03, 0.07, 80))
    value = np.stack([np.sin(2 * time), 3 * time], 1)
    found = smooth([value], [basis(time)])
    assert found.noise < 1e-4 and np.allclose(found.made[0], value, atol=1e-4)


@pytest.mark.parametrize(("length", "size"), [(0.3, 0.5), (1.2, 0.2)])
def test_courses_that_wander_are_followed_as_closely_as_is_said(length: float, size: float) -> None:
    time, rng = np.arange(75) / 20, np.random.default_rng(1)
    truth = [wandering(rng, time, length, size) + rng.normal() * time[:, None] for _ in range(12)]
    found = smooth([t + rng.normal(0, 0.2, t.shape) for t in truth], [basis(time)] * 12)
    assert found.noise == pytest.approx(0.2, rel=0.06)
    rest = [made - t for made, t in zip(found.made, truth, strict=True)]
    left = np.sqrt(np.mean([np.square(r - r.mean(0)).mean() for r in rest]))
    assert left == pytest.approx(np.sqrt(np.mean(np.square(found.left))), rel=0.15) and left < 0.1


def test_the_course_is_that_of_the_dense_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(courses, "LENGTHS_S", (0.7,))
    monkeypatch.setattr(courses, "SWINGS", (1.5,))
    rng = np.random.default_rng(2)
    time = np.sort(rng.uniform(0, 3, 20))
    value = rng.normal(size=(20, 3))
    wander = 1.5**2 * np.exp(-0.5 * ((time[:, None] - time[None]) / 0.7) ** 2)
    line = np.stack([np.ones(20), time], 1)
    inverse = np.linalg.inv(wander + np.eye(20))
    slope = np.linalg.solve(line.T @ inverse @ line, line.T @ inverse @ value)
    expected = line @ slope + wander @ inverse @ (value - line @ slope)
    found = smooth([value], [basis(time)])
    assert np.allclose(found.made[0], expected, atol=1e-9)
    # A line whose offset and slope may be anything has a covariance far larger than all else.
    loose = wander + 1e5 * line @ line.T
    left = np.eye(20) - np.linalg.inv(loose + np.eye(20))
    centred = np.eye(20) - 1 / 20
    square = np.trace(value.T @ (inverse @ (value - line @ slope))) / (3 * 18)
    assert found.noise == pytest.approx(np.sqrt(square))
    assert found.left[0] == pytest.approx(np.sqrt(square * np.trace(centred @ left @ centred) / 20), rel=1e-3)


@pytest.mark.parametrize("paced", [False, True])
def test_courses_that_are_alike_are_those_of_the_dense_formula(monkeypatch: pytest.MonkeyPatch, paced: bool) -> None:
    """Everything that is not known of a line has a covariance far larger than all else."""
    for name, one in (("LENGTHS_S", (0.7,)), ("SWINGS", (1.5,)), ("SPREADS", (0.8,))):
        monkeypatch.setattr(courses, name, one)
    rng = np.random.default_rng(3)
    times = [np.linspace(0, length, 15) for length in (2.0, 3.0)]
    bases = [basis(time) for time in times]
    slopes = (3.0, -2.0) if paced else (0.1, -0.1)
    values = [rng.normal(size=15) + slope * (time - time.mean()) for time, slope in zip(times, slopes, strict=True)]
    wander = [1.5**2 * np.exp(-0.5 * ((time[:, None] - time[None]) / 0.7) ** 2) for time in times]
    blocks = np.zeros((30, 30))
    for i, base in enumerate(bases):
        mine = slice(15 * i, 15 * i + 15)
        size = 1e7 if paced else 0.8**2
        blocks[mine, mine] = wander[i] + size * base.line @ base.line.T
    if paced:
        paces = np.array([np.polyfit(base.line[:, 1], value, 1)[0] for base, value in zip(bases, values, strict=True)])
        paces /= np.sqrt(np.mean(np.square(paces)))
        eases = np.concatenate([pace * base.ease for pace, base in zip(paces, bases, strict=True)])
        blocks += 0.8**2 * np.outer(eases, eases)
    else:
        blocks += 1e7
    value = np.concatenate(values)
    expected = blocks @ np.linalg.solve(blocks + np.eye(30), value)
    found = smooth_alike([one[:, None] for one in values], bases, paced)
    assert np.allclose(np.concatenate(found.made)[:, 0], expected, atol=1e-4)
    left = found.noise**2 * (np.eye(30) - np.linalg.inv(blocks + np.eye(30)))
    for i in range(2):
        mine = left[15 * i : 15 * i + 15, 15 * i : 15 * i + 15]
        assert found.left[i] == pytest.approx(np.sqrt(np.diag(mine).mean() - mine.mean()), rel=1e-3)
        assert found.left_mean[i] == pytest.approx(np.sqrt(mine.mean()), rel=1e-3)


def test_level_courses_tell_of_each_other_and_others_do_not() -> None:
    time, rng = np.arange(75) / 20, np.random.default_rng(4)
    bases = [basis(time)] * 6

    def error(truth: list[np.ndarray], made: list[np.ndarray]) -> float:
        return float(np.sqrt(np.mean([np.square(m - t).mean() for m, t in zip(made, truth, strict=True)])))

    level = [np.full((75, 1), 0.7)] * 6
    seen = [t + rng.normal(0, 0.3, t.shape) for t in level]
    assert error(level, smooth_alike(seen, bases).made) < 0.6 * error(level, smooth(seen, bases).made)
    apart = [offset + slope * time[:, None] for offset, slope in rng.normal(size=(6, 2))]
    seen = [t + rng.normal(0, 0.3, t.shape) for t in apart]
    assert error(apart, smooth_alike(seen, bases).made) < 1.05 * error(apart, smooth(seen, bases).made)


def test_sweeps_that_set_out_and_come_to_rest_alike_are_followed() -> None:
    """Each to its own side, from its own place, at its own pace; and even sweeps stay even."""
    rng, times = np.random.default_rng(5), [np.arange(count) / 20 for count in (60, 75, 90, 75, 60)]
    bases = [basis(time) for time in times]
    for ease in (0.0, 0.6):
        truth = []
        for time, pace in zip(times, (1.0, -0.9, 1.1, -1.2, 0.8), strict=True):
            u = 2 * time / time[-1] - 1
            truth.append((rng.normal() + pace * ((1 - ease) * u + ease * (1.5 * u - 0.5 * u**3)))[:, None])
        error, plain = [], []
        for _ in range(4):
            seen = [t + rng.normal(0, 0.2, t.shape) for t in truth]
            for told, made in ((error, smooth_alike(seen, bases, paced=True).made), (plain, smooth(seen, bases).made)):
                told.append(np.mean([np.square(m - t).mean() for m, t in zip(made, truth, strict=True)]))
        assert np.sqrt(np.mean(error)) < (0.85 if ease else 1.1) * np.sqrt(np.mean(plain))
