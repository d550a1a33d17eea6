"""Generated animals: a closed surface, soft weights, feet that stay where they stand, truth that agrees with itself."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest

from synthetic import motion
from synthetic.bodies import KINDS, Body, quadruped, vary
from synthetic.clips import Film, film, make_subject, write_clips
from synthetic.coats import PATTERNS, coat
from synthetic.rendering import look_at
from synthetic.rooms import draw_room, make_room


@pytest.fixture(scope="module")
def cat() -> Body:
    return quadruped(KINDS["cat"])


@pytest.fixture(scope="module")
def scene() -> Film:
    return film(make_subject(1, "fox"), clip=1, clips=3, frames=6, size=96, seed=1, fps=10)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_bodies_are_closed_and_of_the_agreed_size(kind: str) -> None:
    body = quadruped(vary(KINDS[kind], np.random.default_rng(5), 0.1), cells=90)
    edges = np.sort(np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all(), "every edge has two faces"
    low, high = body.vertices.min(0), body.vertices.max(0)
    np.testing.assert_allclose(high + low, 0, atol=1e-9)
    assert (high - low).max() == pytest.approx(2.0)
    corners = body.vertices[body.faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume > 0, "faces look outward"
    head, tail = body.bones[body.index("head")], body.bones[body.index("tail4")]
    assert head.joint[2] > 0 > tail.joint[2], "z is the front"
    assert body.bones[body.index("ear_left")].joint[0] > 0, "x is the animal's left"


def test_weights_are_soft_and_keep_to_their_side(cat: Body) -> None:
    np.testing.assert_allclose(cat.weights.sum(1), 1, atol=1e-12)
    assert (cat.weights >= 0).all()
    lower = [cat.index(n) for n in ("forearm_left", "hand_left", "shin_left", "foot_left")]
    wrong_side = cat.vertices[:, 0] < -0.06  # beyond the blend between the thighs
    assert cat.weights[np.ix_(wrong_side, lower)].max() < 0.02
    assert ((cat.weights > 0.05).sum(1) > 1).mean() > 0.3, "many vertices follow more than one bone"


def test_no_motion_is_the_rest_shape(cat: Body) -> None:
    identity = np.tile(np.eye(4), (len(cat.bones), 1, 1))
    np.testing.assert_allclose(cat.skin(identity), cat.vertices, atol=1e-12)


def test_standing_feet_do_not_slip(cat: Body) -> None:
    """In the room, a walking animal's planted paw stays where it is: gait and path agree."""
    knots = np.arange(0, 6, 0.5)
    still = np.zeros(len(knots))
    straight = motion.Performance(knots, still + 1.0, still, still, still)
    times = np.arange(1.0, 3.0, 0.02)
    moving = motion.perform(cat, straight, times)
    paw = cat.weights[:, cat.index("hand_left")] > 0.9
    soles = paw & (cat.vertices[:, 1] < cat.ground + 0.04)
    tracks = []
    for bones, place in zip(moving.bones, moving.room_from_object, strict=True):
        tracks.append((cat.skin(bones)[soles] @ place[:3, :3].T + place[:3, 3]).mean(0))
    track = np.array(tracks)
    speed = np.linalg.norm(np.diff(track[:, [0, 2]], axis=0), axis=1) / 0.02
    body_speed = np.linalg.norm(np.diff(moving.room_from_object[:, :3, 3], axis=0), axis=1).mean() / 0.02
    planted = np.sort(speed)[: len(speed) // 2]
    assert body_speed > 0.3
    assert planted.mean() < 0.2 * body_speed
    assert track[:, 1].min() > -0.06, "paws do not sink into the floor"
    assert track[:, 1].max() > 0.06, "paws are lifted"


def test_bones_move_rigidly(cat: Body) -> None:
    moving = motion.perform(cat, motion.improvise(np.random.default_rng(0), 2.0), np.arange(0, 2, 0.1))
    rotation = moving.bones[..., :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-9
    )
    step = np.abs(np.diff(moving.bones, axis=0)).max()
    assert step < 0.6, "no joint jumps between frames"


@pytest.mark.parametrize("pattern", PATTERNS)
def test_coats_have_something_to_track(cat: Body, pattern: str) -> None:
    worn = coat(cat, np.random.default_rng(2), pattern)
    assert worn.vertex_colours.shape == cat.vertices.shape
    assert worn.vertex_colours.min() >= 0 and worn.vertex_colours.max() <= 1
    assert worn.vertex_colours.std(0).max() > 0.05


def test_rooms_fill_the_view_and_move_with_the_camera() -> None:
    room = make_room(np.random.default_rng(3))
    intrinsics = np.array([[100.0, 0, 48], [0, 100.0, 48], [0, 0, 1]])
    views = []
    for x in (0.0, 0.3):
        pose = np.linalg.inv(look_at(np.array([x, 1.2, 3.0]), np.array([x, 0.5, 0.0])))
        views.append(draw_room(room, pose, intrinsics, 96, 96))
    assert (views[0].sum(-1) > 0).mean() > 0.999
    assert np.abs(views[0] - views[1]).mean() > 0.01


def test_masks_are_where_the_poses_put_the_surface(scene: Film) -> None:
    for t in (0, 5):
        pose = scene.camera_from_object[t]
        points = scene.vertices[t] @ pose[:3, :3].T + pose[:3, 3]
        pixel = points @ scene.intrinsics.T
        pixel = pixel[:, :2] / pixel[:, 2:]
        rows, columns = np.nonzero(scene.masks[t])
        box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        np.testing.assert_allclose(np.r_[pixel.min(0), pixel.max(0)], box, atol=1.6)
        column, row = np.clip(pixel.astype(int), 0, 95).T
        assert scene.masks[t][row, column].mean() > 0.9
    assert 0.04 < scene.masks.mean() < 0.4
    rotation = scene.camera_from_object[:, :3, :3]
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-9)


