"""Generated people and things: closed surfaces, sides kept, feet on the floor, clips with their truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from synthetic import motion
from synthetic.canonical import Carrier, canonical_body, laplacian_basis, mirror_vertices
from synthetic.clips import make_subject, write_clips
from synthetic.flesh import Body
from synthetic.people import PersonShape, person, vary_person
from synthetic.people_motion import perform_person
from synthetic.postures import bone_transforms, person_posture, quadruped_posture
from synthetic.things import thing


@pytest.fixture(scope="module")
def somebody() -> Body:
    return person(PersonShape(), 60)


def closed(body: Body) -> bool:
    edges = np.sort(np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


@pytest.mark.parametrize("seed", range(4))
def test_people_are_closed_and_upright(seed: int) -> None:
    body = person(vary_person(np.random.default_rng(seed)), 56)
    assert closed(body)
    np.testing.assert_allclose(body.weights.sum(1), 1, atol=1e-9)
    head, foot = body.bones[body.index("head")], body.bones[body.index("foot_left")]
    assert head.joint[1] > 0.4 > -0.4 > foot.joint[1], "y is up"
    assert body.bones[body.index("hand_left")].joint[0] > 0.2, "x is the person's left"
    assert foot.tip[2] > foot.joint[2] and body.marks["eye_left"][0][2] > 0, "z is the front"


def test_things_are_closed() -> None:
    rng = np.random.default_rng(3)
    assert all(closed(thing(rng, 30)) for _ in range(4))


def test_a_walking_person_stands_on_the_floor_and_gets_on(somebody: Body) -> None:
    knots = np.arange(0, 5, 0.5)
    still = np.zeros(len(knots))
    times = np.arange(1.0, 3.0, 0.05)
    moving = perform_person(somebody, motion.Performance(knots, still + 1.0, still, still, still), times)
    lowest = []
    for bones, place in zip(moving.bones, moving.room_from_object, strict=True):
        lowest.append((somebody.skin(bones) @ place[:3, :3].T + place[:3, 3])[:, 1].min())
    assert np.abs(lowest).max() < 0.02
    north = moving.room_from_object[:, 2, 3]
    assert (np.diff(north) > 0).mean() > 0.9 and 0.3 < (north[-1] - north[0]) / 2.0 < 3.0, "forwards, at a walk"


@pytest.mark.parametrize("draw", [person_posture, quadruped_posture])
def test_postures_differ_and_repeat(draw: object) -> None:
    first, again, other = (draw(np.random.default_rng(seed)) for seed in (1, 1, 2))  # type: ignore[operator]
    assert all((first[name] == again[name]).all() for name in first)
    assert any(np.abs(first[name] - other.get(name, 0)).max() > 0.05 for name in first)


def test_bones_turn_about_their_joints(somebody: Body) -> None:
    posture = {"arm_left": np.array([0.0, 0, 0.7]), "chest": np.array([0.3, 0, 0])}
    posed = bone_transforms(somebody, posture)
    for i, bone in enumerate(somebody.bones):
        if bone.parent >= 0:
            joint = np.append(bone.joint, 1)
            np.testing.assert_allclose(posed[i] @ joint, posed[bone.parent] @ joint, atol=1e-9)


@pytest.mark.parametrize("category", ["quadruped", "human"])
def test_canonical_labels(category: str) -> None:
    body = canonical_body(category)
    labels = Carrier.of(body).labels(body)
    assert (labels == np.arange(len(labels))).all(), "the canonical body is its own label"
    mirror = mirror_vertices(body.vertices)
    offset = body.vertices[mirror] * np.array([-1, 1, 1]) - body.vertices
    assert np.linalg.norm(offset, axis=1).max() < 0.08
    basis = laplacian_basis(body.vertices, body.faces, 24)
    assert np.abs((basis**2).mean(0) - 1).max() < 0.5, "about unit mean square"
    slow = np.abs(basis[body.faces[:, 0], 0] - basis[body.faces[:, 1], 0]).mean()
    assert slow < 0.1 * np.ptp(basis[:, 0]), "smooth"


def test_labels_keep_left_left() -> None:
    rng = np.random.default_rng(5)
    canonical, other = canonical_body("human"), person(vary_person(rng), 56)
    carried = canonical.vertices[Carrier.of(canonical).labels(other)]
    hand = other.weights[:, other.index("hand_left")] > 0.7
    assert (carried[hand, 0] > 0.2).all()
    head = other.weights[:, other.index("head")] > 0.7
    assert (carried[head, 1] > 0.5).mean() > 0.95


def test_a_clip_of_a_person_carries_its_truth(tmp_path: Path) -> None:
    subject = make_subject(0, "person")
    assert subject.body.marks
    film = write_clips(tmp_path, clips=1, frames=3, size=64, kind="person", with_motion=True)[0]
    assert film.masks.reshape(3, -1).sum(1).min() > 60
    with np.load(tmp_path / "truth" / "person-00.npz", allow_pickle=False) as truth:
        assert truth["vertices"].shape == (3, len(film.body.vertices), 3)
        names = [str(n) for n in truth["bone_names"]]
        hand = film.body.weights[:, names.index("hand_left")] > 0.9
        distance = np.linalg.norm(
            truth["vertices"][:, hand].mean(1) - truth["joints"][:, names.index("hand_left")], axis=1
        )
        assert distance.max() < 0.25 and np.ptp(distance) < 1e-3, "joints move with the surface"
