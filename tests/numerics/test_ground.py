"""The ground's plane under a moving camera: elevation and focal length come out of it, or nothing does."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stages.registration.ground import PlaneView, ground_elevations, plane_views

COUNT, FOCAL = 40, 1.3


def _camera(elevation: float, bearing: float, height: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """World (y up) to camera (x right, y down, z forward) of a camera above a point 3 units ahead of where it looks."""
    cos, sin = np.cos(bearing), np.sin(bearing)
    turn = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    level = np.diag([1.0, -1.0, -1.0]) @ turn
    cos, sin = np.cos(elevation), np.sin(elevation)
    rotation = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ level
    centre = turn.T @ np.array([0.0, height, 3.0])
    return rotation, -rotation @ centre


def _homography(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Of the plane y = 0, from the first picture to the second, coordinates over the longer side."""
    camera = np.diag([FOCAL, FOCAL, 1.0])
    (r1, t1), (r2, t2) = first, second
    one, two = (camera @ np.stack([r[:, 0], r[:, 2], t], axis=1) for r, t in ((r1, t1), (r2, t2)))
    return two @ np.linalg.inv(one)


def _path(elevation: float, wobble: float = 0.0) -> list[tuple[np.ndarray, np.ndarray]]:
    return [_camera(elevation + wobble * np.sin(t / 10), 0.03 * t, 1.0 + 0.05 * np.sin(t / 9)) for t in range(COUNT)]


def _views(path: list[tuple[np.ndarray, np.ndarray]], noise: float = 0.0) -> list[PlaneView]:
    rng = np.random.default_rng(0)
    views = []
    for t in range(0, COUNT - 8, 3):
        for step in (8, 14, 20):
            if t + step < COUNT:
                exact = _homography(path[t], path[t + step])
                views.append(PlaneView(t, exact / exact[2, 2] + noise * rng.normal(size=(3, 3))))
    return views


@pytest.mark.parametrize("known", [None, FOCAL])
def test_elevation_and_focal_length_of_exact_homographies(known: float | None) -> None:
    truth = [np.radians(12.0), np.radians(25.0)]
    clips = [_views(_path(e)) for e in truth]
    found, focal = ground_elevations(clips, [COUNT, COUNT], known)
    assert focal == pytest.approx(FOCAL, rel=0.05)
    for elevation, path in zip(truth, found, strict=True):
        assert path is not None and path.shape == (COUNT,)
        np.testing.assert_allclose(path, elevation, atol=np.radians(1.5))


def test_a_camera_that_nods_is_followed() -> None:
    wobble = np.radians(4.0)
    (found,), _ = ground_elevations([_views(_path(np.radians(20.0), wobble), noise=1e-4)], [COUNT])
    assert found is not None
    truth = np.radians(20.0) + wobble * np.sin(np.arange(COUNT) / 10)
    assert np.abs(found - truth)[4:-8].mean() < np.radians(1.8)


def test_what_is_no_plane_tells_nothing() -> None:
    rng = np.random.default_rng(1)
    wild = [PlaneView(t, np.eye(3) + 0.1 * rng.normal(size=(3, 3))) for t in range(0, COUNT, 2)]
    assert ground_elevations([wild], [COUNT])[0] == [None]
    still = [PlaneView(t, np.eye(3)) for t in range(0, COUNT, 2)]  # nor does a camera that stands still, or only turns
    camera = np.diag([FOCAL, FOCAL, 1.0])
    turns = [cv2.Rodrigues(np.array([0.0, 0.01 * t, 0.0]))[0] for t in range(COUNT)]
    turning = [PlaneView(t, camera @ turns[t] @ np.linalg.inv(camera)) for t in range(0, COUNT, 2)]
    for views in (still, turning):
        assert ground_elevations([views], [COUNT])[0] == [None]
        assert ground_elevations([views], [COUNT], FOCAL)[0] == [None]
    assert ground_elevations([[], _views(_path(0.3))[:4]], [COUNT, COUNT]) == ([None, None], 0.0)


def test_one_bad_clip_does_not_spoil_the_others() -> None:
    rng = np.random.default_rng(2)
    wild = [PlaneView(t, np.eye(3) + 0.1 * rng.normal(size=(3, 3))) for t in range(0, COUNT, 2)]
    good = _views(_path(np.radians(18.0)))
    found, _ = ground_elevations([good, wild, good], [COUNT] * 3, FOCAL)
    assert found[1] is None
    for path in (found[0], found[2]):
        assert path is not None
        np.testing.assert_allclose(path, np.radians(18.0), atol=np.radians(1.0))


def test_pictures_of_a_patterned_floor() -> None:
    """From pictures: a floor around an object whose mask is left out, as a camera goes around it."""
    rng = np.random.default_rng(3)
    side = 256
    floor = cv2.GaussianBlur(rng.normal(0, 1, (900, 900)), (0, 0), 3.0)
    floor = np.clip(128 + 60 * floor / floor.std(), 0, 255).astype(np.uint8)
    camera = np.array([[FOCAL * side, 0, side / 2], [0, FOCAL * side, side / 2], [0, 0, 1]])
    to_floor = np.array([[8 / 900, 0, -4.0], [0, 8 / 900, -4.0], [0, 0, 1]])  # floor pixels to the plane's x and z
    elevation = np.radians(22.0)
    pictures, mask = [], np.zeros((side, side), np.uint8)
    mask[90:150, 110:146] = 255
    for rotation, shift in _path(elevation):
        onto = camera @ np.stack([rotation[:, 0], rotation[:, 2], shift], axis=1) @ to_floor
        picture = np.repeat(cv2.warpPerspective(floor, onto, (side, side))[..., None], 3, 2)
        picture[mask > 0] = 250
        pictures.append(picture)
    views = plane_views(COUNT, lambda t: (pictures[t], mask))
    (found,), _ = ground_elevations([views], [COUNT], FOCAL)
    assert found is not None
    assert np.abs(found - elevation).mean() < np.radians(2.5)


def test_a_clip_without_an_object_has_no_views() -> None:
    empty = np.zeros((64, 64), np.uint8)
    assert plane_views(30, lambda t: (np.zeros((64, 64, 3), np.uint8), empty)) == []