def test_flow_carries_pixels_to_the_same_colour(scene: Film) -> None:
    flow, visible = scene.flow(2, 3)
    assert visible.sum() > 200
    rows, columns = np.nonzero(visible)
    ahead = np.stack([columns, rows], 1) + np.round(flow[visible]).astype(int)
    ahead = np.clip(ahead, 0, 95)
    moved = np.abs(scene.images[2][visible].astype(int) - scene.images[3][ahead[:, 1], ahead[:, 0]]).mean()
    shuffled = np.abs(scene.images[2][visible].astype(int) - np.roll(scene.images[2][visible], 97, 0)).mean()
    assert moved < 0.5 * shuffled
    none, seen = scene.flow(2, 2)
    assert seen.sum() >= 0.97 * visible.sum()
    assert np.abs(none).max() < 1e-3


def test_clips_and_truth_on_disk(tmp_path: Path) -> None:
    films = write_clips(tmp_path / "a", clips=2, frames=4, size=64, seed=4, truth=True)
    again = write_clips(tmp_path / "b", clips=2, frames=4, size=64, seed=4, truth=True)
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == sorted(
        f"cat-0{k}{suffix}" for k in (0, 1) for suffix in (".mp4", ".masks.mp4", ".poses.json")
    )
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), "the same seed gives the same bytes"
    made = films[1]
    with av.open(str(tmp_path / "a" / "cat-01.masks.mp4")) as container:
        read = np.stack([f.to_ndarray(format="gray") for f in container.decode(video=0)])
    np.testing.assert_array_equal(read > 127, made.masks)
    with av.open(str(tmp_path / "a" / "cat-01.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264" and stream.average_rate == 20
        pictures = np.stack([f.to_ndarray(format="rgb24") for f in container.decode(video=0)])
    assert pictures.shape == made.images.shape
    assert np.abs(pictures.astype(int) - made.images).mean() < 8
    poses = json.loads((tmp_path / "a" / "cat-01.poses.json").read_text())
    np.testing.assert_allclose(poses["object_to_camera"], made.camera_from_object)
    np.testing.assert_allclose(again[1].camera_from_object, made.camera_from_object)
    assert not np.array_equal(films[0].images, films[1].images)
