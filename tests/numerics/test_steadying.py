"""Root poses that jitter become steady; poses that move smoothly, however fast, stay as they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from stages.registration.steadying import SLOW_S, main_axis, steady, wave_left

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
    (made,), turned_s, placed_s = steady([truth], [TIME])
    assert (turned_s, placed_s) == ((0.0, 0.0), 0.0)
    assert np.array_equal(made, truth)


@pytest.mark.parametrize(("degrees", "left"), [(5.0, 0.5), (20.0, 0.4), (50.0, 0.4)])
def test_most_of_a_jitter_goes(degrees: float, left: float) -> None:
    truth = [track(1.0, 0.1), track(-1.0, 0.1)]
    seen = [shaken(t, degrees) for t in truth]
    made, turned_s, placed_s = steady(seen, [TIME, TIME])
    assert min(turned_s) > 0.05 and placed_s == 0.0
    for found, before, t in zip(made, seen, truth, strict=True):
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
    made, _, _ = steady(seen, [TIME, TIME])
    for found, t in zip(made, truth, strict=True):
        assert errors(found, t)[0] <= 0.22 * degrees + 1e-5
        tilt = np.degrees(np.arccos(np.clip((found[:, :3, 1] * t[:, :3, 1]).sum(1), -1, 1)))
        assert tilt.mean() <= 0.2 * degrees + 1e-5


def test_places_are_steadied_by_themselves() -> None:
    truth = track(1.0)
    seen = shaken(truth, 0.0, 0.05)
    (made,), turned_s, placed_s = steady([seen], [TIME])
    assert turned_s == (0.0, 0.0) and placed_s > 0.0
    assert errors(made, truth)[1] < 0.5 * errors(seen, truth)[1]


def test_one_frame_that_is_far_off_is_brought_back() -> None:
    truth = track(1.0, 0.1)
    seen = shaken(truth, 5.0)
    seen[30, :3, :3] = seen[30, :3, :3] @ Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix()
    (made,), _, _ = steady([seen], [TIME])
    assert errors(made[30:31], truth[30:31])[0] < 6


def test_a_clip_of_a_few_frames_stays() -> None:
    short = shaken(track(), 20.0)[:5]
    (made,), turned_s, _ = steady([short], [TIME[:5]])
    assert turned_s == (0.0, 0.0) and np.array_equal(made, short)


def test_the_wave_that_is_left_is_what_smoothing_noise_leaves() -> None:
    """White turns of a known size, smoothed as wide as SLOW_S, leave what is foretold about each axis."""
    time = np.arange(4000) / 20
    noise = np.random.default_rng(0).normal(0.0, 0.1, (len(time), 3))
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    turned = poses.copy()
    turned[:, :3, :3] = Rotation.from_rotvec(noise).as_matrix()
    left = gaussian_filter1d(noise, SLOW_S * 20, axis=0)
    assert np.allclose(wave_left(turned, poses, time), left.std(0), rtol=0.25)
    assert wave_left(poses, poses, time) == (0.0, 0.0, 0.0)
