"""Codes in time, bone and root motion: closed forms, explicit products, joints that hold."""

from __future__ import annotations

import math

import pytest
import torch

from stages.geometry.cameras import transform
from stages.geometry.rotations import rigid, so3_exp
from stages.model.motion import (
    BodyPose,
    FourierCode,
    MotionHead,
    RootPose,
    chain,
    fourier_basis,
    octaves_for,
    spline_basis,
    splines_for,
)

CENTRES = torch.tensor([[0.0, 0, 0], [0.4, 0, 0], [0.8, 0.1, 0], [0.0, 0.5, 0]])
PARENTS = torch.tensor([0, 0, 1, 0])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def set_motion(head: MotionHead, motion: torch.Tensor) -> None:
    """Make `head` answer `motion` (count, 6) whatever the code is."""
    with torch.no_grad():
        head.out.weight.zero_()
        scale = torch.tensor([1.0] * 3 + [head.translation_scale] * 3)
        head.out.bias.copy_((motion / scale).reshape(-1))


def test_fourier_basis_term_by_term() -> None:
    times = torch.tensor([-1.0, -0.3, 0.0, 0.7], dtype=torch.float64)
    basis = fourier_basis(times, 3)
    for i, t in enumerate(times.tolist()):
        expected = [1.0, t]
        expected += [math.sin(2**k * math.pi * t) for k in range(3)]
        expected += [math.cos(2**k * math.pi * t) for k in range(3)]
        assert basis[i].tolist() == pytest.approx(expected, abs=1e-12)


def test_fourier_code_is_the_product_of_the_videos_own_matrix() -> None:
    code = FourierCode(2, 5, 3, seeded())
    times, videos = torch.tensor([-0.5, 0.1, 0.9]), torch.tensor([0, 1, 0])
    found = code(videos, times)
    for n in range(3):
        expected = fourier_basis(times[n : n + 1], 3)[0] @ code.coefficients[videos[n]]
        assert torch.allclose(found[n], expected, atol=1e-6)
    assert torch.equal(code.coefficients, FourierCode(2, 5, 3, seeded()).coefficients)
    assert not torch.equal(code.coefficients, FourierCode(2, 5, 3, seeded(1)).coefficients)


def test_higher_octaves_begin_smaller() -> None:
    size = FourierCode(1, 4000, 5, seeded()).coefficients[0].std(1)
    sines, cosines = size[2:7], size[7:]
    assert (sines[1:] < sines[:-1]).all() and (cosines[1:] < cosines[:-1]).all()


@pytest.mark.parametrize("duration_s", [0.5, 2.0, 8.0, 40.0])
def test_octaves_reach_the_shortest_period(duration_s: float) -> None:
    shortest = 0.25
    count = octaves_for(duration_s, shortest)
    period = duration_s / 2 ** (count - 1)  # t runs over 2, sin(2^k pi t) has period 2^(1-k)
    assert 2 <= count <= 10
    assert count == 2 or shortest / 1.5 < period < shortest * 1.5
    assert octaves_for(0.0, shortest) == 2 and octaves_for(1e9, shortest) == 10


def test_chain_is_the_product_down_from_the_root() -> None:
    generator = seeded(3)
    parents = torch.tensor([0, 0, 1, 0, 2, 2])
    local = rigid(so3_exp(torch.randn(3, 6, 3, generator=generator)), torch.randn(3, 6, 3, generator=generator))
    found = chain(local, parents)
    for bone in range(6):
        expected, node = local[:, bone], bone
        while node != int(parents[node]):
            node = int(parents[node])
            expected = local[:, node] @ expected
        assert torch.allclose(found[:, bone], expected, atol=1e-5)


def test_head_begins_near_rest() -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        body = BodyPose(1, 4, 3, 8, 16, seeded())
    transforms, own, code = body(torch.zeros(3, dtype=torch.int64), torch.tensor([-1.0, 0, 1]), CENTRES, PARENTS)
    assert transforms.shape == (3, 4, 4, 4) and own.shape == (3, 4, 6) and code.shape == (3, 8)
    assert float((transforms - torch.eye(4)).abs().max().detach()) < 0.1
    assert float(own.abs().max().detach()) < 0.05


def test_a_bone_turns_about_the_joint_with_its_parent() -> None:
    body = BodyPose(1, 4, 3, 8, 16, seeded())
    motion = torch.zeros(4, 6)
    motion[1, :3] = torch.tensor([0.2, -0.5, 0.9])
    set_motion(body.head, motion)
    transforms, own, _ = body(torch.zeros(1, dtype=torch.int64), torch.zeros(1), CENTRES, PARENTS)
    assert torch.allclose(own[0], motion, atol=1e-6)
    joint = (CENTRES[0] + CENTRES[1]) / 2
    assert torch.allclose(transform(transforms[0, 1], joint[None])[0], joint, atol=1e-6)
    assert torch.allclose(transforms[0, 1, :3, :3], so3_exp(motion[1, :3]), atol=1e-6)
    # its child comes along, others stay
    assert torch.allclose(transforms[0, 2], transforms[0, 1], atol=1e-6)
    for still in (0, 3):
        assert torch.allclose(transforms[0, still], torch.eye(4), atol=1e-6)


