"""Rotations, rigid transforms and pinhole cameras against scipy, closed forms and slow loops."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from stages.geometry.cameras import pixel_directions, project, ray_box, transform
from stages.geometry.rotations import (
    geodesic_angle,
    interpolate_rigid,
    invert_rigid,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rigid,
    skew,
    so3_exp,
    so3_log,
)

ANGLES = [0.0, 1e-9, 1e-6, 5e-4, 1.1e-3, 0.02, 1.0, 2.0, 3.0, math.pi - 1e-3, math.pi - 1e-7]


def axes(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)


def random_rigid(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed + 100)
    vectors = axes(count, seed) * torch.rand(count, 1, generator=generator, dtype=torch.float64) * 3
    return rigid(so3_exp(vectors), torch.randn(count, 3, generator=generator, dtype=torch.float64))


# ---------------------------------------------------------------------------------------------- rotations


def test_skew_is_the_cross_product() -> None:
    a, b = axes(5, 1), axes(5, 2)
    assert torch.allclose((skew(a) @ b[..., None]).squeeze(-1), torch.linalg.cross(a, b))


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_exp_agrees_with_scipy(angle: float) -> None:
    vectors = axes(6) * angle
    expected = Rotation.from_rotvec(vectors.numpy()).as_matrix()
    assert np.abs(so3_exp(vectors).numpy() - expected).max() < 1e-12
    single = so3_exp(vectors.float()).numpy()
    assert np.abs(single - expected).max() < 1e-6


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_log_undoes_exp(angle: float) -> None:
    vectors = axes(6) * angle
    assert torch.allclose(so3_log(so3_exp(vectors)), vectors, atol=1e-7)


def test_so3_log_of_a_half_turn_is_pi_about_the_axis() -> None:
    for axis in torch.eye(3, dtype=torch.float64):
        half_turn = 2 * torch.outer(axis, axis) - torch.eye(3, dtype=torch.float64)
        vector = so3_log(half_turn)
        assert torch.allclose(vector.abs(), math.pi * axis, atol=1e-12)


def test_so3_exp_and_log_have_finite_gradients_at_rest() -> None:
    vector = torch.zeros(1, 3, requires_grad=True)
    (so3_exp(vector) * torch.arange(9.0).reshape(3, 3)).sum().backward()
    # d/dv <A, I + skew(v)> = (A21 - A12, A02 - A20, A10 - A01)
    assert torch.allclose(vector.grad, torch.tensor([[2.0, -4.0, 2.0]]))
    rotation = torch.eye(3)[None].clone().requires_grad_()
    so3_log(rotation).sum().backward()
    assert torch.isfinite(rotation.grad).all()


def test_so3_exp_gradient_is_the_finite_difference() -> None:
    vectors = torch.cat([axes(3) * 1e-4, axes(3) * 0.7]).requires_grad_()
    assert torch.autograd.gradcheck(so3_exp, vectors, eps=1e-6, atol=1e-6)


def test_quaternions_round_trip_with_every_form() -> None:
    """Each of the four numerically distinct branches (w, x, y or z largest) is the best for some rotation."""
    quaternions = torch.tensor(Rotation.random(200, random_state=0).as_quat()[:, [3, 0, 1, 2]])
    assert len(set(quaternions.abs().argmax(1).tolist())) == 4
    matrices = quaternion_to_matrix(quaternions)
    assert torch.allclose(matrices, torch.tensor(Rotation.random(200, random_state=0).as_matrix()))
    back = matrix_to_quaternion(matrices)
    assert (back[:, 0] >= 0).all()
    assert torch.allclose(back, quaternions * torch.sign(quaternions[:, :1]), atol=1e-12)


def test_quaternion_length_does_not_matter() -> None:
    quaternions = torch.randn(4, 4, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(quaternion_to_matrix(quaternions), quaternion_to_matrix(7 * quaternions), atol=1e-6)
    assert torch.allclose(quaternion_to_matrix(quaternions), quaternion_to_matrix(-quaternions), atol=1e-6)


@given(st.floats(0, math.pi), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_geodesic_angle_is_the_angle_of_the_relative_turn(angle: float, seed: int) -> None:
    start = so3_exp(axes(1, seed) * 1.3)
    turned = start @ so3_exp(axes(1, seed + 1) * angle)
    assert float(geodesic_angle(start, turned)) == pytest.approx(angle, abs=1e-6)
    assert float(geodesic_angle(turned, start)) == pytest.approx(angle, abs=1e-6)


def test_rigid_inverse_undoes() -> None:
    transforms = random_rigid(7)
    product = invert_rigid(transforms) @ transforms
    assert torch.allclose(product, torch.eye(4, dtype=torch.float64).expand(7, 4, 4), atol=1e-12)


def test_interpolation_is_slerp_between_and_constant_beyond() -> None:
    track, times = random_rigid(4, 5), torch.tensor([0.0, 0.1, 0.5, 2.0], dtype=torch.float64)
    at = torch.tensor([-1.0, 0.0, 0.03, 0.1, 0.4, 1.7, 2.0, 9.0], dtype=torch.float64)
    found = interpolate_rigid(track, times, at)
    inside = at.clamp(0, 2).numpy()
    expected = Slerp(times.numpy(), Rotation.from_matrix(track[:, :3, :3].numpy()))(inside).as_matrix()
    assert np.abs(found[:, :3, :3].numpy() - expected).max() < 1e-9
    for k in range(3):
        assert np.allclose(found[:, k, 3].numpy(), np.interp(inside, times.numpy(), track[:, k, 3].numpy()))
    assert torch.equal(interpolate_rigid(track[:1], times[:1], at), track[:1].expand(8, 4, 4))


# ---------------------------------------------------------------------------------------------- cameras

K = torch.tensor([[50.0, 0, 31], [0, 55.0, 17], [0, 0, 1]], dtype=torch.float64)


def test_transform_is_the_loop_over_points() -> None:
    transforms, points = random_rigid(2, 9), torch.randn(2, 5, 3, dtype=torch.float64)
    found = transform(transforms, points)
    for f in range(2):
        for n in range(5):
            expected = transforms[f] @ torch.cat([points[f, n], torch.ones(1, dtype=torch.float64)])
            assert torch.allclose(found[f, n], expected[:3])


def test_projection_is_the_pinhole_and_rays_undo_it() -> None:
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(20, 3, generator=generator, dtype=torch.float64) * 2 - 1 + torch.tensor([0, 0, 3.0])
    homogeneous = points @ K.T
    pixels = project(K, points)
    assert torch.allclose(pixels, homogeneous[:, :2] / homogeneous[:, 2:])
    directions = pixel_directions(K, pixels)
    assert torch.equal(directions[:, 2], torch.ones(20, dtype=torch.float64))
    assert torch.allclose(directions * points[:, 2:], points)


def test_points_behind_the_camera_give_finite_far_pixels() -> None:
    pixels = project(K, torch.tensor([[0.5, -0.5, -2.0], [0.5, 0.5, 0.0]], dtype=torch.float64))
    assert torch.isfinite(pixels).all()
    assert (pixels - K[:2, 2]).abs().min() > 1e3


def test_ray_box_agrees_with_stepping_along_the_ray() -> None:
    generator = torch.Generator().manual_seed(3)
    low, high = torch.tensor([-0.5, -0.3, -0.8]), torch.tensor([0.4, 0.6, 0.2])
    origins = torch.tensor([[0.3, -0.2, -3.0]]).expand(300, 3)
    directions = torch.cat([torch.rand(300, 2, generator=generator) * 1.2 - 0.7, torch.ones(300, 1)], 1)
    near, far, hit = ray_box(origins, directions, low, high)
    depths = torch.linspace(0, 6, 6001)
    along = origins[:, None] + depths[:, None] * directions[:, None]
    inside = ((along >= low) & (along <= high)).all(-1)
    sure = inside.sum(1) > 5
    assert 20 < int(hit.sum()) < 280
    assert hit[sure].all() and int((hit & ~inside.any(1)).sum()) <= 2  # those only graze an edge
    for ray in torch.nonzero(sure)[:, 0]:
        seen = depths[inside[ray]]
        assert float(near[ray]) == pytest.approx(float(seen[0]), abs=2e-3)
        assert float(far[ray]) == pytest.approx(float(seen[-1]), abs=2e-3)


def test_a_ray_that_misses_still_gets_an_interval_about_its_closest_approach() -> None:
    low, high = torch.full((3,), -0.5), torch.full((3,), 0.5)
    directions = torch.tensor([[1.0, 0.2, 1.0], [0.0, -2.0, 1.0], [-1.5, 0.0, 1.0]])
    origins = torch.tensor([[0.0, 0, -3]]).expand(3, 3)
    near, far, hit = ray_box(origins, directions, low, high)
    assert not hit.any()
    depths = torch.linspace(0, 4, 40001)
    distance = (origins[:, None] + depths[:, None] * directions[:, None]).norm(dim=-1)
    closest = depths[distance.argmin(1)]
    assert torch.allclose((near + far) / 2, closest, atol=1e-3)
    assert torch.allclose((far - near) * directions.norm(dim=-1), torch.full((3,), math.sqrt(3) / 2), atol=1e-4)


def test_ray_box_from_within_and_behind() -> None:
    low, high = torch.full((3,), -0.5), torch.full((3,), 0.5)
    forward = torch.tensor([0.0, 0, 1])
    near, far, hit = ray_box(torch.zeros(3), forward, low, high)
    assert bool(hit) and 0 < float(near) < 0.01 and float(far) == pytest.approx(0.5)
    near, far, hit = ray_box(torch.tensor([0.0, 0, 3]), forward, low, high)
    assert not bool(hit) and 0 < float(near) < float(far)
