"""The rigid motion that root poses and bones share is found, moved over, and changes no picture."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.fitting.gauge import align, divided, rigid_parts, settle, steadied, unswayed
from stages.geometry.rotations import geodesic_angle, invert_rigid, rigid, so3_exp
from stages.model.banmo import Architecture, Banmo, VideoFacts
from stages.model.skeleton import Bones


def _rigid(count: int, angle: float, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    vectors = angle * torch.randn(count, 3, generator=generator)
    return rigid(so3_exp(vectors), 0.1 * torch.randn(count, 3, generator=generator))


def test_align_finds_a_known_motion_and_never_a_reflection() -> None:
    points = torch.randn(1, 60, 3, generator=torch.Generator().manual_seed(1))
    known = _rigid(1, 1.0, 2)[0]
    target = points[0] @ known[:3, :3].T + known[:3, 3]
    assert torch.allclose(align(points, target, torch.ones(1, 60))[0], known, atol=1e-5)
    mirrored = align(points, target * torch.tensor([-1.0, 1, 1]), torch.ones(1, 60))[0]
    assert float(torch.linalg.det(mirrored[:3, :3])) == pytest.approx(1.0, abs=1e-4)


def test_a_swinging_limb_does_not_turn_the_trunk() -> None:
    generator = torch.Generator().manual_seed(3)
    trunk = 0.3 * torch.randn(300, 3, generator=generator)
    limb = 0.05 * torch.randn(120, 3, generator=generator) + torch.tensor([0.0, -0.8, 0.0])
    swing = so3_exp(torch.stack([torch.linspace(-1, 1, 30), torch.zeros(30), torch.zeros(30)], 1))
    shape = torch.cat([trunk.expand(30, -1, -1), limb @ swing.transpose(1, 2)], 1)
    wobble = _rigid(30, 0.15, 4)
    posed = shape @ wobble[:, :3, :3].transpose(1, 2) + wobble[:, None, :3, 3]
    found = rigid_parts(posed, torch.ones(30, dtype=torch.bool), 0.05, 25)
    rest = found @ wobble  # the same for every frame, up to one motion of all
    relative = rest[0, :3, :3].T @ rest[:, :3, :3]
    angles = ((relative.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1).acos()
    assert float(angles.max()) < 0.02  # plain least squares leaves 0.2 and more


@pytest.fixture
def model() -> Banmo:
    generator = torch.Generator().manual_seed(0)
    videos = [
        VideoFacts(name, tuple(i / 10 for i in range(8)), 64, 64, (60.0, 60.0), (32.0, 32.0)) for name in ("a", "b")
    ]
    base = torch.eye(4).repeat(16, 1, 1)
    base[:, 2, 3] = 3.0
    bounds = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    bones = Bones(0.4 * torch.randn(4, 3, generator=generator), torch.full((4, 3), -1.5), torch.zeros(4).long())
    with torch.random.fork_rng(devices=[]):  # layers draw their first weights from torch's own generator
        torch.manual_seed(0)
        made = Banmo(Architecture(voxel=0.2), videos, base, bounds, bones, generator)
    made.surface = 0.5 * torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1)
    with torch.no_grad():
        made.body.head.out.bias[:3] = torch.tensor([0.3, 0.0, 0.0])  # the root bone turns, and all others with it
        made.body.head.out.weight[:3] += 0.05 * torch.randn(3, 128, generator=generator)
    return made


def test_settling_changes_no_picture_and_only_free_clips(model: Banmo) -> None:
    model.root_free[1] = 0.0
    time = torch.tensor([0.0, 0.25, 0.7])

    def camera(video: int) -> torch.Tensor:
        root = model.root_poses(video, time)
        return model.forward_warp(model.surface, video, time) @ root[:, :3, :3].transpose(1, 2) + root[:, None, :3, 3]

    before, roots = [camera(0), camera(1)], [model.root_poses(0, time), model.root_poses(1, time)]
    spread = model.forward_warp(model.surface, 0, time).std(0).mean()
    assert settle(model) > 0.0
    assert torch.equal(model.root_poses(1, time), roots[1])
    assert not torch.allclose(model.root_poses(0, time), roots[0], atol=1e-3)
    for video in (0, 1):
        assert torch.allclose(camera(video), before[video], atol=1e-5)
    assert model.forward_warp(model.surface, 0, time).std(0).mean() < 0.5 * spread


def test_a_model_keeps_its_gauge_on_disk(model: Banmo) -> None:
    settle(model)
    again = Banmo.restore(dict(model.state_dict()), model.describe())
    time = torch.tensor([0.3])
    assert torch.equal(again.root_poses(0, time), model.root_poses(0, time))


def test_steadying_keeps_an_even_turn_and_takes_out_what_is_quick() -> None:
    time = np.arange(60) / 20
    angle = torch.linspace(0.5, 6.0, 60)  # through half a turn, where quaternions change sign
    even = rigid(so3_exp(torch.stack([torch.zeros(60), angle, torch.zeros(60)], 1)), torch.ones(60, 3))
    assert torch.allclose(steadied(even, time, 0.2), even, atol=0.02)
    shaken = even @ _rigid(60, 0.1, 5)
    found = steadied(shaken, time, 0.2)
    assert float(torch.linalg.det(found[:, :3, :3]).sub(1).abs().max()) < 1e-4
    before, after = (geodesic_angle(track[:, :3, :3], even[:, :3, :3]) for track in (shaken, found))
    assert float(after.mean()) < 0.5 * float(before.mean())
    assert torch.equal(steadied(even[:2], time[:2], 0.2), even[:2])


def test_given_root_poses_keep_their_object_space_though_they_may_move(model: Banmo) -> None:
    model.videos = [replace(video, root_given=True) for video in model.videos]
    assert settle(model) == 0.0
    assert torch.equal(model.gauge, torch.eye(4).expand(16, 4, 4))
    model.videos[1] = replace(model.videos[1], root_given=False)
    assert settle(model) > 0.0
    assert torch.equal(model.gauge[:8], torch.eye(4).expand(8, 4, 4))
    assert float((model.gauge[8:] - torch.eye(4)).abs().max()) > 0.01


def _swaying(amplitude_rad: float, period_s: float, count: int = 240) -> tuple[torch.Tensor, np.ndarray]:
    """Motions that bring to rest a trunk that turns to and fro about the vertical axis, and the times."""
    time = np.arange(count) / 20
    angle = amplitude_rad * torch.sin(torch.from_numpy(2 * np.pi * time / period_s)).float()
    turn = so3_exp(torch.stack([torch.zeros(count), angle, torch.zeros(count)], 1))
    middle = so3_exp(torch.tensor([[0.3, -0.8, 0.2]]))  # how it rests need not be how object space stands
    return rigid((turn @ middle).transpose(1, 2), torch.zeros(count, 3)), time


def _sway(rest: torch.Tensor) -> float:
    """Root mean square turn (radians) of what is brought to rest about its mean."""
    turns = Rotation.from_matrix(rest[:, :3, :3].double().numpy())
    return float(np.sqrt(np.mean((turns * turns.mean().inv()).magnitude() ** 2)))


def test_a_slow_sway_that_the_roots_error_explains_goes_to_the_root_and_no_other() -> None:
    rest, time = _swaying(0.04, 8.0)
    still = torch.zeros(240, 3)

    def left(rest: torch.Tensor, wave_rad: float, slow_s: float = 0.75) -> float:
        turn = rigid(unswayed(rest, time, (wave_rad, wave_rad, wave_rad), slow_s), still)
        return _sway(rest @ invert_rigid(turn)) / _sway(rest)

    assert left(rest, 0.08) < 0.35  # more than is seen
    assert 0.4 < left(rest, 0.025) < 0.7
    assert left(rest, 0.002) > 0.98
    large, _ = _swaying(0.6, 8.0)
    assert left(large, 0.025) > 0.95  # a body that really sways
    quick, _ = _swaying(0.04, 0.5)
    assert left(quick, 0.08) > 0.95
    assert left(quick, 0.08, slow_s=0.0) < 0.35
    resting = torch.eye(4).repeat(240, 1, 1)
    assert torch.allclose(unswayed(resting, time, (1.0, 1.0, 1.0)), resting[:, :3, :3], atol=1e-6)


def test_axes_are_told_apart() -> None:
    """A trunk that turns to and fro about the vertical keeps that; a tilt as small as the root's error goes."""
    time = np.arange(240) / 20
    to_and_fro = torch.from_numpy(np.sin(2 * np.pi * time / 6)).float()
    tilt = 0.02 * torch.from_numpy(np.cos(2 * np.pi * time / 4)).float()
    sway = so3_exp(torch.stack([tilt, 0.5 * to_and_fro, torch.zeros(240)], 1))
    taken = unswayed(rigid(sway, torch.zeros(240, 3)), time, (0.04, 0.04, 0.04))
    vectors = Rotation.from_matrix(taken.numpy()).as_rotvec()
    assert np.abs(vectors[:, 1]).max() < 0.02
    assert np.corrcoef(vectors[:, 0], tilt.numpy())[0, 1] > 0.95
    assert 0.6 * 0.02 < np.abs(vectors[:, 0]).max() < 0.02


