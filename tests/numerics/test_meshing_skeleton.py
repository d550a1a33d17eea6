"""Joint trees, skin weights and blending against closed forms and slow loops."""

import numpy as np
from scipy.spatial.transform import Rotation

from stages.meshing.skeleton import build_skeleton, invert, nearest_rigid, pair_joints
from stages.meshing.skinning import blend, fit_influences, top_influences


def turn_about(point: np.ndarray, rotation: Rotation) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = rotation.as_matrix()
    result[:3, 3] = point - result[:3, :3] @ point
    return result


def star(frames: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A trunk (bone 2) with three limbs of two bones each that hang on it: centres, transforms, true joints."""
    rng = np.random.default_rng(seed)
    directions = np.array([[1.0, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0]])
    centres, joints = np.zeros((7, 3)), np.zeros((7, 3))
    transforms = np.tile(np.eye(4), (frames, 7, 1, 1))
    for limb, (upper, lower) in enumerate([(0, 1), (3, 4), (5, 6)]):
        hip, knee = 0.35 * directions[limb], 0.75 * directions[limb]
        centres[upper], centres[lower] = 0.55 * directions[limb], 0.95 * directions[limb]
        joints[upper], joints[lower] = hip, knee
        for t in range(frames):
            first = turn_about(hip, Rotation.from_rotvec(rng.normal(0, 0.7, 3)))
            transforms[t, upper] = first
            transforms[t, lower] = first @ turn_about(knee, Rotation.from_rotvec(rng.normal(0, 0.7, 3)))
    return centres, transforms, joints


def nearest_bone_weights(vertices: np.ndarray, centres: np.ndarray) -> np.ndarray:
    score = np.exp(-(np.linalg.norm(vertices[:, None] - centres, axis=-1) ** 2) / 0.02)
    return score / score.sum(axis=1, keepdims=True)


def test_the_tree_and_the_joints_of_a_known_body_are_found() -> None:
    centres, transforms, joints = star(40, 1)
    vertices = np.concatenate([c + 0.05 * np.random.default_rng(2).normal(size=(40, 3)) for c in centres])
    skeleton = build_skeleton(centres, transforms, nearest_bone_weights(vertices, centres), vertices)
    pairs = zip(skeleton.bone, skeleton.parent, strict=True)
    parent_bone = {int(b): int(skeleton.bone[p]) if p >= 0 else -1 for b, p in pairs}
    assert parent_bone == {2: -1, 0: 2, 3: 2, 5: 2, 1: 0, 4: 3, 6: 5}
    assert skeleton.parent[0] == -1
    assert (skeleton.parent[1:] < np.arange(1, 7)).all()
    for j, b in enumerate(skeleton.bone):
        if parent_bone[int(b)] >= 0:
            assert np.linalg.norm(skeleton.rest[j, :3, 3] - joints[b]) < 0.02
    assert skeleton.names[0] == "bone_02"


def test_the_joint_minimises_its_cost() -> None:
    centres, transforms, _ = star(12, 3)
    _, point = pair_joints(centres, transforms, 2.0)

    def loss(p: np.ndarray, a: int, b: int) -> float:
        gap = (transforms[:, a] - transforms[:, b]) @ np.append(p, 1.0)
        return float((gap**2).sum(axis=1).mean() + 0.02 * ((p - (centres[a] + centres[b]) / 2) ** 2).sum())

    rng = np.random.default_rng(0)
    for a, b in [(0, 2), (0, 1), (3, 4)]:
        best = loss(point[a, b], a, b)
        assert all(best <= loss(point[a, b] + rng.normal(0, 0.01, 3), a, b) for _ in range(20))


def test_bones_that_do_not_move_apart_are_joined_in_the_middle() -> None:
    centres = np.array([[0.0, 0, 0], [1, 0, 0]])
    _, point = pair_joints(centres, np.tile(np.eye(4), (5, 2, 1, 1)), 1.0)
    np.testing.assert_allclose(point[0, 1], [0.5, 0, 0], atol=1e-12)


def test_a_models_own_tree_is_kept() -> None:
    centres, transforms, _ = star(10, 1)
    vertices = np.repeat(centres, 4, axis=0)
    parents = np.array([1, 3, 2, 2, 3, 2, 5])  # not the cheapest one, and not in order
    skeleton = build_skeleton(centres, transforms, nearest_bone_weights(vertices, centres), vertices, parents=parents)
    assert skeleton.bone[0] == 2
    for j, b in enumerate(skeleton.bone[1:], start=1):
        assert skeleton.bone[skeleton.parent[j]] == parents[b]
        assert skeleton.parent[j] < j


def test_one_bone_is_a_tree() -> None:
    vertices = np.random.default_rng(0).normal(size=(10, 3))
    skeleton = build_skeleton(np.zeros((1, 3)), np.tile(np.eye(4), (3, 1, 1, 1)), np.ones((10, 1)), vertices)
    assert skeleton.parent.tolist() == [-1]
    assert len(skeleton) == 1


def test_local_transforms_chain_back_to_the_posed_ones() -> None:
    centres, transforms, _ = star(4, 5)
    vertices = np.repeat(centres, 4, axis=0)
    skeleton = build_skeleton(centres, transforms, nearest_bone_weights(vertices, centres), vertices)
    posed = skeleton.posed(transforms)
    local = skeleton.local(posed)
    chained = np.zeros_like(posed)
    for j, p in enumerate(skeleton.parent):
        chained[:, j] = local[:, j] if p < 0 else chained[:, p] @ local[:, j]
    np.testing.assert_allclose(chained, posed, atol=1e-12)
    np.testing.assert_allclose(posed @ invert(skeleton.rest), transforms[:, skeleton.bone], atol=1e-12)


def test_the_largest_weights_are_kept_and_sum_to_one_in_float32() -> None:
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.full(25, 0.3), 500)
    for kept in (4, 8):
        index, value = top_influences(weights, kept)
        assert index.shape == value.shape == (500, kept)
        assert np.abs(value.astype(np.float64).sum(axis=1) - 1).max() < 1e-6
        assert (np.diff(value, axis=1) <= 1e-7).all()
        assert (index[value == 0] == 0).all()
        row = 7
        expected = np.sort(weights[row])[::-1][:kept]
        np.testing.assert_allclose(value[row], expected / expected.sum(), atol=2e-4)
    index, value = top_influences(np.ones((3, 2)) / 2, 8)
    assert index.shape == (3, 2)


def test_blending_equals_a_loop() -> None:
    rng = np.random.default_rng(0)
    _, transforms, _ = star(3, 7)
    vertices = rng.normal(size=(20, 3))
    weights = rng.dirichlet(np.ones(7), 20)
    index, value = top_influences(weights, 7)
    moved = blend(vertices, transforms, index, value)
    for t in range(3):
        for v in range(20):
            slow = sum(weights[v, b] * (transforms[t, b] @ np.append(vertices[v], 1))[:3] for b in range(7))
            np.testing.assert_allclose(moved[t, v], slow, atol=1e-3)


def test_fitted_influences_follow_better_and_stay_weights() -> None:
    rng = np.random.default_rng(0)
    _, transforms, _ = star(30, 11)
    vertices = 0.4 * rng.normal(size=(60, 3))
    weights = rng.dirichlet(np.full(7, 1.0), 60)
    posed = blend(vertices, transforms, *top_influences(weights, 7))
    for kept in (2, 4):
        plain = blend(vertices, transforms, *top_influences(weights, kept))
        index, value = fit_influences(vertices, weights, transforms, posed, kept, 2.0)
        fitted = blend(vertices, transforms, index, value)
        assert ((fitted - posed) ** 2).sum(axis=(0, 2)).mean() < 0.8 * ((plain - posed) ** 2).sum(axis=(0, 2)).mean()
        assert (value >= 0).all() and (np.diff(value, axis=1) <= 1e-6).all()
        np.testing.assert_allclose(value.astype(float).sum(axis=1), 1, atol=1e-6)
        # No feasible step makes it better: shift a little weight between every pair of kept bones.
        best = ((fitted - posed) ** 2).sum(axis=(0, 2))
        for a in range(kept):
            for b in range(kept):
                moved = value.astype(float).copy()
                step = np.minimum(0.02, moved[:, a])
                moved[:, a] -= step
                moved[:, b] += step
                other = ((blend(vertices, transforms, index, moved) - posed) ** 2).sum(axis=(0, 2))
                real = (value > 0).all(axis=1)
                assert (best[real] <= other[real] + 1e-4).all()


def test_weights_that_motion_cannot_tell_apart_stay_as_they_are() -> None:
    rng = np.random.default_rng(0)
    vertices, weights = rng.normal(size=(20, 3)), rng.dirichlet(np.ones(5), 20)
    still = np.tile(np.eye(4), (6, 5, 1, 1))
    index, value = fit_influences(vertices, weights, still, np.tile(vertices, (6, 1, 1)), 4, 2.0)
    plain_index, _ = top_influences(weights, 4)
    np.testing.assert_array_equal(index, plain_index)
    own = np.take_along_axis(weights, index, axis=1)
    np.testing.assert_allclose(value, own + (1 - own.sum(axis=1, keepdims=True)) / 4, atol=1e-6)


def test_the_nearest_rigid_transform_undoes_noise_and_never_mirrors() -> None:
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    noisy = np.eye(4)
    noisy[:3, :3] = rotation * 1.01
    noisy[:3, 3] = [1, 2, 3]
    np.testing.assert_allclose(nearest_rigid(noisy)[:3, :3], rotation, atol=1e-12)
    mirrored = np.diag([1.0, 1, -0.5, 1])
    assert np.linalg.det(nearest_rigid(mirrored)[:3, :3]) > 0.99
