"""registration: turns from flow with their sign, the search, mirrored hypotheses, pictures for people."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from stages.registration.answer import Subject
from stages.registration.cues import inflate
from stages.registration.model import Hypothesis, Weights
from stages.registration.placing import default_intrinsics, depth_from_size, view_angles
from stages.registration.search import Effort, agreement, choose_frames, make_sequences, search, spread
from stages.registration.sheets import draw_pose, draw_surface, pose_sheet
from stages.registration.turning import expected_turns, row_turns, turn_rates
from stages.registration.upright import upright
from stages.registration.volume import ViewBank
from tests.numerics.turning_scene import BEAST, clip_of

QUICK = Effort(starts=4, rounds=11, fine_rounds=3, frames=45, coarse_px=16, fine_px=20)


def quiet(done: int, total: int, label: str) -> None:
    assert 0 <= done <= total and label


def after_one_turn(found: list[np.ndarray], truth: list[np.ndarray]) -> np.ndarray:
    """Rotation errors in degrees after the best common rotation."""
    p, g = np.concatenate(found), np.concatenate(truth)
    u, _, vt = np.linalg.svd(np.einsum("tji,tjk->ik", p, g))
    common = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return np.degrees(Rotation.from_matrix(np.einsum("tji,tjk->tik", p @ common, g)).magnitude())


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("step", [1, 2])
def test_the_flow_of_a_ball_tells_its_turn(way: float, step: int) -> None:
    ball = (((0.0, 0.0, 0.0), 0.8, (0.6, 0.6, 0.6)),)  # far away, so that perspective adds little
    cues, _ = clip_of(
        way * np.radians(3.0) * np.arange(6), elevation=0.0, distance=12.0, focal=5.0, step=step, balls=ball
    )
    relief = inflate(cues.mask) * 2 / cues.mask.shape[1]
    rates, trust = turn_rates(cues, relief)
    assert np.degrees(rates[:, 1]) == pytest.approx(np.full(6, way * 3.0), rel=0.35)
    assert np.abs(rates[:, [0, 2]]).max() < 0.004
    assert trust.min() > 0.8
    assert np.degrees(row_turns(cues, relief)) == pytest.approx(np.full(6, way * 3.0), rel=0.5)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_the_flow_of_a_beast_has_the_right_sign(way: float) -> None:
    cues, _ = clip_of(0.7 + way * np.radians(4.0) * np.arange(12))
    turns = np.degrees(expected_turns(cues))
    assert (way * turns > 0.5).all()
    answer = upright([Subject("a", cues, default_intrinsics(96, 96))], 0, quiet)["a"]
    azimuth = np.unwrap(view_angles(answer.rotation)[0])
    assert way * (azimuth[-1] - azimuth[0]) > 0.3
    assert answer.trust < 0.2  # it does not know where the front is, and says so


@pytest.fixture(scope="module")
def beast_clips() -> tuple[list[Subject], list[np.ndarray]]:
    bearings = [np.radians(np.linspace(*ends, 24)) for ends in ((-60, 70), (200, 60), (150, 280))]
    clips = [clip_of(b) for b in bearings]
    intrinsics = default_intrinsics(96, 96, 1.3 * 96)
    subjects = [Subject(f"clip-{i}", cues, intrinsics) for i, (cues, _) in enumerate(clips)]
    return subjects, [poses[:, :3, :3] for _, poses in clips]


def test_the_search_finds_how_the_beast_turns(beast_clips: tuple[list[Subject], list[np.ndarray]]) -> None:
    subjects, truth = beast_clips
    answers = search(subjects, 0, quiet, QUICK)
    errors = after_one_turn([answers[s.name].rotation for s in subjects], truth)
    assert errors.mean() < 20
    assert np.mean(errors > 90) == 0
    assert min(a.trust for a in answers.values()) > 0.3
    for subject in subjects:
        answer = answers[subject.name]
        assert answer.rotation.shape == (24, 3, 3)
        assert np.abs(answer.origin_px - 48).max() < 8  # the origin stays at the picture's centre
        assert (answer.confidence > 0).all() and (answer.confidence <= 1).all()


def test_the_search_is_the_same_twice(beast_clips: tuple[list[Subject], list[np.ndarray]]) -> None:
    subjects, _ = beast_clips
    little = Effort(starts=2, rounds=7, fine_rounds=1, frames=24, coarse_px=12, fine_px=12)
    first, second = (search(subjects, 3, quiet, little) for _ in range(2))
    for name in first:
        assert np.array_equal(first[name].rotation, second[name].rotation)


def test_given_clips_anchor_the_others(beast_clips: tuple[list[Subject], list[np.ndarray]]) -> None:
    subjects, truth = beast_clips
    # the user's own object space has z up and is in decimetres
    own = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    anchored = [
        replace(s, rotation=truth[i] @ own.T, depth=np.full(24, 32.0)) if i != 1 else s for i, s in enumerate(subjects)
    ]
    little = Effort(starts=3, rounds=10, fine_rounds=2, frames=45, coarse_px=16, fine_px=18)
    answers = search(anchored, 0, quiet, little)
    assert list(answers) == ["clip-1"]
    # no common rotation to be removed: the answer is in the given clips' own object space
    found = answers["clip-1"].rotation.transpose(0, 2, 1) @ (truth[1] @ own.T)
    assert np.degrees(Rotation.from_matrix(found).magnitude()).mean() < 25
    depth = depth_from_size(subjects[1].cues.box_px, subjects[1].intrinsics, answers["clip-1"].extent)
    assert np.median(depth) == pytest.approx(32.0, rel=0.15)


def test_a_mirrored_hypothesis_explains_less(beast_clips: tuple[list[Subject], list[np.ndarray]]) -> None:
    subjects, truth = beast_clips
    bank = ViewBank(np.arange(36) * 2 * np.pi / 36, np.radians([18.0]), 20)
    chosen = choose_frames([24] * 3, 60)
    still = [np.zeros(24)] * 3  # without the flow's evidence: the surface alone must tell
    evidence = []
    hypotheses = []
    for sign in (1, -1):
        sequences = make_sequences(subjects, chosen, still, bank)
        hypothesis = Hypothesis(sequences, bank, 20, Weights(), 0)
        for k in range(3):
            hypothesis.posterior[k] = spread(bank, sign * view_angles(truth[k][chosen[k]])[0], None)
        for _ in range(3):
            hypothesis.improve(15)
        hypothesis.look(30.0)
        evidence.append(hypothesis.evidence)
        hypotheses.append(hypothesis)
    assert evidence[0] < evidence[1]
    assert agreement(hypotheses[0], [hypotheses[0]], 1) == 1.0
    assert hypotheses[0].margin(0, 30.0) > 0.02


def test_frames_to_look_at() -> None:
    few, many = choose_frames([5, 300], 60)
    assert few.tolist() == [0, 1, 2, 3, 4]
    assert many[0] == 0 and many[-1] == 299 and 45 <= len(many) <= 60
    assert (np.diff(many) > 0).all()


def test_pictures_show_where_the_axes_point() -> None:
    intrinsics = default_intrinsics(100, 80, 100.0)
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[2, 3] = 3.0
    blank = np.zeros((80, 100, 3), np.uint8)
    drawn = draw_pose(blank, intrinsics, pose)
    assert drawn.shape == blank.shape and not blank.any()
    assert drawn[40, 62, 0] > 100  # x, red, to the right
    assert drawn[28, 50, 1] > 100  # y, green, upwards
    sheet = pose_sheet([("one", [drawn] * 12, np.ones(12)), ("two", [drawn] * 3, np.zeros(3))], height=40, columns=5)
    assert sheet.shape == (2 * (40 + 18), 5 * 50, 3)
    assert len(BEAST) == 7


def test_a_surface_is_drawn_where_it_stands_and_shows_its_front() -> None:
    intrinsics = default_intrinsics(100, 80, 100.0)
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])  # seen from the front
    pose[2, 3] = 3.0
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-1.0, 1.0)])
    faces = ConvexHull(corners).simplices
    blank = np.zeros((80, 100, 3), np.uint8)
    front = draw_surface(blank, intrinsics, pose, corners, faces)
    assert front[40, 50, 2] > 1.5 * front[40, 50, 0] and not front[5].any() and not blank.any()
    turned = pose.copy()
    turned[:3, :3] = np.diag([-1.0, -1.0, 1.0])  # from behind
    assert draw_surface(blank, intrinsics, turned, corners, faces)[40, 50, 2] < 0.7 * front[40, 50, 2]
    pose[2, 3] = 0.5  # it reaches behind the camera
    assert not draw_surface(blank, intrinsics, pose, corners, faces).any()
