"""The assembled model: warps (equations 4 to 8) against loops, their inverses, frames in time, save and restore."""

from __future__ import annotations

import json
import math

import pytest
import torch

from stages.fitting.surface import frame_boxes, sample_volume, surface_points
from stages.geometry.cameras import transform
from stages.geometry.rotations import interpolate_rigid, so3_exp
from stages.model.banmo import Architecture, Banmo
from tests.numerics.analytic_scene import TINY, Scene, model_of, scene, sphere, stir

RADIUS = 0.5
POINTS = torch.tensor([[0.1, 0.2, -0.1], [0.4, 0, 0.1], [-0.5, 0.1, 0.3], [0.0, -0.4, 0.2]])
SMALL_NETWORKS = Architecture(
    representation="mlp", mlp_depth=3, mlp_width=16, pose_code=8, pose_width=16, root_code=8, root_width=16,
    env_code=4, octaves=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(sphere(RADIUS), frames=3)


def ball(points: torch.Tensor) -> torch.Tensor:
    return points.norm(dim=-1) - RADIUS


@pytest.fixture
def model(seen: Scene) -> Banmo:
    """Moving, with bones that are no spheres, and with a delta that is not silent."""
    made = model_of(seen, ball)
    stir(made, 0.6)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        made.bones.quaternions.add_(0.4 * torch.randn(3, 4, generator=generator))
        made.bones.log_scales.add_(0.3 * torch.randn(3, 3, generator=generator))
        made.delta.out.weight.copy_(0.3 * torch.randn(made.delta.out.weight.shape, generator=generator))
        made.log_focal.copy_(torch.tensor([0.1, -0.2]))
    return made


def slow_weights(model: Banmo, point: torch.Tensor, posed: torch.Tensor, delta: torch.Tensor) -> torch.Tensor:
    """Softmax over bones of -1/2 (x - C)^T Q (x - C) + delta, bones moved by `posed` (B, 4, 4)."""
    scores = []
    for b in range(3):
        centre = posed[b, :3, :3] @ model.bones.centres[b] + posed[b, :3, 3]
        axes = posed[b, :3, :3] @ model.bones.orientations[b]
        precision = axes @ torch.diag(torch.exp(-2 * model.bones.log_scales[b])) @ axes.T
        scores.append(-0.5 * (point - centre) @ precision @ (point - centre) + delta[b])
    return torch.stack(scores).softmax(0)


@pytest.mark.parametrize("use_delta", [False, True])
@torch.no_grad()
def test_warps_are_the_papers_sums(model: Banmo, use_delta: bool) -> None:
    model.use_delta = use_delta
    frames = torch.tensor([0, 4])
    state = model.frames(frames)
    points = POINTS[None].expand(2, -1, -1)
    forward, backward = model.forward_points(state, points), model.backward(state, points)
    nothing = torch.zeros(2, 4, 3)
    rest_delta = model.delta(points, torch.zeros_like(state.code)) if use_delta else nothing
    posed_delta = model.delta(points, state.code) if use_delta else nothing
    rest = torch.eye(4).expand(3, 4, 4)
    for f in range(2):
        moves = state.transforms[f]
        assert float((moves - torch.eye(4)).abs().max()) > 0.1
        for n, x in enumerate(POINTS):
            weights = slow_weights(model, x, rest, rest_delta[f, n])
            expected = sum(weights[b] * (moves[b, :3, :3] @ x + moves[b, :3, 3]) for b in range(3))
            assert torch.allclose(forward[f, n], expected, atol=1e-5)
            weights = slow_weights(model, x, moves, posed_delta[f, n])
            expected = sum(weights[b] * (moves[b, :3, :3].T @ (x - moves[b, :3, 3])) for b in range(3))
            assert torch.allclose(backward[f, n], expected, atol=1e-5)


@torch.no_grad()
def test_warps_of_a_single_bone_are_inverse(seen: Scene) -> None:
    model = model_of(seen, ball, centres=torch.tensor([[0.1, 0.0, 0.2]]))
    stir(model, 1.0)
    state = model.frames(torch.arange(6))
    points = POINTS[None].expand(6, -1, -1)
    moved = model.forward_points(state, points)
    assert (moved - points).norm(dim=-1).mean() > 0.05
    assert torch.allclose(model.backward(state, moved), points, atol=1e-5)


@torch.no_grad()
def test_warps_are_inverse_where_one_bone_rules(seen: Scene) -> None:
    model = model_of(seen, ball, centres=torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [-2.0, 0.5, 0]]))
    model.bones.log_scales.fill_(math.log(0.25))
    stir(model, 0.5)
    state = model.frames(torch.arange(6))
    generator = torch.Generator().manual_seed(0)
    points = (model.bones.centres[:, None] + 0.2 * torch.randn(3, 20, 3, generator=generator)).reshape(1, -1, 3)
    points = points.expand(6, -1, -1)
    moved = model.forward_points(state, points)
    assert (moved - points).norm(dim=-1).mean() > 0.1
    assert torch.allclose(model.backward(state, moved), points, atol=1e-4)


