"""Gaussian bones: skinning scores, weights and blending against loops; the tree of bones against scipy."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import minimum_spanning_tree

from stages.geometry.rotations import rigid, so3_exp
from stages.model.skeleton import (
    Bones,
    DeltaSkinning,
    blend,
    blend_rigidly,
    bone_tree,
    dual_quaternions,
    monomials,
    score_coefficients,
    skinning_weights,
)


def random_bones(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return draw(count, 3), so3_exp(draw(count, 3)), 0.4 * draw(count, 3) - 1


def slow_score(x: torch.Tensor, centre: torch.Tensor, axes: torch.Tensor, log_scale: torch.Tensor) -> torch.Tensor:
    """-1/2 of the squared Mahalanobis distance, component by component along the Gaussian's axes (equation 7)."""
    total = torch.zeros((), dtype=x.dtype)
    for k in range(3):
        along = torch.dot(x - centre, axes[:, k])
        total = total - 0.5 * (along / torch.exp(log_scale[k])) ** 2
    return total


def test_monomial_scores_are_the_mahalanobis_distances() -> None:
    centres, orientations, log_scales = random_bones(4)
    points = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    scores = monomials(points) @ score_coefficients(centres, orientations, log_scales)
    for n in range(6):
        for b in range(4):
            expected = slow_score(points[n], centres[b], orientations[b], log_scales[b])
            assert float(scores[n, b]) == pytest.approx(float(expected), rel=1e-9, abs=1e-9)


def test_scores_move_with_the_bones() -> None:
    """Equation 6: a rigid motion of bones and points together leaves the scores as they are."""
    centres, orientations, log_scales = random_bones(3, 2)
    points = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    turn, shift = so3_exp(torch.tensor([0.3, -1.1, 0.4], dtype=torch.float64)), torch.tensor([1.0, 2, -0.5]).double()
    before = monomials(points) @ score_coefficients(centres, orientations, log_scales)
    after = monomials(points @ turn.T + shift) @ score_coefficients(
        centres @ turn.T + shift, turn @ orientations, log_scales
    )
    assert torch.allclose(before, after, atol=1e-9)


