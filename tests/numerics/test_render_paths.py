"""Cameras of films, and what is drawn of a mesh before them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stages.rendering.drawing import KINDS, Surface, correspondence_colour, draw
from stages.rendering.paths import PathError, circle, fitting_distance, look_at, parse_path, pinhole, shot_of_path

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.5
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
FACES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


def test_a_circle_keeps_the_object_in_the_middle_and_inside() -> None:
    k = pinhole(64, 48, 30.0)
    centre = np.array([0.1, 0.2, -0.3])
    points = CUBE + centre
    for pose in circle(centre, fitting_distance(points, centre, k), 20.0, 1.0, 0.0, 8):
        turn = pose[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        assert turn[1, 1] < 0, "upright: the object's y goes up, the picture's down"
        middle = k @ (turn @ centre + pose[:3, 3])
        np.testing.assert_allclose(middle[:2] / middle[2], [32, 24], atol=1e-9)
        pixel = (points @ turn.T + pose[:3, 3]) @ k.T
        pixel = pixel[:, :2] / pixel[:, 2:]
        assert (pixel > 0).all() and (pixel < [64, 48]).all()


def test_azimuth_zero_sees_the_front() -> None:
    front = circle(np.zeros(3), 4.0, 0.0, 1.0, 0.0, 4)
    place = -front[0, :3, :3].T @ front[0, :3, 3]
    np.testing.assert_allclose(place, [0, 0, 4], atol=1e-12)
    left = -front[1, :3, :3].T @ front[1, :3, 3]
    np.testing.assert_allclose(left, [4, 0, 0], atol=1e-12)


def test_straight_down_is_no_special_case() -> None:
    pose = look_at(np.array([0.0, 5.0, 0.0]), np.zeros(3))
    assert np.isfinite(pose).all() and np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


def test_a_path_passes_through_its_keys() -> None:
    text = json.dumps(
        {
            "keys": [
                {"at": 0, "azimuth": 0, "elevation": 10, "distance": 4, "fov": 30},
                {"at": 1, "azimuth": 90, "elevation": 10, "distance": 4, "fov": 50, "time": 3},
            ]
        }
    )
    shot = shot_of_path(parse_path(text), np.zeros(3), 64, 48, 10)
    assert len(shot.at_s) == 11 and shot.time_s[-1] == pytest.approx(3) and shot.time_s[5] == pytest.approx(1.5)
    for index, azimuth in ((0, 0.0), (-1, 90.0)):
        expected = circle(np.zeros(3), 4.0, 10.0, 1.0, azimuth, 1)[0]
        np.testing.assert_allclose(shot.camera_from_object[index], expected, atol=1e-9)
    assert shot.intrinsics[0, 1, 1] > shot.intrinsics[-1, 1, 1], "a wider view has a shorter focal length"


@pytest.mark.parametrize(
    ("document", "word"),
    [
        ("[", "JSON"),
        ("{}", "keys"),
        ('{"keys": [1]}', "no object"),
        ('{"keys": [{"azimut": 3}]}', "azimut"),
        ('{"keys": [{"at": 1}, {"at": 0}]}', "increasing"),
        ('{"keys": [{"at": "x"}]}', "not a number"),
        ('{"keys": [{"fov": 500}]}', "fov"),
        ('{"keys": [{"position": [0, 0]}]}', "finite numbers"),
        ('{"keys": [{"object_to_camera": [[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]}]}', "rigid"),
    ],
)
def test_a_wrong_path_is_refused_with_a_sentence(document: str, word: str) -> None:
    with pytest.raises(PathError, match=word):
        shot_of_path(parse_path(document), np.zeros(3), 64, 48, 10)


def test_each_kind_of_picture_shows_what_it_says() -> None:
    k = pinhole(64, 64, 30.0)
    pose = look_at(np.array([0.0, 0.0, 4.0]), np.zeros(3))
    camera = CUBE @ pose[:3, :3].T + pose[:3, 3]
    surface = Surface(FACES, np.tile([[0.8, 0.2, 0.1]], (8, 1)), CUBE)
    white = np.ones(3)
    shown = {kind: draw(surface, camera, k, (64, 64), kind, white, (3.0, 5.0)) for kind in KINDS}
    centre, corner = (32, 32), (2, 2)
    for kind, picture in shown.items():
        assert picture.shape == (64, 64, 4) and picture[centre][3] == 255 and picture[corner][3] == 0, kind
    assert (shown["silhouette"][centre][:3] == 255).all() and (shown["silhouette"][corner][:3] == 0).all()
    # The front face stands at depth 3.5: a quarter of the way from near (bright) to far.
    assert shown["depth"][centre][0] == pytest.approx(255 * (1 - 0.9 * 0.25), abs=3)
    red, green, _ = shown["colour"][centre][:3].astype(int)
    assert red > 2 * green and (shown["colour"][corner][:3] == 255).all()
    expected = 255 * correspondence_colour(CUBE)[[1, 3, 5, 7]].mean(axis=0)
    found = shown["correspondence"][centre][:3].astype(float)
    assert np.abs(found - expected).max() < 40
    turned = draw(surface, camera, k, (64, 64), "normals", white)
    assert turned[centre][2] > 127, "a surface seen faces the camera"
