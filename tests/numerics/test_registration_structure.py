"""registration: structure from motion on a rigid textured body; several providers in one object frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.registration.answer import Answer, Subject
from stages.registration.combine import combine, common_rotation
from stages.registration.placing import default_intrinsics, ray_rotation, transforms, view_rotation
from stages.registration.structure import structure_from_motion
from tests.numerics.turning_scene import cast, clip_of


def quiet(done: int, total: int, label: str) -> None:
    assert 0 <= done <= total and label


def speckled(points: np.ndarray) -> np.ndarray:
    """Brightness (...) of a pattern fixed to the body: blurred noise looked up by place."""
    random = np.random.default_rng(5)
    waves = random.normal(size=(60, 3)) * 14
    phase = random.uniform(0, 2 * np.pi, 60)
    return 0.5 + 0.5 * np.tanh(np.sin(points @ waves.T + phase).sum(-1) / 4)


def test_structure_from_motion_recovers_a_rigid_turn() -> None:
    side, count = 240, 14
    azimuth = np.radians(np.linspace(0, 65, count))
    truth = transforms(view_rotation(azimuth, np.full(count, 0.3)), np.tile([0.0, 0.0, 3.2], (count, 1)))
    intrinsics = default_intrinsics(side, side, 1.3 * side)
    cues, _ = clip_of(azimuth, side=side)
    casts = [cast(pose, intrinsics, side) for pose in truth]

    def frame(i: int) -> tuple[np.ndarray, np.ndarray]:
        picture, mask, points = casts[i]
        grey = np.where(mask, speckled(points), 0.4)[..., None]
        return np.round(255 * np.clip(0.6 * grey + 0.4 * picture, 0, 1)).astype(np.uint8), mask.astype(np.uint8) * 255

    subject = Subject("a", cues, intrinsics, frame=frame)
    answer = structure_from_motion([subject], 0, quiet)["a"]
    found = ray_rotation(answer.origin_px, intrinsics) @ answer.rotation
    turn = common_rotation(truth[:, :3, :3], found, np.ones(count))
    errors = np.degrees(Rotation.from_matrix((found @ turn).transpose(0, 2, 1) @ truth[:, :3, :3]).magnitude())
    assert np.median(errors) < 3 and errors[answer.confidence > 0.9 * answer.confidence.max()].max() < 4
    assert answer.trust > 0.6 and answer.confidence.max() <= 0.9
    assert np.abs(answer.origin_px - side / 2).max() < 0.15 * side
    assert (answer.extent > 1).all() and (answer.extent < 4).all()


def test_a_featureless_clip_gets_no_answer() -> None:
    cues, _ = clip_of(np.linspace(0, 0.5, 4))
    blank = (np.full((96, 96, 3), 128, np.uint8), np.full((96, 96), 255, np.uint8))
    subject = Subject("a", cues, default_intrinsics(96, 96), frame=lambda i: blank)
    assert structure_from_motion([subject], 0, quiet) == {}
    assert structure_from_motion([replace(subject, frame=None)], 0, quiet) == {}


def test_answers_in_different_frames_are_brought_together() -> None:
    random = np.random.default_rng(0)
    truth = {n: Rotation.random(5, random_state=i).as_matrix() for i, n in enumerate("abc")}
    frames = [Rotation.random(random_state=9).as_matrix(), np.eye(3)]

    def say(name: str, trusts: dict[str, float], frame: np.ndarray) -> dict[str, Answer]:
        sure = np.ones(5)
        return {
            n: Answer(name, truth[n] @ frame, 2 * sure, np.zeros((5, 2)), t * sure, t, wave_rad=(0.1, 0.2, 0.1))
            for n, t in trusts.items()
        }

    one, two = say("one", {"a": 0.9, "b": 0.8}, frames[0]), say("two", {"b": 0.5, "c": 0.6}, frames[1])
    chosen = combine([two, one], ["a", "b", "c"])
    assert {n: a.provider for n, a in chosen.items()} == {"a": "one", "b": "one", "c": "two"}
    assert chosen["c"].rotation == pytest.approx(truth["c"] @ frames[0])
    assert chosen["c"].trust == 0.6
    # what a provider says of the axes of its own object frame holds in that alone
    assert [chosen[n].wave_rad for n in "abc"] == [(0.1, 0.2, 0.1), (0.1, 0.2, 0.1), None]
    # nothing in common: the second's frame is a guess, and its trust says so
    apart = combine([say("one", {"a": 0.9}, frames[0]), say("two", {"c": 0.6}, frames[1])], ["a", "c"])
    assert apart["c"].trust == pytest.approx(0.3) and apart["c"].confidence == pytest.approx(np.full(5, 0.3))
    noisy = truth["a"] @ frames[0] @ Rotation.from_rotvec(random.normal(scale=0.02, size=(5, 3))).as_matrix()
    assert np.abs(common_rotation(noisy, truth["a"], np.ones(5)) - frames[0]).max() < 0.05
