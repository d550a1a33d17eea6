"""Driving a known model: shared parts never move, codes do; the start is the best known articulation; root search."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
import torch

from stages.fitting.known_poses import best_sequence, known_shapes, spread
from stages.fitting.observations import ObservationBuilder
from stages.fitting.surface import surface_points
from stages.geometry.cameras import transform
from stages.geometry.rotations import geodesic_angle, so3_exp
from stages.model.banmo import Banmo, VideoFacts
from stages.retargeting.articulation import first_articulation
from stages.retargeting.driven import ClipSettings, ClipTrainer, driven_model, known_codes, start_codes
from stages.retargeting.growing import change_of_frame, grown
from stages.retargeting.placing import directions, place_in_box, register, turn_onto
from tests.numerics.analytic_scene import Scene, ellipsoid, intrinsics_of, model_of, scene, stir

pytestmark = pytest.mark.usefixtures("one_thread")

RADII = torch.tensor([0.3, 0.2, 0.6])


def solid(points: torch.Tensor) -> torch.Tensor:
    return ((points / RADII).norm(dim=-1) - 1) * float(RADII.min())


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(ellipsoid(RADII), frames=6)


@pytest.fixture(scope="module")
def known(seen: Scene) -> Banmo:
    model = model_of(seen, solid)
    stir(model, 1.5)
    model.surface = surface_points(model, 48)
    return model


def clip(count: int = 6) -> VideoFacts:
    return VideoFacts("drive", tuple(0.1 * i for i in range(count)), 48, 40, (44.0, 44.0), (25.0, 19.0))


def driven_of(known: Banmo, seen: Scene, splines: int = 0) -> Banmo:
    return driven_model(known, clip(), seen.poses[:6], octaves=3, seed=0, splines=splines)


def test_the_driven_model_shares_everything_but_the_clip(known: Banmo, seen: Scene) -> None:
    driven = driven_of(known, seen)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    torch.testing.assert_close(driven.sdf(points), known.sdf(points))
    torch.testing.assert_close(driven.rest_weights(points), known.rest_weights(points))
    torch.testing.assert_close(driven.embedding(points), known.embedding(points))
    assert driven.video_names == ["drive"] and len(driven.time) == 6
    again = Banmo.restore(driven.state_dict(), driven.describe())
    time = torch.tensor([0.13], dtype=torch.float64)
    torch.testing.assert_close(again.forward_warp(points, 0, time), driven.forward_warp(points, 0, time))


@pytest.mark.parametrize("splines", [0, 5])
def test_codes_start_where_they_are_told(known: Banmo, seen: Scene, splines: int) -> None:
    driven = driven_of(known, seen, splines)
    wanted = known_codes(known)[3].expand(6, -1)
    start_codes(driven, wanted)
    torch.testing.assert_close(known_codes(driven), wanted, atol=2e-3, rtol=0)


def test_only_the_clips_own_codes_are_learned(known: Banmo, seen: Scene) -> None:
    driven = driven_of(known, seen)
    driven.root_free.fill_(1.0)
    builder = ObservationBuilder(steps=())
    for i in range(6):
        builder.add(0, seen.images[i], seen.masks[i], {}, 1.0)
    before = {name: value.clone() for name, value in driven.state_dict().items()}
    settings = ClipSettings(
        iterations=4,
        frames_per_step=3,
        pixels_per_frame=24,
        probe_samples=16,
        fine_samples=8,
        lr_sdf=0.0,
        lr_colour=0.0,
        lr_bones=0.0,
        lr_delta=0.0,
        lr_root=1e-3,
    )
    trainer = ClipTrainer(driven, builder.finish(), settings)
    while not trainer.done:
        trainer.step()
    changed = {name for name, value in driven.state_dict().items() if not torch.equal(value, before[name])}
    own = {"body.code.coefficients", "environment.coefficients"} | {n for n in before if n.startswith("root.")}
    assert "body.code.coefficients" in changed
    assert changed - own <= {"surface"}, "nothing shared has moved"


def test_the_cheapest_path_is_found() -> None:
    random = torch.Generator().manual_seed(0)
    cost, jump = torch.rand(4, 3, generator=random), torch.rand(3, 3, generator=random)

    def price(path: tuple[int, ...]) -> float:
        steps = sum(float(jump[a, b]) for a, b in itertools.pairwise(path))
        return steps + sum(float(cost[t, k]) for t, k in enumerate(path))

    best = min(itertools.product(range(3), repeat=4), key=price)
    assert best_sequence(cost, jump).tolist() == list(best)


def rendered(
    known: Banmo, frames: list[int], poses: torch.Tensor, k: torch.Tensor
) -> tuple[ObservationBuilder, np.ndarray]:
    """Masks of the known model in the articulation of `frames`, before cameras `poses`, with their boxes."""
    from skimage.measure import marching_cubes

    from stages.fitting.surface import sample_volume
    from stages.geometry.raster import rasterise

    volume, low, spacing = sample_volume(known, 48)
    vertices, faces, _, _ = marching_cubes(volume, 0.0, spacing=tuple(float(s) for s in spacing))
    points = torch.from_numpy(vertices.astype(np.float32)) + low
    shapes = known_shapes(known, torch.tensor(frames), points)
    builder, boxes = ObservationBuilder(steps=()), []
    for shape, pose in zip(shapes, poses, strict=True):
        covered = rasterise(transform(pose, shape).numpy(), faces, k.numpy(), 40, 48, cull_back=False).covered
        builder.add(0, np.zeros((40, 48, 3), np.uint8), covered.astype(np.uint8) * 255, {}, 1.0)
        rows, columns = np.nonzero(covered)
        boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    return builder, np.array(boxes, np.float64)


def test_a_frame_starts_in_the_articulation_it_shows(known: Banmo, seen: Scene) -> None:
    frames = [0, 1, 2, 3, 4, 5]
    k = intrinsics_of((48, 40))
    builder, _ = rendered(known, frames, seen.poses[:6], k)
    start, misfit = first_articulation(known, seen.poses[:6], k, builder.finish(), smooth=0.0)
    shapes = known_shapes(known, torch.arange(len(known.time)), known.surface[spread(len(known.surface), 200)])
    between = torch.cdist(shapes.flatten(1), shapes.flatten(1)) / shapes.shape[1] ** 0.5
    apart = between[start, torch.tensor(frames)]
    assert float(apart.mean()) < 0.5 * float(between[between > 0].mean()), "close to the shapes that were filmed"
    assert float(misfit.max()) < 0.05


def test_a_shape_is_placed_into_its_box() -> None:
    points = torch.rand(4, 60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    k = intrinsics_of((48, 40))
    pose = place_in_box(points, directions(4, (0.0,)), torch.tensor([10.0, 8.0, 30.0, 24.0]), k)
    pixels = transform(pose, points) @ k.T
    pixels = pixels[..., :2] / pixels[..., 2:]
    centre = (pixels.amin(1) + pixels.amax(1)) / 2
    assert float((centre - torch.tensor([20.0, 16.0])).abs().max()) < 0.5
    side = (pixels.amax(1) - pixels.amin(1)).amax(1)
    assert float((side - 20).abs().max()) < 0.5


def test_directions_are_cameras_round_an_upright_object() -> None:
    found = directions()
    torch.testing.assert_close(found @ found.transpose(1, 2), torch.eye(3).expand(len(found), 3, 3), atol=1e-5, rtol=0)
    assert (torch.linalg.det(found) > 0.99).all() and (found[:, 1, 1] < 0).all()


def lopsided(known: Banmo) -> torch.Tensor:
    """Points of the known surface with a bump on top in front: left and right alike, front and back not."""
    base = known.surface[spread(len(known.surface), 400)]
    noise = torch.randn(120, 3, generator=torch.Generator().manual_seed(0))
    bump = torch.tensor([[0.0, 0.35, 0.55]]) + 0.12 * torch.nn.functional.normalize(noise, dim=-1)
    return torch.cat([base, base * torch.tensor([-1.0, 1, 1]), bump, bump * torch.tensor([-1.0, 1, 1])])


def filmed(shape: torch.Tensor, poses: torch.Tensor, k: torch.Tensor) -> tuple[ObservationBuilder, np.ndarray]:
    """Masks of points, the holes between them closed, and their boxes."""
    builder, boxes = ObservationBuilder(steps=()), []
    for pose in poses:
        pixels = transform(pose, shape) @ k.T
        pixels = (pixels[:, :2] / pixels[:, 2:]).numpy()
        mask = np.zeros((40, 48), np.uint8)
        mask[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] = 255
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        rows, columns = np.nonzero(mask)
        boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        builder.add(0, np.zeros((40, 48, 3), np.uint8), mask, {}, 1.0)
    return builder, np.array(boxes, np.float64)


def part_of_a_turn() -> torch.Tensor:
    poses = torch.eye(4).repeat(9, 1, 1)
    poses[:, :3, :3] = directions(24, (10.0,))[:9]
    poses[:, 2, 3] = 3.0
    return poses


def test_root_poses_are_found_on_a_known_shape_up_to_near_and_far(known: Banmo) -> None:
    """Filmed from a third of the way round. Outlines of a symmetric body do not tell near from far: that is allowed."""
    k, poses, shape = intrinsics_of((48, 40)), part_of_a_turn(), lopsided(known)
    builder, boxes = filmed(shape, poses, k)
    placed = register(shape[None], k, builder.finish(), boxes, every=2)
    twin = torch.diag(torch.tensor([1.0, 1, -1])) @ poses[:, :3, :3] @ torch.diag(torch.tensor([-1.0, 1, 1]))
    found = placed.poses[:, :3, :3]
    either = torch.minimum(geodesic_angle(found, poses[:, :3, :3]), geodesic_angle(found, twin))
    assert float(torch.rad2deg(either).median()) < 25
    assert float((placed.poses[:, 2, 3] - 3).abs().median()) < 0.4
    assert (placed.confidence > 0).all() and (placed.confidence <= 1).all()


def test_rotations_in_another_frame_are_turned_onto_the_model(known: Banmo) -> None:
    """Root rotations that are right but for a turn about the upright axis, as of another estimate."""
    k, poses, shape = intrinsics_of((48, 40)), part_of_a_turn(), lopsided(known)
    builder, boxes = filmed(shape, poses, k)
    turn = torch.deg2rad(torch.tensor(135.0))
    c, s = float(turn.cos()), float(turn.sin())
    elsewhere = poses[:, :3, :3] @ torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    placed = turn_onto(shape[None], elsewhere, k, builder.finish(), boxes)
    assert float(torch.rad2deg(geodesic_angle(placed.poses[:, :3, :3], poses[:, :3, :3])).max()) < 12
    assert float((placed.poses[:, 2, 3] - 3).abs().max()) < 0.5


# --------------------------------------------------------------------------------------------- clips added later


def test_poses_in_another_frame_and_scale_are_carried_over() -> None:
    generator = torch.Generator().manual_seed(0)
    old = torch.eye(4).repeat(5, 1, 1)
    old[:, :3, :3] = so3_exp(torch.randn(5, 3, generator=generator))
    old[:, :3, 3] = torch.randn(5, 3, generator=generator) + torch.tensor([0.0, 0, 4])
    turn, shift, scale = so3_exp(torch.randn(1, 3, generator=generator))[0], torch.tensor([0.2, -0.1, 0.3]), 1.7
    new = old.clone()
    new[:, :3, :3] = old[:, :3, :3] @ turn.T
    new[:, :3, 3] = scale * old[:, :3, 3] - (new[:, :3, :3] @ shift)
    points = torch.randn(6, 3, generator=generator)
    torch.testing.assert_close(transform(new, scale * points @ turn.T + shift), scale * transform(old, points))
    found = change_of_frame(new, old)
    torch.testing.assert_close(found[0], turn, atol=1e-5, rtol=0)
    torch.testing.assert_close(found[1], shift, atol=1e-4, rtol=0)
    assert found[2] == pytest.approx(scale, abs=1e-4)


def test_a_grown_model_keeps_what_it_knew(known: Banmo, seen: Scene) -> None:
    """A longer clip joins (so time is measured anew); the clips it knew move as before, the new one is placed."""
    added = VideoFacts("later", tuple(0.1 * i for i in range(9)), 48, 40, (44.0, 44.0), (25.0, 19.0))
    k = intrinsics_of((48, 40))
    later = seen.poses[:6][[0, 1, 2, 3, 4, 5, 5, 4, 3]]
    builder = ObservationBuilder(steps=())
    for image, mask in zip(seen.images, seen.masks, strict=True):
        builder.add(0, image, mask, {}, 1.0)
    for i in (0, 1, 2, 3, 4, 5, 5, 4, 3):
        builder.add(2, seen.images[i], seen.masks[i], {}, 1.0)
    turn = so3_exp(torch.tensor([[0.0, 0.4, 0.0]]))[0]
    elsewhere = torch.cat([seen.poses, later])
    elsewhere[:, :3, :3] = elsewhere[:, :3, :3] @ turn.T
    intrinsics = torch.cat([seen.intrinsics, k.expand(9, 3, 3)])
    new = grown(known, [*seen.videos, added], elsewhere, intrinsics, builder.finish(), octaves=3, splines=6, seed=0)
    points = known.surface[::20]
    for video in (0, 1):
        time = torch.tensor(seen.videos[video].time_s, dtype=torch.float64)
        before, after = known.forward_warp(points, video, time), new.forward_warp(points, video, time)
        assert float((before - after).norm(dim=-1).max()) < 5e-3
        torch.testing.assert_close(new.root_poses(video, time), known.root_poses(video, time), atol=5e-3, rtol=0)
    torch.testing.assert_close(new.sdf(points), known.sdf(points))
    placed = new.base_poses[12:]
    turned = elsewhere[12:, :3, :3].transpose(1, 2) @ placed[:, :3, :3]
    torch.testing.assert_close(turned, turned[:1].expand_as(turned), atol=1e-5, rtol=0)
    again = Banmo.restore(new.state_dict(), new.describe())
    assert again.video_names == ["clip0", "clip1", "later"]
