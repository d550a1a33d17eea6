"""Figures of quality against hand-made cases, and the advice drawn from them."""

import numpy as np
import pytest

from stages.geometry.raster import rasterise, vertex_normals
from stages.meshing.quality import (
    ClipQuality,
    Verdict,
    judge,
    mask_iou,
    mask_misfit,
    number,
    unseen_side,
    vertex_areas,
    visible_vertices,
)

K = np.array([[50.0, 0, 32], [0, 50.0, 32], [0, 0, 1]])


def clip(
    iou: float = 0.95, root: float = 0.9, mask: float = 0.9, skinning: float = 1e-4, missing: float = 0.0
) -> ClipQuality:
    ones = np.ones(4)
    return ClipQuality(
        "v",
        np.arange(4),
        iou * ones,
        missing * ones,
        0 * ones,
        root * ones,
        mask * ones,
        [[]] * 4,
        4,
        skinning,
        skinning,
        100 * ones,
    )


def verdict(
    clips: list[ClipQuality],
    pose_trust: float | None = 0.9,
    unseen: float = 0.05,
    side: str | None = None,
    dropped: float = 0.0,
    level: float = 0.0,
) -> Verdict:
    return judge(clips, pose_trust, None, unseen, side, dropped, level)


def test_overlap_of_masks() -> None:
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    a[:2], b[1:3] = True, True
    assert mask_iou(a, b) == pytest.approx(1 / 3)
    assert mask_misfit(a, b) == (0.5, 0.5)
    assert mask_iou(a & False, b & False) == 1.0
    assert mask_misfit(a, b & False) == (0.0, 8.0)


def two_plates() -> tuple[np.ndarray, np.ndarray]:
    """Two squares that face the camera, the second behind the first and twice as far."""
    square = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    return np.concatenate([square + np.array([0, 0, 2]), 1.8 * square + np.array([0, 0, 4])]), np.concatenate(
        [faces, faces + 4]
    )


def test_vertices_behind_others_outside_the_mask_or_turned_away_are_not_seen() -> None:
    vertices, faces = two_plates()
    normals = vertex_normals(vertices, faces)
    np.testing.assert_allclose(normals[:, 2], -1)
    fragments = rasterise(vertices, faces, K, 64, 64)
    everywhere = np.ones((64, 64), bool)
    seen = visible_vertices(vertices, normals, K, fragments, everywhere, 0.01)
    assert seen.tolist() == [True] * 4 + [False] * 4
    alone = rasterise(vertices, faces[2:], K, 64, 64)
    assert visible_vertices(vertices, normals, K, alone, everywhere, 0.01)[4:].all()
    left = everywhere.copy()
    left[:, 32:] = False
    assert (
        visible_vertices(vertices, normals, K, fragments, left, 0.01).tolist()
        == [True, False, False, True] + [False] * 4
    )
    assert not visible_vertices(vertices, -normals, K, fragments, everywhere, 0.01).any()
    assert not visible_vertices(vertices - [0, 0, 10], normals, K, fragments, everywhere, 0.01).any()


def test_areas_sum_to_the_surface() -> None:
    vertices, faces = two_plates()
    areas = vertex_areas(vertices, faces)
    assert areas.sum() == pytest.approx(1 + 1.8**2)
    assert areas[:4] == pytest.approx([1 / 3, 1 / 6, 1 / 3, 1 / 6])


def test_the_unseen_side_is_named() -> None:
    normals = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, -1]])
    areas = np.ones(4)
    assert unseen_side(areas, normals, np.array([False, True, True, True])) == "left (+x)"
    assert unseen_side(areas, normals, np.array([True, True, True, False])) == "back (-z)"
    assert unseen_side(areas, normals, np.array([False, False, True, True])) is None
    assert unseen_side(areas, normals, np.ones(4, bool)) is None


def test_a_good_result_is_called_good_and_needs_no_advice() -> None:
    result = verdict([clip(), clip()])
    assert result.word == "good" and result.trust == pytest.approx(0.9)
    assert result.advice == []


@pytest.mark.parametrize(
    ("clips", "more", "sentence"),
    [
        ([clip(iou=0.5)], {}, "misses the object's outline in 100%"),
        ([clip(mask=0.3)], {}, "poor masks"),
        ([clip(missing=0.2)], {}, "20% of the object is not in the model"),
        ([clip()], {"pose_trust": 0.2}, "flattened, doubled"),
        ([clip(root=0.1)], {"pose_trust": None}, "flattened, doubled"),
        ([clip()], {"unseen": 0.4, "side": "left (+x)"}, "mostly its left (+x) side: add a clip from there"),
        ([clip()], {"unseen": 0.4}, "add clips from other sides"),
        ([clip(skinning=0.01)], {}, "only to 1.0% of the object's length"),
        ([clip()], {"dropped": 0.2}, "Loose pieces (20%"),
        ([clip()], {"level": 0.1}, "without a surface"),
    ],
)
def test_each_weakness_is_told(clips: list[ClipQuality], more: dict, sentence: str) -> None:
    result = verdict(clips, **more)
    assert any(sentence in advice for advice in result.advice)


def test_no_part_makes_up_for_another() -> None:
    """A perfect outline with unknown root poses is not trusted, and names no side of an arbitrary frame."""
    result = verdict([clip(iou=1.0)], pose_trust=0.1, unseen=0.5, side="left (+x)")
    assert result.trust == pytest.approx(0.1) and result.word == "doubtful"
    assert not any("left" in advice for advice in result.advice)
    assert verdict([clip()], level=0.1).trust == 0.0
    assert verdict([clip(missing=0.16)]).word == "usable with care"  # an arm and a bit of a person


def test_numbers_are_fit_for_json() -> None:
    assert number(np.float32(0.123456)) == 0.1235
    assert number(float("nan")) is None
    record = clip(iou=float("nan")).as_json()
    assert record["iou_mean"] is None and record["iou_worst"] is None
    assert [f["flags"] for f in clip(iou=0.3, root=0.1).as_json()["frames"]] == [["outline", "pose"]] * 4