@torch.no_grad()
def test_posed_gaussians_peak_at_the_posed_centres(model: Banmo) -> None:
    state = model.frames(torch.tensor([1]))
    centres = transform(state.transforms[0], model.bones.centres[:, None])[:, 0]
    x, y, z = centres.unbind(-1)
    monomials = torch.stack([torch.ones(3), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], 1)
    assert torch.allclose((monomials @ state.posed_coefficients[0]).diagonal(), torch.zeros(3), atol=1e-3)


@torch.no_grad()
def test_a_model_at_rest_stands_where_it_was_put(seen: Scene) -> None:
    model = model_of(seen, ball)
    state = model.frames(torch.arange(6))
    assert torch.allclose(state.camera_from_object, seen.poses, atol=1e-6)
    assert torch.allclose(state.intrinsics, seen.intrinsics)
    points = POINTS[None].expand(6, -1, -1)
    assert torch.allclose(model.forward_points(state, points), points, atol=1e-6)
    assert torch.allclose(model.backward(state, points), points, atol=1e-6)


def test_time_is_centred_on_each_video_and_spans_the_longest(model: Banmo) -> None:
    assert model.normalised_time(0, torch.tensor([0.0, 0.1, 0.2])).tolist() == pytest.approx([-1, 0, 1], abs=1e-6)
    assert model.normalised_time(1, torch.tensor([1.0, 1.1])).tolist() == pytest.approx([-1, 0], abs=1e-6)
    assert torch.allclose(model.time, torch.tensor([-1.0, 0, 1, -1, 0, 1]), atol=1e-6)
    assert model.video_idx.tolist() == [0, 0, 0, 1, 1, 1] and model.starts == [0, 3, 6]


@torch.no_grad()
def test_focal_is_a_log_ratio_per_video(model: Banmo, seen: Scene) -> None:
    for v, log_ratio in ((0, 0.1), (1, -0.2)):
        expected = seen.intrinsics[3 * v].clone()
        expected[0, 0] *= math.exp(log_ratio)
        expected[1, 1] *= math.exp(log_ratio)
        assert torch.allclose(model.intrinsics(v), expected)


@torch.no_grad()
def test_reading_by_seconds_agrees_with_reading_by_frame(model: Banmo) -> None:
    for v in (0, 1):
        frames = torch.arange(3) + 3 * v
        seconds = torch.tensor(model.videos[v].time_s, dtype=torch.float64)
        state = model.frames(frames)
        assert torch.allclose(model.root_poses(v, seconds), state.camera_from_object, atol=1e-5)
        assert torch.allclose(model.bone_transforms(v, seconds), state.transforms, atol=1e-5)
        expected = model.forward_points(state, POINTS[None].expand(3, -1, -1))
        assert torch.allclose(model.forward_warp(POINTS, v, seconds), expected, atol=1e-5)


@torch.no_grad()
def test_between_frames_the_first_poses_are_interpolated(model: Banmo) -> None:
    at = torch.tensor([0.03, 0.17, 5.0], dtype=torch.float64)
    base = interpolate_rigid(model.base_poses[:3], torch.tensor([0.0, 0.1, 0.2]).double(), at)
    model.root_free.zero_()
    assert torch.allclose(model.root_poses(0, at), base, atol=1e-6)
    model.root_free.fill_(1.0)
    assert not torch.allclose(model.root_poses(0, at), base, atol=1e-3)


@torch.no_grad()
def test_what_export_reads_makes_the_warp(model: Banmo) -> None:
    """x_t = sum_b w_b(x) J_b x, from the public pieces alone."""
    for use_delta in (False, True):
        model.use_delta = use_delta
        seconds = torch.tensor([0.05, 0.2], dtype=torch.float64)
        weights, moves = model.rest_weights(POINTS), model.bone_transforms(1, seconds)
        assert torch.allclose(weights.sum(1), torch.ones(4))
        homogeneous = torch.cat([POINTS, torch.ones(4, 1)], 1)
        expected = torch.einsum("nb,tbij,nj->tni", weights, moves, homogeneous)[..., :3]
        assert torch.allclose(model.forward_warp(POINTS, 1, seconds), expected, atol=1e-5)


