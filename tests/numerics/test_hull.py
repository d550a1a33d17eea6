"""Silhouettes of known solids from known cameras: their box, their hull, its signed distance."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from stages.fitting import hull, initialise
from stages.fitting.initialise import lattice, normalise, place_bones, rigid_hull, set_shape, usable_frames
from stages.model.fields import GridField
from tests.numerics.analytic_scene import Hit, box, ellipsoid, scene, sphere

RADII = torch.tensor([0.8, 0.5, 0.45])
HALF = torch.tensor([0.6, 0.35, 0.45])
VOXEL = 0.07


def overlap(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("centre", [[0.0, 0, 0], [0.4, -0.3, 0.2]])
def test_object_box_finds_centre_and_size(centre: list[float]) -> None:
    middle = torch.tensor(centre)
    seen = scene(sphere(0.5, middle), frames=6)
    found, extent = hull.object_box(seen.observations, seen.poses, seen.intrinsics)
    assert torch.allclose(found, middle, atol=0.04)
    assert extent == pytest.approx(0.5, rel=0.12)


def test_object_box_needs_a_mask() -> None:
    seen = scene(sphere(0.5, torch.tensor([50.0, 0, 0])), frames=2)
    with pytest.raises(ValueError, match="no frame"):
        hull.object_box(seen.observations, seen.poses, seen.intrinsics)


def test_normalise_brings_the_object_to_the_origin_at_unit_size() -> None:
    middle = torch.tensor([0.3, -0.2, 0.25])
    seen = scene(sphere(0.4, middle), frames=6)
    found = normalise(seen.observations, seen.poses, seen.intrinsics)
    assert found.scale == pytest.approx(0.4, rel=0.12)
    # x_object = scale x_canonical + centre; depths shrink by the scale, pictures stay what they were
    canonical = torch.tensor([[0.3, 0.8, -0.5], [-1.0, 0.1, 0.2]])
    objects = found.scale * canonical + found.centre
    for f in (0, 7):
        by_object = hull.transform(seen.poses[f], objects)
        by_canonical = hull.transform(found.camera_from_canonical[f], canonical)
        assert torch.allclose(by_object, found.scale * by_canonical, atol=1e-4)
    again = normalise(seen.observations, found.camera_from_canonical, seen.intrinsics)
    assert again.scale == 1.0 and torch.equal(again.centre, torch.zeros(3))
    assert torch.allclose(again.camera_from_canonical, found.camera_from_canonical, atol=1e-6)


def test_votes_are_the_share_of_masks_that_cover_a_point() -> None:
    seen = scene(sphere(0.5), frames=4)
    points = torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [0.0, 0.3, 0.2], [0.8, 0, 0], [0, 0, 0.9], [0.45, 0.1, 0]])
    share = hull.votes(
        hull.rigid_placement(points, seen.poses), len(points), seen.observations, seen.intrinsics, torch.arange(8)
    )
    for n, point in enumerate(points):
        votes = []
        for f in range(8):
            camera = seen.poses[f, :3, :3] @ point + seen.poses[f, :3, 3]
            x, y = (seen.intrinsics[f] @ camera)[:2] / camera[2]
            votes.append(float(seen.masks[f][int(y), int(x)]) / 255)
        assert float(share[n]) == pytest.approx(sum(votes) / len(votes), abs=1e-6)
    assert share[:3].tolist() == [1, 1, 1] and float(share[3]) < 0.8


def test_points_seen_by_nobody_get_no_votes() -> None:
    seen = scene(sphere(0.5), frames=4)
    far = torch.tensor([[40.0, 0, 0], [0, -60.0, 3]])
    share = hull.votes(hull.rigid_placement(far, seen.poses), 2, seen.observations, seen.intrinsics, torch.arange(8))
    assert share.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("hit", "inside"),
    [
        (ellipsoid(RADII), lambda x: (x / RADII).norm(dim=-1) < 1),
        (box(HALF), lambda x: (x.abs() < HALF).all(-1)),
    ],
    ids=["ellipsoid", "box"],
)
def test_hull_recovers_the_solid(hit: Hit, inside: Callable[[torch.Tensor], torch.Tensor]) -> None:
    seen = scene(hit, frames=8)
    found = rigid_hull(seen.observations, seen.poses, seen.intrinsics, VOXEL)
    truth = inside(found.nodes)
    assert float((found.solid & truth).sum() / truth.sum()) > 0.93  # a hull holds its object
    assert overlap(found.solid, truth) > 0.75
    assert found.level >= 0.6


def test_a_bad_mask_does_not_carve_the_hull_away() -> None:
    seen = scene(ellipsoid(RADII), frames=8)
    whole = rigid_hull(seen.observations, seen.poses, seen.intrinsics, VOXEL)
    seen.observations.silhouettes[3] = 0
    found = rigid_hull(seen.observations, seen.poses, seen.intrinsics, VOXEL)
    assert found.level < 1
    assert overlap(found.solid, whole.solid) > 0.8


def test_agreement_prefers_the_true_size() -> None:
    seen = scene(sphere(0.5), frames=4)
    nodes = lattice(0.06).reshape(-1, 3)
    kept = torch.stack([nodes.norm(dim=1) < r for r in (0.3, 0.5, 0.8)])
    scores = hull.silhouette_agreement(
        hull.rigid_placement(nodes, seen.poses), kept, 0.06, seen.observations, seen.intrinsics, torch.arange(8)
    )
    assert scores.argmax() == 1 and scores[1] > 0.85
    assert ((scores >= 0) & (scores <= 1)).all()


def test_usable_frames_have_masks_and_are_spread() -> None:
    seen = scene(sphere(0.5), frames=5)
    seen.observations.frame_weight[[0, 4]] = 0
    every = usable_frames(seen.observations, 100)
    assert every.tolist() == [1, 2, 3, 5, 6, 7, 8, 9]
    assert usable_frames(seen.observations, 3).tolist() == [1, 6, 9]


def test_largest_component_keeps_diagonal_limbs() -> None:
    solid = np.zeros((8, 8, 8), bool)
    for i in range(5):
        solid[i, i, i] = True
    solid[7, 0, 0:3] = True
    found = hull.largest_component(solid)
    assert found.sum() == 5 and found[4, 4, 4]
    assert not hull.largest_component(np.zeros((3, 3, 3), bool)).any()


def test_signed_distance_of_a_ball() -> None:
    axis = np.arange(-20, 21) * 0.05
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    radius = np.sqrt(x**2 + y**2 + z**2)
    found = hull.signed_distance(radius < 0.6, (0.05, 0.05, 0.05))
    band = (radius > 0.2) & (radius < 0.9)
    assert np.abs(found - (radius - 0.6))[band].max() < 0.05
    assert np.abs((found - (radius - 0.6))[band].mean()) < 0.01


def test_set_shape_fills_the_solid_voxels() -> None:
    nodes = lattice(0.06, 1.0).reshape(-1, 3)
    solid = nodes[(nodes / torch.tensor([0.7, 0.4, 0.5])).norm(dim=1) < 1]
    field = GridField(torch.tensor([[-0.9, -0.6, -0.7], [0.9, 0.6, 0.7]]), 0.05, 4)
    set_shape(field, solid, 0.06)
    with torch.no_grad():
        along_x = field.sdf(field.prepare(), torch.tensor([[0.0, 0, 0], [0.55, 0, 0], [0.85, 0, 0]]))
        along_y = field.sdf(field.prepare(), torch.tensor([[0, 0.3, 0], [0, 0.5, 0], [0, 0, -0.4], [0, 0, -0.6]]))
    assert along_x[0] < -0.3 and along_x[1] < 0 and along_x[2] > 0.08
    assert [bool(v < 0) for v in along_y] == [True, False, True, False]


def test_bones_reach_the_ends_and_are_seeded() -> None:
    generator = torch.Generator().manual_seed(0)
    body = torch.rand(3000, 3, generator=generator) * torch.tensor([0.6, 0.3, 0.3])
    limb = torch.stack([0.6 + torch.linspace(0, 0.8, 120), torch.full((120,), 0.15), torch.full((120,), 0.15)], 1)
    points = torch.cat([body, limb])
    bones = place_bones(points, 8, 0)
    assert len(bones) == 8
    assert float(bones.centres.detach()[:, 0].max()) > 1.1  # the thin limb's tip has a bone
    assert torch.equal(bones.centres, place_bones(points, 8, 0).centres)
    assert all(int(p) < i for i, p in enumerate(bones.parents.tolist()) if i)
    assert torch.isfinite(bones.log_scales).all()
    assert len(place_bones(points[:3], 8, 0)) == 3
    assert len(place_bones(points, 1, 0)) == 1


def horseshoe() -> torch.Tensor:
    """Points of two legs that stand 0.12 apart and meet at the top only."""
    height = torch.linspace(0, 1, 60)
    ring = torch.linspace(0, 2 * math.pi, 9)[:-1]
    circle = 0.03 * torch.stack([ring.cos(), torch.zeros(8), ring.sin()], 1)
    legs = [circle + torch.tensor([x, float(h), 0.0]) for x in (-0.06, 0.06) for h in height]
    top = [circle[:, [1, 0, 2]] + torch.tensor([float(x), 1.03, 0.0]) for x in torch.linspace(-0.06, 0.06, 9)]
    return torch.cat(legs + top)


def test_a_tree_of_bones_goes_along_the_body_not_from_paw_to_paw() -> None:
    bones = initialise.place_bones(horseshoe(), 9, seed=0, along=True)
    centres, parents = bones.centres.detach(), bones.parents.tolist()
    for bone, parent in enumerate(parents):
        crosses = centres[bone, 0] * centres[parent, 0] < 0 and abs(float(centres[bone, 0])) > 0.03
        assert not crosses or float(centres[[bone, parent], 1].min()) > 0.7, (centres[bone], centres[parent])
    assert float(centres[:, 1].min()) < 0.15


def test_specks_are_no_part_of_the_body() -> None:
    body = horseshoe()
    speck = torch.randn(12, 3, generator=torch.Generator().manual_seed(0)) * 0.02 + torch.tensor([0.8, 0.5, 0.0])
    kept = initialise.body_of(torch.cat([speck, body]))
    assert torch.equal(kept, body)


def test_the_room_that_limbs_sweep_is_wider_than_the_hull() -> None:
    nodes = initialise.lattice(0.1, 0.5)
    share = 1 - nodes.norm(dim=-1)
    hull_ = initialise.Hull(nodes, share, share >= 0.7, 0.7)
    room = initialise.swept(hull_, 0.5)
    assert room is not None and len(room) > int(hull_.solid.sum()) and float(room.norm(dim=1).max()) <= 0.5 + 1e-6
    assert initialise.swept(hull_, 0.0) is None and initialise.swept(hull_, 0.7) is None
