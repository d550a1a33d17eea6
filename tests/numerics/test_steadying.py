"""Root poses that jitter become steady; poses that move smoothly, however fast, stay as they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.registration.steadying import main_axis, steady

FRAMES = 60
TIME = np.arange(FRAMES) / 20


def track(rate: float = 1.0, swing: float = 0.3) -> np.ndarray:
    """A subject that turns at `rate` (rad/s), nods by `swing` (rad) once a second, and walks past at depth 3."""
    out = np.tile(np.eye(4), (FRAMES, 1, 1))
    vectors = np.stack([swing * np.sin(2 * np.pi * TIME), rate * TIME, 0 * TIME], 1)
    out[:, :3, :3] = Rotation.from_euler("xyz", vectors).as_matrix()
    out[:, :3, 3] = np.stack([0.2 * TIME, 0 * TIME, 3 + 0.1 * TIME], 1)
    return out


def errors(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    rest = Rotation.from_matrix(truth[:, :3, :3].transpose(0, 2, 1) @ found[:, :3, :3])
    return float(np.degrees(rest.magnitude()).mean()), float(np.abs(found[:, :3, 3] - truth[:, :3, 3]).mean())


def shaken(truth: np.ndarray, degrees: float, units: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(FRAMES, 3))
    axis *= np.radians(degrees) / np.linalg.norm(axis, axis=1, keepdims=True)
    out = truth.copy()
    out[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec(axis).as_matrix()
    out[:, :3, 3] += units * rng.normal(size=(FRAMES, 3))
    return out


@pytest.mark.parametrize("rate", [0.0, 1.0, 4.0])
def test_smooth_motion_is_left_alone(rate: float) -> None:
    truth = track(rate)
    found = steady([truth], [TIME])
    assert (found.jitter_rad, found.jitter_units, found.wave_rad) == (0.0, 0.0, [(0.0, 0.0, 0.0)])
    assert np.array_equal(found.tracks[0], truth)


@pytest.mark.parametrize(("degrees", "left"), [(5.0, 0.5), (20.0, 0.4), (50.0, 0.4)])
def test_most_of_a_jitter_goes(degrees: float, left: float) -> None:
    truth = [track(1.0, 0.1), track(-1.0, 0.1)]
    seen = [shaken(t, degrees) for t in truth]
    made = steady(seen, [TIME, TIME])
    # Axes drawn evenly: a third of the square is about any one of them. Far-off turns wrap, or count less.
    assert made.jitter_rad == pytest.approx(np.radians(degrees) / np.sqrt(3), rel=0.15) and made.jitter_units == 0.0
    for found, before, t in zip(made.tracks, seen, truth, strict=True):
        assert errors(found, t)[0] < left * errors(before, t)[0]
        assert np.array_equal(found[:, :3, 3], t[:, :3, 3])
        identity = found[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1)
        assert identity == pytest.approx(np.tile(np.eye(3), (FRAMES, 1, 1)), abs=1e-9)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("degrees", [0.0, 5.0, 20.0, 50.0])
def test_whoever_walks_around_upright_keeps_upright(degrees: float) -> None:
    """The axis that a camera goes around stands nearly still in its pictures: all frames tell where it points."""
    truth = [np.tile(np.eye(4), (FRAMES, 1, 1)) for _ in range(2)]
    for track_, rate in zip(truth, (0.6, -0.6), strict=True):
        around = Rotation.from_euler("y", rate * TIME[:, None])
        track_[:, :3, :3] = (Rotation.from_euler("x", 0.3) * around).as_matrix()
        track_[:, 2, 3] = 3.0
    seen = [shaken(t, degrees) for t in truth]
    assert abs(main_axis([s[:, :3, :3] for s in seen])[1]) > 0.9
    for found, t in zip(steady(seen, [TIME, TIME]).tracks, truth, strict=True):
        assert errors(found, t)[0] <= 0.25 * degrees + 1e-5
        tilt = np.degrees(np.arccos(np.clip((found[:, :3, 1] * t[:, :3, 1]).sum(1), -1, 1)))
        assert tilt.mean() <= 0.23 * degrees + 1e-5


def test_places_are_steadied_by_themselves() -> None:
    truth = track(1.0)
    seen = shaken(truth, 0.0, 0.05)
    found = steady([seen], [TIME])
    (made,) = found.tracks
    assert found.jitter_rad == 0.0 and found.jitter_units == pytest.approx(0.05, rel=0.15)
    assert errors(made, truth)[1] < 0.5 * errors(seen, truth)[1]


def test_one_frame_that_is_far_off_is_brought_back() -> None:
    truth = track(1.0, 0.1)
    seen = shaken(truth, 5.0)
    seen[30, :3, :3] = seen[30, :3, :3] @ Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix()
    (made,) = steady([seen], [TIME]).tracks
    assert errors(made[30:31], truth[30:31])[0] < 6


def test_a_clip_of_a_few_frames_stays() -> None:
    short = shaken(track(), 20.0)[:5]
    found = steady([short], [TIME[:5]])
    assert found.jitter_rad == 0.0 and np.array_equal(found.tracks[0], short)


@pytest.mark.parametrize("down", [0.2, 1.2, np.pi / 2])
def test_phones_that_are_held_alike_tell_of_each_other(down: float) -> None:
    """Also from above, where the axis that the camera goes around points at it."""
    held, roaming = [], []
    for i, rate in enumerate((0.6, -0.6, 0.7, -0.5)):
        around = Rotation.from_euler("y", rate * TIME[:, None] + i)
        one = np.tile(np.eye(4), (FRAMES, 1, 1))
        one[:, :3, :3] = (Rotation.from_euler("x", down) * around).as_matrix()
        one[:, 2, 3] = 3.0
        held.append(one)
        other = one.copy()
        askew = Rotation.from_rotvec([0.3 * (-1) ** i, 0, 0.4 * (i - 1.5)]) * Rotation.from_rotvec(
            0.1 * TIME[:, None] * [(-1) ** i, 0, i - 1.5]
        )
        other[:, :3, :3] = askew.as_matrix() @ one[:, :3, :3]
        roaming.append(other)
    rng, tilts = np.random.default_rng(2), []
    for truth in (held, roaming):
        seen = [t.copy() for t in truth]
        for one in seen:
            one[:, :3, :3] = one[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0.0, 0.2, (FRAMES, 3))).as_matrix()
        found = steady(seen, [TIME] * 4)
        leans = [(made[:, :3, 1] * t[:, :3, 1]).sum(1) for made, t in zip(found.tracks, truth, strict=True)]
        tilts.append(float(np.arccos(np.clip(leans, -1, 1)).mean()))
    assert tilts[0] < 0.75 * tilts[1]  # a number for all, for two of each clip
    assert tilts[1] < 0.08


def test_what_is_foretold_to_be_left_is_left() -> None:
    """Over many clips, the turns that remain wrong about each axis are as large as it is said."""
    rng = np.random.default_rng(1)
    truth = [track(0.6 + 0.01 * i, 0.0) for i in range(20)]
    for one in truth:  # held askew, and ever more so, each in its own way
        askew = Rotation.from_rotvec(rng.normal(0, 0.2, 3) + TIME[:, None] * rng.normal(0, 0.1, 3))
        one[:, :3, :3] = askew.as_matrix() @ one[:, :3, :3]
    seen = [t.copy() for t in truth]
    for one in seen:
        noise = Rotation.from_rotvec(rng.normal(0.0, 0.1, (FRAMES, 3)))
        one[:, :3, :3] = one[:, :3, :3] @ noise.as_matrix()
    found = steady(seen, [TIME] * len(seen))
    assert found.jitter_rad == pytest.approx(0.1, rel=0.1)
    rest = []
    for made, t in zip(found.tracks, truth, strict=True):
        left = Rotation.from_matrix(t[:, :3, :3].transpose(0, 2, 1) @ made[:, :3, :3])
        rest.append((left.mean().inv() * left).as_rotvec())
    assert np.sqrt(np.mean(np.square(rest), (0, 1))) == pytest.approx(np.mean(found.wave_rad, 0), rel=0.25)