@torch.no_grad()
def test_colour_depends_on_the_light_of_the_video(model: Banmo) -> None:
    assert torch.allclose(model.colour(POINTS), torch.sigmoid(2 * POINTS), atol=0.02)
    model.field.environment.weight.normal_(generator=torch.Generator().manual_seed(0))
    assert not torch.allclose(model.colour(POINTS, 0), model.colour(POINTS, 1), atol=1e-3)
    assert not torch.allclose(model.colour(POINTS, 0, -1.0), model.colour(POINTS, 0, 0.5), atol=1e-3)


@pytest.mark.parametrize("architecture", [TINY, SMALL_NETWORKS], ids=["grid", "mlp"])
def test_restore_gives_the_same_model(seen: Scene, architecture: Architecture) -> None:
    model = model_of(seen, ball, architecture)
    stir(model, 0.5)
    model.surface = torch.rand(7, 3)
    model.use_delta = True
    description = json.loads(json.dumps(model.describe()))
    other = Banmo.restore({k: v.clone() for k, v in model.state_dict().items()}, description)
    assert other.describe() == model.describe() and other.use_delta
    assert other.video_names == ["clip0", "clip1"]
    for name, value in model.state_dict().items():
        assert torch.equal(other.state_dict()[name], value), name
    with torch.no_grad():
        seconds = torch.tensor([0.1, 0.15])
        assert torch.equal(model.forward_warp(POINTS, 0, seconds), other.forward_warp(POINTS, 0, seconds))
        assert torch.equal(model.root_poses(1, seconds), other.root_poses(1, seconds))
        for read in ("sdf", "colour", "embedding", "rest_weights"):
            assert torch.equal(getattr(model, read)(POINTS), getattr(other, read)(POINTS)), read
        assert torch.equal(model.bounds, other.bounds) and torch.equal(model.bone_parents, other.bone_parents)


def test_restore_refuses_tensors_of_another_model(seen: Scene) -> None:
    model = model_of(seen, ball)
    tensors = dict(model.state_dict())
    del tensors["log_focal"]
    with pytest.raises(RuntimeError, match="log_focal"):
        Banmo.restore(tensors, model.describe())


# ---------------------------------------------------------------------------------------------- its surface


def test_the_surface_of_a_ball(seen: Scene) -> None:
    model = model_of(seen, ball)
    volume, low, spacing = sample_volume(model, 20)
    node = torch.tensor([3, 11, 7])
    expected = model.sdf((low + node * spacing)[None])
    assert float(volume[tuple(node)]) == pytest.approx(float(expected), abs=1e-5)
    points = surface_points(model, resolution=24, most=500)
    assert 200 < len(points) <= 500
    assert (points.norm(dim=1) - RADIUS).abs().max() < 0.03
    with torch.no_grad():
        model.field.sdf_grids[0].add_(10)
    assert surface_points(model, resolution=24).shape == (0, 3)


def test_frame_boxes_hold_the_posed_surface(seen: Scene) -> None:
    model = model_of(seen, ball, centres=torch.tensor([[0.0, 0, 0]]))
    assert torch.equal(frame_boxes(model), model.bounds.expand(6, 2, 3))  # no surface known yet
    model.surface = surface_points(model)
    boxes = frame_boxes(model, margin=0.1)
    assert torch.allclose(boxes[:, 1], torch.full((6, 3), RADIUS + 0.1), atol=0.03)
    with torch.no_grad():
        model.body.head.out.bias[3:6] = torch.tensor([0.5, 0, -0.2]) / model.body.head.translation_scale
        model.body.head.out.bias[:3] = torch.tensor([0, 2.0, 0])
    moved = frame_boxes(model, margin=0.1)
    shift = torch.tensor([0.5, 0, -0.2])
    assert torch.allclose(moved.mean(1), shift.expand(6, 3), atol=0.03)
    assert torch.allclose(so3_exp(torch.tensor([0, 2.0, 0])), model.frames(torch.tensor([0])).transforms[0, 0, :3, :3])


def test_cells_to_match_follow_the_surface(seen: Scene) -> None:
    model = model_of(seen, lambda x: x.norm(dim=-1) - 0.5)
    first = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    model.surface = first
    cells = model.match_cells()
    assert model.match_cells() is cells
    assert 0.8 < float(cells.norm(dim=1).mean()) < 1.1 and len(cells) < 8000 / 2
    model.surface = 2 * first
    assert torch.allclose(model.match_cells(), 2 * cells, atol=1e-5)
    model.surface.mul_(0.5)  # as load_state_dict does
    assert torch.allclose(model.match_cells(), cells, atol=1e-5)
