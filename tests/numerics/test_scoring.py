"""Measures against answers known in advance, and against the judge beside the repository where it is there."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.meshing.surface import Mesh, clean_surface, extract
from stages.scoring.alignment import IDENTITY, Similarity, align, cube_rotations, fit_similarity
from stages.scoring.metrics import (
    endpoint_errors_px,
    mask_ious,
    rotation_errors_deg,
    sampling_floor,
    summarise,
    surface_score,
    tracking_error_cm,
)
from stages.scoring.surfaces import Surface, nearest_on_triangle

BOUNDS = np.array([[-1.4] * 3, [1.4] * 3])


def solid(radii: tuple[float, float, float] = (1.0, 0.6, 0.3), bump: float = 0.25) -> Mesh:
    """An ellipsoid with a bump, so that no turn maps it to itself."""

    def field(points):  # type: ignore[no-untyped-def]
        scaled = points / points.new_tensor(radii)
        body = (scaled.norm(dim=-1) - 1) * min(radii)
        return body.minimum((points - points.new_tensor([0.6, 0.45, 0.1])).norm(dim=-1) - bump)

    return clean_surface(extract(field, BOUNDS, 48), 1500)[0]


def surface(mesh: Mesh, similarity: Similarity = IDENTITY, samples: int = 3000, seed: int = 0) -> Surface:
    return Surface(similarity(mesh.vertices), mesh.faces, samples, seed)


def test_nearest_point_of_a_triangle_is_nearest() -> None:
    """Against a dense sampling of each triangle."""
    rng = np.random.default_rng(0)
    corners, points = rng.normal(size=(40, 3, 3)), rng.normal(size=(40, 3)) * 2
    corners[0, 2] = corners[0, 1]  # a triangle without area
    found = np.linalg.norm(nearest_on_triangle(points, corners) - points, axis=1)
    u, v = np.meshgrid(np.linspace(0, 1, 200), np.linspace(0, 1, 200))
    weight = np.stack([1 - u - v, u, v], axis=-1)[(u + v) <= 1]
    dense = np.einsum("sk,nkc->nsc", weight, corners)
    least = np.linalg.norm(dense - points[:, None], axis=-1).min(axis=1)
    assert (found <= least + 1e-9).all()
    np.testing.assert_allclose(found, least, atol=0.02)


def test_samples_lie_on_the_surface_and_are_the_same_again() -> None:
    mesh = solid()
    first, second = surface(mesh), surface(mesh)
    np.testing.assert_array_equal(first.points, second.points)
    apart = first.nearest(first.points)[1]
    assert np.quantile(apart, 0.99) < 1e-9 and apart.max() < 0.02  # the search looks at eight candidates


def test_distances_of_a_shifted_plane_are_the_shift() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    low, high = Surface(square, faces, 2000), Surface(square + np.array([0, 0, 0.015]), faces, 2000)
    score = surface_score(high, low, IDENTITY, 1.0, 100.0)
    assert score.chamfer_cm == pytest.approx(1.5) and score.chamfer_sum_cm == pytest.approx(3.0)
    assert score.f == {1: 0.0, 2: 100.0, 5: 100.0}


def test_a_part_that_is_lacking_shows_in_one_direction_only() -> None:
    mesh = solid()
    left = mesh.faces[mesh.vertices[mesh.faces].mean(axis=1)[:, 0] < 0.2]
    score = surface_score(Surface(mesh.vertices, left, 3000), surface(mesh), IDENTITY, 2.0, 100.0)
    assert score.forth_cm < 0.01 and score.back_cm > 3


def test_similarities_are_found_exactly_from_matches() -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(50, 3))
    known = Similarity(0.4, Rotation.random(random_state=2).as_matrix(), np.array([1.0, -2, 3]))
    found = fit_similarity(source, known(source))
    np.testing.assert_allclose(found.rotation, known.rotation, atol=1e-9)
    assert found.scale == pytest.approx(0.4)
    np.testing.assert_allclose(found.undo(known(source)), source, atol=1e-9)


def test_alignment_undoes_any_similarity() -> None:
    mesh = solid()
    known = Similarity(0.37, Rotation.random(random_state=3).as_matrix(), np.array([0.4, -2, 5]))
    truth = surface(mesh)
    moved = surface(mesh, known, seed=5)
    found = align([moved], [truth], cube_rotations())
    score = surface_score(moved, truth, found, 2.0, 100.0)
    assert score.chamfer_cm < 0.1 and score.f[1] > 99.9


def test_missing_frames_cost_f_and_not_distance() -> None:
    mesh = solid()
    score = surface_score(surface(mesh, seed=3), surface(mesh), IDENTITY, 2.0, 100.0)
    summary = summarise([score, score], missing=2)
    assert summary.chamfer_cm == pytest.approx(score.chamfer_cm)
    assert summary.f[2] == pytest.approx(score.f[2] / 2)
    assert summarise([], missing=3).f[2] == 0


def test_the_floor_is_low_on_surfaces_and_higher_between_points() -> None:
    truth = surface(solid())
    assert sampling_floor(truth, 2.0, 100.0, "surface").chamfer_cm < 0.01
    assert 0.3 < sampling_floor(truth, 2.0, 100.0, "points").chamfer_cm < 3


def test_rotation_errors_ignore_a_turn_of_the_object_and_no_other() -> None:
    truth = Rotation.random(30, random_state=1).as_matrix()
    turn = Rotation.random(random_state=2).as_matrix()
    assert rotation_errors_deg(truth @ turn, truth).max() < 1e-5
    wrong = truth @ turn
    wrong[4] = Rotation.from_rotvec([0, 0, np.radians(90)]).as_matrix() @ wrong[4]
    error = rotation_errors_deg(wrong, truth)
    assert error.argmax() == 4 and 80 < error[4] < 95


def test_mask_ious_also_of_another_size() -> None:
    truth = np.zeros((3, 20, 20), bool)
    truth[0, 5:15, 5:15] = truth[1, 5:15, 5:15] = True
    own = truth.copy()
    own[1, :, :10] = False
    np.testing.assert_allclose(mask_ious(own, truth), [1, 0.5, 1])
    np.testing.assert_allclose(mask_ious(own.repeat(2, 1).repeat(2, 2), truth), [1, 0.5, 1])


def test_endpoint_errors() -> None:
    flow = np.zeros((2, 2, 2))
    np.testing.assert_allclose(endpoint_errors_px(flow + np.array([3, 4]), flow), 5)


def test_drift_is_seen_where_shapes_alone_agree() -> None:
    """A ball that turns looks the same; its surface points do not stay where they were."""
    mesh = solid((0.8, 0.8, 0.8), 0.01)
    turned = Rotation.from_rotvec([0, 0.5, 0]).as_matrix()
    still = [surface(mesh), surface(mesh)]
    turning = [surface(mesh), Surface(mesh.vertices @ turned.T, mesh.faces, 3000)]
    assert tracking_error_cm(still, still, IDENTITY, 100.0) < 0.5
    assert surface_score(turning[1], still[1], IDENTITY, 2.0, 100.0).chamfer_cm < 0.5
    assert tracking_error_cm(turning, still, IDENTITY, 100.0) > 15


def test_a_mesh_without_area_is_refused() -> None:
    with pytest.raises(ValueError, match="no area"):
        Surface(np.zeros((3, 3)), np.array([[0, 1, 2]]))


def test_agrees_with_the_judge(root: Path) -> None:
    """The same meshes, scored by the evaluation script beside the repository: to 0.1 cm and 0.1 %."""
    script = root.parent / "shared" / "eval" / "evaluate.py"
    if not script.is_file():
        pytest.skip("no evaluation script beside the repository (../shared/eval/evaluate.py)")
    spec = importlib.util.spec_from_file_location("judge", script)
    assert spec is not None and spec.loader is not None
    judge = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(judge)
    rng = np.random.default_rng(0)
    mesh = solid()
    known = Similarity(0.7, Rotation.random(random_state=4).as_matrix(), np.array([1.0, 0, 0]))
    truths, predictions = [], []
    for k in range(3):
        posed = mesh.vertices * [1, 1 + 0.1 * k, 1]
        truths.append(Mesh(posed, mesh.faces))
        predictions.append(Mesh(known(posed + rng.normal(size=posed.shape) * 0.01), mesh.faces))
    theirs = [{k: judge.Surface(m.vertices, m.faces) for k, m in enumerate(ms)} for ms in (predictions, truths)]
    rows, _ = judge.evaluate(*theirs, dict.fromkeys(range(3), 2.0), 2.0, "video", judge.cube_rotations(), "surface",
                             dict.fromkeys(range(3), 0))  # fmt: skip
    ours = [[Surface(m.vertices, m.faces) for m in ms] for ms in (predictions, truths)]
    similarity = align(*ours, cube_rotations())
    for k in range(3):
        score = surface_score(ours[0][k], ours[1][k], similarity, 2.0, 100.0)
        assert score.chamfer_cm == pytest.approx(rows[k]["cd_cm"], abs=0.1)
        for percent in (1, 2, 5):
            assert score.f[percent] == pytest.approx(rows[k][f"f{percent}"], abs=0.1)