def test_skinning_weights_are_the_softmax_of_the_scores() -> None:
    centres, orientations, log_scales = random_bones(4, 4)
    coefficients = score_coefficients(centres, orientations, log_scales)[None]
    points = torch.randn(1, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    delta = torch.randn(1, 5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(6))
    for extra in (None, delta):
        weights = skinning_weights(points, coefficients, extra)
        assert torch.allclose(weights.sum(-1), torch.ones(1, 5, dtype=torch.float64))
        for n in range(5):
            scores = torch.stack(
                [slow_score(points[0, n], centres[b], orientations[b], log_scales[b]) for b in range(4)]
            )
            if extra is not None:
                scores = scores + extra[0, n]
            expected = scores.exp() / scores.exp().sum()
            assert torch.allclose(weights[0, n], expected, atol=1e-9)


def test_blend_is_the_weighted_sum_of_rigid_motions() -> None:
    generator = torch.Generator().manual_seed(7)
    transforms = rigid(
        so3_exp(torch.randn(2, 3, 3, generator=generator, dtype=torch.float64)),
        torch.randn(2, 3, 3, generator=generator, dtype=torch.float64),
    )
    points = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(2, 4, 3, generator=generator, dtype=torch.float64)
    found = blend(points, weights, transforms)
    for f in range(2):
        for n in range(4):
            expected = torch.zeros(3, dtype=torch.float64)
            for b in range(3):
                moved = transforms[f, b, :3, :3] @ points[f, n] + transforms[f, b, :3, 3]
                expected = expected + weights[f, n, b] * moved
            assert torch.allclose(found[f, n], expected)


def test_delta_skinning_is_silent_at_first_and_learns_from_point_and_code() -> None:
    delta = DeltaSkinning(3, 5, width=8)
    points, code = torch.randn(2, 4, 3), torch.randn(2, 5)
    assert torch.equal(delta(points, code), torch.zeros(2, 4, 3))
    with torch.no_grad():
        delta.out.weight.normal_()
    moved = delta(points, code)
    assert moved.shape == (2, 4, 3)
    assert not torch.allclose(moved, delta(points, code + 1))
    assert not torch.allclose(moved, delta(points + 1, code))


def path_length(distance: torch.Tensor, parents: list[int], a: int, b: int) -> float:
    def up(node: int) -> list[int]:
        chain = [node]
        while parents[chain[-1]] != chain[-1]:
            chain.append(parents[chain[-1]])
        return chain

    left, right = up(a), up(b)
    shared = next(n for n in left if n in right)
    steps = left[: left.index(shared) + 1], right[: right.index(shared) + 1]
    return sum(float(distance[p, q]) for s in steps for p, q in pairwise(s))


@given(st.integers(1, 12), st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_bone_tree_is_the_minimum_spanning_tree_with_parents_first(count: int, seed: int) -> None:
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    distance = torch.cdist(points, points)
    order, parents = bone_tree(distance)
    assert sorted(order.tolist()) == list(range(count))
    assert parents[0] == 0 and all(int(p) < i for i, p in enumerate(parents.tolist()) if i)
    ordered = distance[order][:, order]
    length = sum(float(ordered[i, p]) for i, p in enumerate(parents.tolist()) if i)
    assert length == pytest.approx(float(minimum_spanning_tree(distance.numpy()).sum()), rel=1e-9)
    # the root: no bone has a nearer farthest bone along the tree
    far = [max(path_length(ordered, parents.tolist(), a, b) for b in range(count)) for a in range(count)]
    assert far[0] == pytest.approx(min(far))


def test_bones_start_as_spheres_along_the_axes() -> None:
    bones = Bones(torch.zeros(2, 3), torch.zeros(2, 3), torch.tensor([0, 0]))
    assert len(bones) == 2
    assert torch.equal(bones.orientations, torch.eye(3).expand(2, 3, 3))
    assert {name for name, _ in bones.named_parameters()} == {"centres", "quaternions", "log_scales"}
    assert bones.parents.dtype == torch.int64


def random_rigid(frames: int, bones: int, size: float, seed: int = 3) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    turns = so3_exp(size * torch.randn(frames, bones, 3, generator=generator, dtype=torch.float64))
    return rigid(turns, torch.randn(frames, bones, 3, generator=generator, dtype=torch.float64))


def test_dual_quaternions_of_one_bone_move_as_its_matrix() -> None:
    transforms = random_rigid(3, 4, 2.0)
    points = torch.randn(3, 40, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    for bone in range(4):
        weights = torch.zeros(3, 40, 4, dtype=torch.float64)
        weights[..., bone] = 1
        assert torch.allclose(blend_rigidly(points, weights, transforms), blend(points, weights, transforms), atol=1e-9)
    dual = dual_quaternions(transforms)
    assert torch.allclose(dual[..., :4].norm(dim=-1), torch.ones(3, 4, dtype=torch.float64))
    assert ((dual[..., :4] * dual[..., 4:]).sum(-1).abs() < 1e-12).all()
    assert ((dual[..., :4] * dual[:, :1, :4]).sum(-1) >= 0).all()


def test_dual_quaternion_blends_are_rigid_and_linear_ones_collapse() -> None:
    """Half way of a half turn about x: a quarter turn, where the mean of the matrices squeezes y and z to nothing."""
    turn = torch.tensor([[[0.0, 0, 0], [3.1, 0, 0]]], dtype=torch.float64)
    transforms = rigid(so3_exp(turn), torch.zeros(1, 2, 3, dtype=torch.float64))
    points = torch.tensor([[[0.3, 1.0, 0.0], [0.0, 0.0, 2.0]]], dtype=torch.float64)
    half = torch.full((1, 2, 2), 0.5, dtype=torch.float64)
    expected = points @ so3_exp(torch.tensor([1.55, 0, 0], dtype=torch.float64)).T
    assert torch.allclose(blend_rigidly(points, half, transforms), expected, atol=1e-9)
    assert float(blend(points, half, transforms)[0, 1].norm()) < 0.1


def test_bones_that_agree_are_followed_whatever_their_weights() -> None:
    one = random_rigid(2, 1, 1.0)
    points = torch.randn(2, 20, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    weights = torch.rand(2, 20, 3, generator=torch.Generator().manual_seed(8), dtype=torch.float64).softmax(-1)
    found = blend_rigidly(points, weights, one.expand(-1, 3, -1, -1))
    assert torch.allclose(found, blend(points, weights, one.expand(-1, 3, -1, -1)), atol=1e-9)