def test_joints_hold_along_the_tree_and_a_shift_moves_them_by_itself() -> None:
    body = BodyPose(1, 4, 3, 8, 16, seeded())
    motion = torch.randn(4, 6, generator=seeded(4))
    motion[:, 3:] = 0
    set_motion(body.head, motion)
    here = torch.zeros(1, dtype=torch.int64), torch.zeros(1), CENTRES, PARENTS
    transforms = body(*here)[0][0]
    for bone in range(1, 4):
        joint = ((CENTRES[bone] + CENTRES[PARENTS[bone]]) / 2)[None]
        with_parent = transform(transforms[PARENTS[bone]], joint)
        assert torch.allclose(transform(transforms[bone], joint), with_parent, atol=1e-5)
    motion[2, 3:] = torch.tensor([0.1, 0.0, -0.2])
    set_motion(body.head, motion)
    shifted = body(*here)[0][0]
    joint = ((CENTRES[2] + CENTRES[1]) / 2)[None]
    slip = transform(shifted[2], joint) - transform(shifted[1], joint)
    assert float(slip.norm().detach()) == pytest.approx(math.hypot(0.1, 0.2), rel=1e-4)


def test_root_correction_turns_the_object_where_it_stands() -> None:
    """G = MLP_G(omega_r) G_0 with the turn about the object's own origin: the origin moves by the shift alone."""
    root = RootPose(1, 3, 8, 16, seeded())
    motion = torch.tensor([[0.3, -0.2, 0.6, 0.05, -0.1, 0.2]])
    set_motion(root.head, motion)
    base = rigid(so3_exp(torch.tensor([[0.1, 2.0, 0.3]])), torch.tensor([[0.2, -0.1, 3.0]]))
    video, time = torch.zeros(1, dtype=torch.int64), torch.tensor([0.4])
    found = root(video, time, base, torch.ones(1))[0]
    assert torch.allclose(found[:3, :3], so3_exp(motion[0, :3]) @ base[0, :3, :3], atol=1e-6)
    assert torch.allclose(found[:3, 3], base[0, :3, 3] + motion[0, 3:], atol=1e-6)
    half = root(video, time, base, torch.full((1,), 0.5))[0]
    assert torch.allclose(half[:3, :3], so3_exp(0.5 * motion[0, :3]) @ base[0, :3, :3], atol=1e-6)
    assert torch.equal(root(video, time, base, torch.zeros(1)), base)


def test_splines_sum_to_one_and_live_for_a_moment() -> None:
    time = torch.linspace(-1, 1, 201)
    basis = spline_basis(time, 11)
    assert torch.allclose(basis.sum(1), torch.ones(201), atol=1e-5)
    spacing = 2 / 8
    for k in range(11):
        alive = time[basis[:, k] > 1e-7]
        assert float(alive.max() - alive.min()) < 4 * spacing
    assert splines_for(3.7, 0.1) == 40 and splines_for(3.7, 0.0) == 0 and splines_for(0.01, 1.0) == 4


def test_splines_follow_what_octaves_cannot() -> None:
    """A wave between two octaves, by least squares."""
    time = torch.linspace(-1, 1, 75)
    wave = torch.sin(11 * math.pi * time)
    code = FourierCode(1, 2, 5, torch.Generator().manual_seed(0), splines=40)

    def residual(basis: torch.Tensor) -> float:
        solution = torch.linalg.pinv(basis.double()) @ wave[:, None].double()
        return float((basis.double() @ solution - wave[:, None]).abs().max())

    assert code.basis(time).shape == (75, 52)
    assert residual(code.basis(time).detach()) < 0.05 < residual(fourier_basis(time, 5))
    waves = fourier_basis(time, 5) @ code.coefficients[0, :12]  # splines start silent
    assert torch.allclose(code(torch.zeros(75, dtype=torch.int64), time), waves, atol=1e-5)


def test_gradients_of_codes_repeat_bit_for_bit() -> None:
    """Many frames of few videos, large enough for several threads: a resumed run must add up in the same order."""
    generator = torch.Generator().manual_seed(0)
    code = FourierCode(3, 96, 5, generator, splines=40)
    video, time = torch.randint(3, (48,), generator=generator), torch.rand(48, generator=generator) * 2 - 1
    weight = torch.randn(48, 96, generator=generator)
    threads = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        found = []
        for _ in range(30):
            code.zero_grad()
            (code(video, time) * weight).sum().backward()
            assert code.coefficients.grad is not None
            found.append(code.coefficients.grad.clone())
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(found[0], other) for other in found[1:])
