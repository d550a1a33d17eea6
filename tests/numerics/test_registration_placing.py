"""registration: given poses, angles, boxes, depth, windows, tracking: closed forms and slow loops."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stages.registration import given as given_poses
from stages.registration.cues import crop_embedding, inflate, principal_directions, square_crop
from stages.registration.given import PoseDocumentError, parse_intrinsics, parse_transforms, scale_intrinsics
from stages.registration.placing import (
    default_intrinsics,
    depth_from_size,
    fill_gaps,
    mask_boxes,
    place,
    ray_rotation,
    smooth,
    view_angles,
    view_rotation,
)
from stages.registration.tracking import azimuth_steps, elevation_step, forward_backward, posterior_angles
from stages.registration.volume import EXTENT, ViewBank, pixel_axis
from stages.registration.windows import difference

ANGLE = st.floats(-3.1, 3.1)


def rigid(count: int) -> np.ndarray:
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = view_rotation(np.linspace(0, 1, count), np.full(count, 0.2))
    out[:, 2, 3] = 3.0
    return out


# ------------------------------------------------------------------------------------------ given poses


@pytest.mark.parametrize(
    "document",
    [
        {"K": [[300, 0, 128], [0, 310, 120], [0, 0, 1]]},
        {"intrinsics": {"fx": 300, "fy": 310, "cx": 128, "cy": 120}},
        {"intrinsics": [300, 310, 128, 120]},
    ],
)
def test_intrinsics_in_every_form(document: dict[str, object]) -> None:
    assert parse_intrinsics(document).tolist() == [[300, 0, 128], [0, 310, 120], [0, 0, 1]]


@pytest.mark.parametrize(
    ("document", "says"),
    [
        ({}, "neither K nor intrinsics"),
        ({"K": [[1, 2], [3, 4]]}, "shape"),
        ({"K": "wide"}, "not numbers"),
        ({"intrinsics": {"fx": 1}}, "not numbers"),
        ({"K": [[float("nan"), 0, 1], [0, 1, 1], [0, 0, 1]]}, "not finite"),
        ({"K": [[-300, 0, 128], [0, 300, 128], [0, 0, 1]]}, "pinhole"),
        ({"K": [[300, 0, 128], [0, 300, 128], [0, 1, 1]]}, "pinhole"),
    ],
)
def test_bad_intrinsics_are_refused(document: dict[str, object], says: str) -> None:
    with pytest.raises(PoseDocumentError, match=says):
        parse_intrinsics(document)


def test_bad_transforms_are_refused() -> None:
    good = rigid(4)

    def refused(value: object, says: str) -> None:
        with pytest.raises(PoseDocumentError, match=says):
            parse_transforms({"object_to_camera": value}, 4)

    with pytest.raises(PoseDocumentError, match="no object_to_camera"):
        parse_transforms({}, 4)
    refused(good[:3].tolist(), "has 3 poses, but the video has 4 frames")
    refused(good[:, :3].tolist(), "shape")
    refused([["a"]], "not a list of 4x4")
    for row, change, says in (
        (2, np.nan, "frame 2 is not finite"),
        (1, 2.0, "frame 1 is not a rigid"),
    ):
        bad = good.copy()
        bad[row, 0, 0] = change
        refused(bad.tolist(), says)
    mirrored = good.copy()
    mirrored[3, :3, 0] *= -1
    refused(mirrored.tolist(), "frame 3 is not a rigid")
    behind = good.copy()
    behind[0, 2, 3] = -3
    refused(behind.tolist(), "behind the camera")


def test_rounded_rotations_are_made_exact() -> None:
    rounded = np.round(rigid(5), 4)
    exact = parse_transforms({"object_to_camera": rounded.tolist()}, 5)
    product = exact[:, :3, :3] @ exact[:, :3, :3].transpose(0, 2, 1)
    assert np.abs(product - np.eye(3)).max() < 1e-12
    assert np.abs(exact - rounded).max() < 2e-4
    assert given_poses.parse_transforms({"object_to_camera": rigid(2).tolist()}, 2) == pytest.approx(rigid(2))


def test_resizing_the_picture_keeps_what_it_shows() -> None:
    full = default_intrinsics(640, 480, 500.0)
    point = np.array([0.3, -0.2, 2.5])
    before, after = full @ point, scale_intrinsics(full, 0.5, 0.25) @ point
    assert after[:2] / after[2] == pytest.approx(before[:2] / before[2] * [0.5, 0.25])


# ------------------------------------------------------------------------------------------ angles and places


@given(ANGLE, st.floats(-1.4, 1.4), ANGLE)
def test_angles_come_back_from_the_rotation(azimuth: float, elevation: float, roll: float) -> None:
    rotation = view_rotation(np.array([azimuth]), np.array([elevation]), np.array([roll]))
    assert np.abs(rotation[0] @ rotation[0].T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(rotation[0]) == pytest.approx(1)
    back = [float(a[0]) for a in view_angles(rotation)]
    assert np.exp(1j * np.array(back)) == pytest.approx(np.exp(1j * np.array([azimuth, elevation, roll])), abs=1e-6)


def test_azimuth_zero_looks_at_the_front() -> None:
    rotation = view_rotation(np.array(0.0), np.array(0.0))
    # from the front the object's left (x) is on the right of the picture, up is up, its front points at the camera
    assert rotation == pytest.approx(np.diag([1.0, -1.0, -1.0]))
    quarter = view_rotation(np.array(np.pi / 2), np.array(0.0))
    assert quarter @ np.array([1.0, 0, 0]) == pytest.approx(np.array([0, 0, -1.0]), abs=1e-12)  # its left is near


def test_the_turned_axis_meets_the_pixel() -> None:
    intrinsics = default_intrinsics(200, 100, 150.0)
    pixels = np.array([[30.0, 80.0], [100.0, 50.0], [190.0, 5.0]])
    turn = ray_rotation(pixels, intrinsics)
    seen = turn @ np.array([0, 0, 1.0]) @ intrinsics.T
    assert seen[:, :2] / seen[:, 2:] == pytest.approx(pixels)
    assert turn @ turn.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (3, 1, 1)))
    depth = np.array([2.0, 3.0, 4.0])
    origin = place(pixels, depth, intrinsics)
    assert origin[:, 2] == pytest.approx(depth)
    assert (origin @ intrinsics.T)[:, :2] / origin[:, 2:] == pytest.approx(pixels)


def test_boxes_ignore_specks_and_fill_missing_frames() -> None:
    masks = np.zeros((3, 60, 80), np.uint8)
    masks[0, 20:40, 10:50] = 255
    masks[0, 2, 70] = 255  # a speck
    masks[2, 30:50, 20:60] = 255
    boxes, known = mask_boxes(masks)
    assert known.tolist() == [True, False, True]
    assert boxes[0] == pytest.approx([10, 20, 50, 40])
    assert boxes[1] == pytest.approx((boxes[0] + boxes[2]) / 2)


def test_depth_of_a_bar_of_known_length() -> None:
    intrinsics = default_intrinsics(300, 300, 400.0)
    for depth in (2.0, 3.0, 5.0):
        width = 400.0 * 2.0 / depth
        box = np.array([[150 - width / 2, 140, 150 + width / 2, 160]])
        assert depth_from_size(box, intrinsics) == pytest.approx([depth])


def test_smoothing_keeps_straight_lines_and_removes_noise() -> None:
    line = np.linspace(-3, 5, 40)[:, None] * [1.0, -2.0]
    assert smooth(line, 3.0) == pytest.approx(line)
    noise = np.random.default_rng(0).normal(size=(400, 1))
    assert smooth(noise, 4.0).std() < 0.4 * noise.std()
    assert smooth(line[:2], 3.0) == pytest.approx(line[:2])
    assert fill_gaps(line, np.zeros(40, bool)) == pytest.approx(line)


# ------------------------------------------------------------------------------------------ cues


def test_a_disc_inflates_to_a_ball() -> None:
    size, radius = 64, 20.0
    axis = np.arange(size) + 0.5 - size / 2
    distance2 = axis[None] ** 2 + axis[:, None] ** 2
    height = inflate((distance2 < radius**2)[None].astype(np.float32))[0]
    ball = np.sqrt(np.maximum(radius**2 - distance2, 0)) * np.sqrt(3 / 4)
    assert np.abs(height - ball)[distance2 < (radius - 3) ** 2].max() < 0.08 * radius
    assert height[distance2 > (radius + 1) ** 2].max() == 0


def test_crops_keep_places_and_means() -> None:
    row, column = np.mgrid[:90, :120] + 0.5
    crop = square_crop(column + 1000 * row, np.array([50.0, 40.0]), 24.0, 12)
    middle = 4.0 * (np.arange(12) + 0.5) - 24
    assert crop == pytest.approx((50 + middle)[None] + 1000 * (40 + middle)[:, None], abs=0.5)


def test_embeddings_are_cut_where_the_picture_is() -> None:
    cells, box = 28, np.array([20.0, 10.0, 76.0, 66.0])  # two pixels a cell
    middle = (np.arange(cells) + 0.5) * 2
    place = np.stack(np.broadcast_arrays((20 + middle)[None], (10 + middle)[:, None], 1.0), -1)
    place[:, 20:] = 0  # off the object
    basis = np.eye(3)[:, :2]
    crop = crop_embedding(place, box, basis, np.array([40.0, 36.0]), 12.0, 12)
    x = 40 + 2.0 * (np.arange(12) + 0.5) - 12
    on = x < 58
    assert crop[:, on, 0] == pytest.approx(np.broadcast_to(x[on], (12, on.sum())), abs=0.3)
    assert crop[:, on, 1] == pytest.approx(np.broadcast_to((x - 4)[:, None], (12, on.sum())), abs=0.3)
    outside = crop_embedding(place, box, basis, np.array([70.0, 36.0]), 6.0, 12)
    assert not outside[:, 2:].any()


def test_principal_directions_are_the_ones_put_in() -> None:
    random = np.random.default_rng(0)
    axes = np.linalg.qr(random.normal(size=(5, 5)))[0]
    samples = random.normal(size=(4000, 5)) * [5, 3, 0.1, 0.1, 0.1] @ axes.T + 7
    found = principal_directions(samples, 2)
    assert np.abs((found * axes[:, :2]).sum(0)) == pytest.approx(np.ones(2), abs=0.01)
    assert found == pytest.approx(principal_directions(samples[::-1], 2))  # signs and all


# ------------------------------------------------------------------------------------------ tracking, windows, views


def test_forward_backward_against_every_path() -> None:
    random = np.random.default_rng(1)
    azimuth, elevation = np.arange(4) * np.pi / 2, np.array([0.0, 0.3])
    count = 4
    log_likelihood = random.normal(size=(count, 4, 2))
    start = random.random((4, 2))
    start /= start.sum()
    steps = azimuth_steps(azimuth, random.normal(size=count - 1), 0.8)
    tilt = elevation_step(elevation, 0.2)
    assert steps.sum(-1) == pytest.approx(np.ones((count - 1, 4)))
    posterior, evidence = forward_backward(log_likelihood, start, steps, tilt)
    states = list(itertools.product(range(4), range(2)))
    total, expected = 0.0, np.zeros_like(posterior)
    for path in itertools.product(states, repeat=count):
        chance = start[path[0]] * np.exp(log_likelihood[0][path[0]])
        for t in range(1, count):
            (a, e), (b, f) = path[t - 1], path[t]
            chance *= steps[t - 1][a, b] * tilt[e, f] * np.exp(log_likelihood[t][b, f])
        total += chance
        for t in range(count):
            expected[t][path[t]] += chance
    assert evidence == pytest.approx(np.log(total))
    assert posterior == pytest.approx(expected / total)


def test_steps_follow_the_drift_round_the_circle() -> None:
    azimuth = np.arange(36) * 2 * np.pi / 36
    steps = azimuth_steps(azimuth, np.array([np.radians(20.0)]), 0.05)
    assert int(steps[0][35].argmax()) == 1
    posterior = steps[0][[35]][:, :, None]
    mean, tilt, sharp = posterior_angles(posterior, azimuth, np.array([0.4]))
    assert np.degrees(mean[0]) == pytest.approx(10.0, abs=0.5)
    assert tilt[0] == pytest.approx(0.4)
    assert 0.95 < sharp[0] <= 1


def test_difference_against_a_slow_loop() -> None:
    random = torch.Generator().manual_seed(0)

    def pictures(count: int) -> tuple[torch.Tensor, torch.Tensor]:
        mask = torch.rand(count, 6, 6, generator=random) * 0.9 + 0.1
        return mask, torch.randn(count, 3, 6, 6, generator=random)

    (mask, colour), (opacity, shown) = pictures(3), pictures(2)
    frames = torch.cat([mask[:, None], colour * mask[:, None]], 1)
    views = torch.cat([opacity[:, None], shown * opacity[:, None]], 1)
    found = difference(frames, views, 0.7)
    for t, p in itertools.product(range(3), range(2)):
        outline = ((mask[t] - opacity[p]) ** 2).sum()
        inside = (mask[t] * opacity[p] * ((colour[t] - shown[p]) ** 2).sum(0)).sum()
        assert found[t, p].item() == pytest.approx(((outline + 0.7 * inside) / mask[t].sum()).item(), rel=1e-4)


def test_a_ball_looks_as_big_as_perspective_says_and_keeps_its_colours_in_place() -> None:
    voxels, radius = 40, 0.7
    axis = pixel_axis(voxels) * EXTENT
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    ball = ((x**2 + y**2 + z**2).sqrt() < radius).float()
    colour = torch.stack([(x > 0).float(), (z > 0).float()])
    bank = ViewBank(np.array([0.0, np.pi / 2]), np.array([0.0]), 40)
    picture = bank.render(ball, colour)
    visible = radius / np.sqrt(1 - (radius / 3.0) ** 2)  # tangent cone of a ball at depth 3
    area = picture.opacity.sum((1, 2)) * (2 * EXTENT / 40) ** 2
    assert area.tolist() == pytest.approx([np.pi * visible**2] * 2, rel=0.06)
    right = picture.colour[:, :, :, 20:].sum((2, 3)) / picture.opacity[:, :, 20:].sum((1, 2))[:, None]
    assert right[0, 0] > 0.9  # from the front the object's left (x > 0) is on the right
    assert right[1, 1] < 0.1  # from its left the front (z > 0) is on the left
    assert picture.relief[0, 20, 20].item() == pytest.approx(radius, abs=0.12)