def test_dividing_brings_the_middle_to_rest_and_a_fixed_turn_whole() -> None:
    time = np.arange(30) / 20
    rest = _rigid(1, 0.5, 7).expand(30, -1, -1) @ _rigid(30, 0.1, 8)
    middle = torch.tensor([0.2, -0.1, 0.3])
    made = divided(rest, middle, time, (1e-4, 1e-4, 1e-4))
    before = (invert_rigid(rest) @ torch.cat([middle, torch.ones(1)]))[:, :3]
    after = (made @ torch.cat([before, torch.ones(30, 1)], 1)[..., None])[:, :3, 0]
    assert torch.allclose(after, middle.expand(30, 3), atol=1e-5)
    turns = Rotation.from_matrix(made[:, :3, :3].double().numpy())
    usual = Rotation.from_matrix(rest[:, :3, :3].double().numpy()).mean()
    assert (turns * usual.inv()).magnitude().max() < 1e-3  # the trunk keeps its own turns, not where it rests
    whole = divided(rest, middle, time, (10.0, 10.0, 10.0))
    assert torch.allclose(whole[:, :3, :3], rest[:, :3, :3], atol=1e-3)


def test_given_root_poses_that_jittered_lose_a_wave_and_no_picture_changes(model: Banmo) -> None:
    model.videos = [replace(video, root_given=True) for video in model.videos]
    model.videos[0] = replace(model.videos[0], root_wave_rad=(0.2, 0.3, 0.4))
    with torch.no_grad():
        model.body.head.out.weight[:3] *= 8  # so that the trunk sways at all
    time = torch.tensor([0.0, 0.35, 0.7])

    def camera(video: int) -> torch.Tensor:
        root = model.root_poses(video, time)
        return model.forward_warp(model.surface, video, time) @ root[:, :3, :3].transpose(1, 2) + root[:, None, :3, 3]

    before = [camera(0), camera(1)]
    assert settle(model) > 0.0
    assert torch.equal(model.gauge[8:], torch.eye(4).expand(8, 4, 4))
    assert float((model.gauge[:8] - torch.eye(4)).abs().max()) > 1e-3
    assert torch.equal(model.gauge[:, :3, 3], torch.zeros(16, 3))
    for video in (0, 1):
        assert torch.allclose(camera(video), before[video], atol=1e-5)
    again = Banmo.restore(dict(model.state_dict()), model.describe())
    assert [video.root_wave_rad for video in again.videos] == [(0.2, 0.3, 0.4), None]


def test_estimated_root_poses_of_known_error_settle_in_place_and_turn_no_further(model: Banmo) -> None:
    with torch.no_grad():
        model.body.head.out.weight[:3] *= 8
    video = model.videos[0]
    turned = {}
    for wave in (None, (1e-3, 1e-3, 1e-3), (0.3, 0.3, 0.3)):
        model.gauge.copy_(torch.eye(4).expand_as(model.gauge))
        model.videos = [replace(v, root_wave_rad=wave) for v in model.videos]
        settle(model, steady_s=0.0)
        turns = Rotation.from_matrix(model.gauge[: len(video.time_s), :3, :3].double().numpy())
        turned[wave] = float((turns * turns.mean().inv()).magnitude().mean())
    few, half, all_of_it = turned[(1e-3, 1e-3, 1e-3)], turned[(0.3, 0.3, 0.3)], turned[None]
    assert few < 0.05 * all_of_it
    assert few < half < 1.05 * all_of_it
