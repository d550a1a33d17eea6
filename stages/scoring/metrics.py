"""The paper's measures: surfaces, root poses, masks, flow, and tracking of the surface (BANMo, section 4)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from stages.scoring.alignment import IDENTITY, Similarity
from stages.scoring.surfaces import Surface

Distance = Literal["surface", "points"]
THRESHOLDS = (1, 2, 5)
"""Per cent of the longest edge of the true object's box, for F-scores."""
REST_CM = 200.0
"""What the longest edge of the true rest shape's box counts as, in centimetres (the paper's 2 m)."""


@dataclass(frozen=True)
class SurfaceScore:
    """One frame. forth, back: mean distance in cm from prediction to truth and back; f: threshold -> F-score in %."""

    forth_cm: float
    back_cm: float
    f: dict[int, float]

    @property
    def chamfer_cm(self) -> float:
        """Mean of the two directions."""
        return (self.forth_cm + self.back_cm) / 2

    @property
    def chamfer_sum_cm(self) -> float:
        """Sum of the two directions, as the paper's code reports it."""
        return self.forth_cm + self.back_cm


def surface_score(
    predicted: Surface,
    truth: Surface,
    similarity: Similarity,
    edge: float,
    cm_per_unit: float,
    distance: Distance = "surface",
) -> SurfaceScore:
    """Chamfer distance and F-scores of a prediction laid on the truth by `similarity`.

    Args:
        edge: longest edge of the true box, in the truth's units; F-scores are at 1, 2 and 5 % of it.
        distance: from samples to the other surface itself, or from samples to samples.
    """
    moved = similarity(predicted.points)
    if distance == "surface":
        forth = truth.nearest(moved)[1]
        back = predicted.nearest(similarity.undo(truth.points))[1] * similarity.scale
    else:
        forth = truth.tree.query(moved)[0]
        back = predicted.tree.query(similarity.undo(truth.points))[0] * similarity.scale
    f = {}
    for percent in THRESHOLDS:
        precision, recall = (float((d < edge * percent / 100).mean()) for d in (forth, back))
        f[percent] = 200 * precision * recall / max(precision + recall, 1e-12)
    return SurfaceScore(cm_per_unit * float(forth.mean()), cm_per_unit * float(back.mean()), f)


@dataclass(frozen=True)
class SurfaceSummary:
    """Means over frames; a frame without a mesh counts as F = 0 and is left out of the distances."""

    frames: int
    missing: int
    chamfer_cm: float
    chamfer_sum_cm: float
    forth_cm: float
    back_cm: float
    f: dict[int, float]


def summarise(scores: Sequence[SurfaceScore], missing: int = 0) -> SurfaceSummary:
    """Means over frames of one video or of several."""
    share = len(scores) / max(len(scores) + missing, 1)

    def mean(values: Iterable[float]) -> float:
        found = list(values)
        return float(np.mean(found)) if found else float("nan")

    f = {t: mean(s.f[t] for s in scores) * share if scores else 0.0 for t in THRESHOLDS}
    forth, back = mean(s.forth_cm for s in scores), mean(s.back_cm for s in scores)
    return SurfaceSummary(len(scores), missing, (forth + back) / 2, forth + back, forth, back, f)


def sampling_floor(truth: Surface, edge: float, cm_per_unit: float, distance: Distance) -> SurfaceScore:
    """What the truth itself scores when it is sampled twice: no prediction can be told to be better than that."""
    again = Surface(truth.vertices, truth.faces, len(truth.points), seed=7)
    return surface_score(again, truth, IDENTITY, edge, cm_per_unit, distance)


def rotation_errors_deg(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(T,) geodesic errors in degrees of rotations (T, 3, 3), after one global turn of the object's frame.

    The turn A minimises ``sum |P_t A - G_t|^2`` (chordal L2), as in the paper's table of root poses.
    """
    u, _, vt = np.linalg.svd(np.einsum("tji,tjk->ik", predicted, truth))
    turn = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    apart = np.einsum("tji,tjk->tik", predicted @ turn, truth)
    return np.degrees(Rotation.from_matrix(apart).magnitude())


def mask_ious(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(T,) intersection over union of bool masks (T, H, W); 1 where both are empty.

    Predictions of another size are brought to the truth's by the nearest pixel.
    """
    if predicted.shape != truth.shape:
        rows, columns = (
            ((np.arange(truth.shape[k]) + 0.5) * predicted.shape[k] / truth.shape[k]).astype(int) for k in (1, 2)
        )
        predicted = predicted[:, rows][:, :, columns]
    both, either = (predicted & truth).sum(axis=(1, 2)), (predicted | truth).sum(axis=(1, 2))
    return np.where(either > 0, both / np.maximum(either, 1), 1.0)


def endpoint_errors_px(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(..., H, W) lengths of the differences of flow fields (..., H, W, 2)."""
    return np.asarray(np.linalg.norm(predicted - truth, axis=-1))


def tracking_error_cm(
    predicted: Sequence[Surface], truth: Sequence[Surface], similarity: Similarity, cm_per_unit: float
) -> float:
    """How far predicted surface points drift over the true surface, where both topologies stay the same in all frames.

    Each sampled point of the first frame is tied to the nearest point of the true surface; in every later frame
    the tied points should still meet. What they are apart more than in the first frame is the drift; its mean.

    Args:
        predicted: a mesh a frame, with the same vertices and faces throughout. truth: likewise.
    """
    first, count = predicted[0], len(predicted[0].vertices)
    if any(len(p.vertices) != count for p in predicted):
        raise ValueError("the predicted meshes do not share their vertices")
    vertex = np.unique(np.linspace(0, count - 1, min(count, 2000)).astype(int))
    start = similarity(first.vertices[vertex])
    spot, _ = truth[0].nearest(start)
    face, weight = _locate(truth[0], spot)
    offset = start - spot
    drift = []
    for p, t in zip(predicted[1:], truth[1:], strict=True):
        tied = np.einsum("nk,nkc->nc", weight, t.vertices[t.faces[face]])
        gap = np.linalg.norm(similarity(p.vertices[vertex]) - tied, axis=1)
        drift.append(np.maximum(gap - np.linalg.norm(offset, axis=1), 0))
    return cm_per_unit * float(np.mean(drift)) if drift else 0.0


def _locate(surface: Surface, spots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face (N,) and barycentric weights (N, 3) of points that lie on a surface."""
    from scipy.spatial import cKDTree

    tree = cKDTree(surface.vertices[surface.faces].mean(axis=1))
    _, near = tree.query(spots, k=min(32, len(surface.faces)))
    near = near.reshape(len(spots), -1)
    corner = surface.vertices[surface.faces[near]]
    a, b = corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]
    p = spots[:, None] - corner[:, :, 0]
    aa, ab, bb = ((x * y).sum(axis=-1) for x, y in ((a, a), (a, b), (b, b)))
    pa, pb = (p * a).sum(axis=-1), (p * b).sum(axis=-1)
    scale = np.maximum(aa * bb - ab * ab, 1e-30)
    v, w = (bb * pa - ab * pb) / scale, (aa * pb - ab * pa) / scale
    weight = np.clip(np.stack([1 - v - w, v, w], axis=-1), 0, None)
    weight /= weight.sum(axis=-1, keepdims=True)
    gap = np.linalg.norm((weight[..., None] * corner).sum(axis=2) - spots[:, None], axis=-1)
    best = gap.argmin(axis=1)
    rows = np.arange(len(spots))
    return near[rows, best], weight[rows, best]
