"""Views of single frames tied together in time: reversals are outvoted, the path comes out smooth and right."""

from dataclasses import replace

import numpy as np
import pytest

from stages.registration.answer import Subject, ViewBelief
from stages.registration.cues import Cues
from stages.registration.placing import view_angles
from stages.registration.search import resample_bearing
from stages.registration.seen import seen, view_path, with_habit
from stages.registration.tracking import turning_posterior

BINS = np.radians(np.arange(-175.0, 180.0, 10.0))


def _log(bins: np.ndarray, at: np.ndarray, width_deg: float, periodic: bool = True) -> np.ndarray:
    away = bins[None] - at[:, None]
    away = np.angle(np.exp(1j * away)) if periodic else away
    share = np.exp(-0.5 * (away / np.radians(width_deg)) ** 2) + 0.002
    return np.log(share / share.sum(axis=1, keepdims=True))


def _subject(azimuth: np.ndarray, wrong: np.ndarray) -> Subject:
    """A clip whose network is sure, and sure of the back where `wrong` (T,)."""
    count = len(azimuth)
    said = np.where(wrong, azimuth + np.pi, azimuth)
    tilt = np.radians(np.arange(-25.0, 90.0, 10.0))
    roll = np.radians(np.arange(-41.25, 45.0, 7.5))
    view = ViewBelief(
        _log(BINS, said, 15.0),
        _log(tilt, np.full(count, np.radians(17.0)), 8.0, periodic=False),
        _log(roll, np.full(count, np.radians(4.0)), 5.0, periodic=False),
        BINS,
        tilt,
        roll,
    )
    crops = np.zeros((count, 16, 16), np.float32)
    crops[:, 4:12, 4:12] = 1
    cues = Cues(
        crops,
        np.zeros((count, 16, 16, 3), np.float32),
        np.zeros((count, 16, 16, 2), np.float32),
        np.zeros((count, 16, 16), np.float32),
        np.full((count, 2), 32.0),
        np.full(count, 20.0),
        np.tile([16.0, 16.0, 48.0, 48.0], (count, 1)),
        np.ones(count, bool),
        np.zeros(count, bool),
    )
    return Subject("clip", cues, np.array([[64.0, 0, 32], [0, 64.0, 32], [0, 0, 1]]), view=view)


def test_the_posterior_is_a_distribution_and_follows_a_clear_path() -> None:
    path = np.radians(np.linspace(-150, 250, 120))
    posterior, bins = turning_posterior(_log(BINS, path, 12.0), BINS, np.diff(path), np.full(119, 0.1))
    assert np.allclose(posterior.sum(axis=1), 1)
    found = np.angle(posterior @ np.exp(1j * bins))
    assert np.degrees(np.abs(np.angle(np.exp(1j * (found - path))))).max() < 12


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_reversed_frames_do_not_turn_the_path_round(share: float) -> None:
    azimuth = np.radians(np.linspace(20, 130, 60))
    wrong = np.random.default_rng(0).random(60) < share
    wrong[20:26] = True  # a whole stretch, too
    subject = _subject(azimuth, wrong)
    assert subject.view is not None
    found, elevation, roll, sharp = view_path(subject, subject.view)
    assert np.degrees(np.abs(np.angle(np.exp(1j * (found - azimuth))))).max() < 20
    assert np.degrees(elevation).mean() == pytest.approx(17, abs=4)
    assert np.degrees(roll).mean() == pytest.approx(4, abs=2)
    assert sharp.min() > 0.5


def test_trust_is_what_single_frames_say_of_the_path() -> None:
    azimuth = np.radians(np.linspace(20, 130, 60))
    sure = seen([_subject(azimuth, np.zeros(60, bool))], 0, lambda *_: None)["clip"]
    torn = seen([_subject(azimuth, np.arange(60) % 5 < 2)], 0, lambda *_: None)["clip"]
    assert sure.trust > 0.95 and 0.7 < torn.trust < 0.95
    assert sure.score["agreed"] > 0.85 and 0.4 < torn.score["agreed"] < 0.7
    angles = view_angles(sure.rotation)
    assert np.degrees(np.abs(np.angle(np.exp(1j * (angles[0] - azimuth))))).max() < 12


def test_the_ground_makes_tilts_surer() -> None:
    subject = _subject(np.radians(np.linspace(20, 130, 60)), np.zeros(60, bool))
    assert subject.view is not None
    grounded = replace(subject, view=replace(subject.view, ground_elevation=np.full(60, np.radians(30.0))))
    free, told = (seen([s], 0, lambda *_: None)["clip"] for s in (subject, grounded))
    assert np.degrees(view_angles(told.rotation)[1]) == pytest.approx(np.full(60, 30.0), abs=0.5)
    assert free.wave_rad is not None and told.wave_rad is not None
    assert told.wave_rad[0] < free.wave_rad[0] and told.wave_rad[1] == free.wave_rad[1]


def test_clips_without_a_network_get_no_answer() -> None:
    subject = _subject(np.zeros(10), np.zeros(10, bool))
    plain = Subject(subject.name, subject.cues, subject.intrinsics)
    assert seen([plain], 0, lambda *_: None) == {}


def test_bearings_are_read_between_bins_and_round_the_circle() -> None:
    at = np.radians(np.array([179.0, -90.0]))
    subject = _subject(at, np.zeros(2, bool))
    assert subject.view is not None
    fine = np.radians(np.arange(0, 360, 5.0))
    read = resample_bearing(subject.view, np.array([0, 1]), fine)
    assert np.degrees(fine[read.argmax(axis=1)]) == pytest.approx([180.0, 270.0], abs=5)
    assert read.max(axis=1) == pytest.approx([0.0, 0.0])


def test_an_unsure_tilt_leans_to_the_usual_and_a_strong_one_stays_strong() -> None:
    bins = np.radians(np.arange(-25.0, 90.0, 10.0))
    said = _log(bins, np.radians(np.array([5.0, 75.0])), 4.0, periodic=False)
    low, steep = np.degrees((np.exp(with_habit(said, bins, np.radians(18.0), np.radians(10.0))) * bins).sum(axis=1))
    assert 8 < low < 15
    assert steep > 60
    level = np.radians(np.arange(-41.25, 45.0, 7.5))
    said = _log(level, np.radians(np.array([6.0, 35.0])), 4.0, periodic=False)
    slight, lying = np.degrees((np.exp(with_habit(said, level, 0.0, np.radians(5.0))) * level).sum(axis=1))
    assert 0 < slight < 4
    assert lying > 20
