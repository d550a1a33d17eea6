"""How far a result can be trusted: figures from the posed mesh, the masks and the cameras, and plain advice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from stages.geometry.raster import Fragments, face_normals, project
from stages.meshing.surface import Mesh, SurfaceFacts

POOR_OUTLINE = 0.6
POOR_CONFIDENCE = 0.5
_SIDES = {(0, 1): "left (+x)", (0, -1): "right (-x)", (1, 1): "top (+y)", (1, -1): "under (-y)"}
_SIDES |= {(2, 1): "front (+z)", (2, -1): "back (-z)"}


def mask_iou(silhouette: np.ndarray, mask: np.ndarray) -> float:
    """Intersection over union of two (H, W) bool images; 1 when both are empty."""
    union = float((silhouette | mask).sum())
    return float((silhouette & mask).sum()) / union if union else 1.0


def mask_misfit(silhouette: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """Share of the mask that the model leaves uncovered, and area of the model beyond the mask over the mask's."""
    area = max(float(mask.sum()), 1.0)
    return float((mask & ~silhouette).sum()) / area, float((silhouette & ~mask).sum()) / area


def visible_vertices(
    vertices_camera: np.ndarray,
    normals_camera: np.ndarray,
    intrinsics: np.ndarray,
    fragments: Fragments,
    mask: np.ndarray,
    slack: float,
) -> np.ndarray:
    """(V,) bool: vertices inside the image and the mask, turned to the camera, and not behind another surface.

    Args:
        vertices_camera, normals_camera: (V, 3), camera frame.
        fragments: what :func:`rasterise` made of the same mesh; mask: (H, W) bool of the same size.
        slack: how far behind the depth buffer a vertex may lie and still count as its surface.
    """
    height, width = mask.shape
    ahead = vertices_camera[:, 2] > 0.02
    pixel = np.floor(project(np.where(ahead[:, None], vertices_camera, 1.0), intrinsics)).astype(int)
    inside = ahead & (pixel >= 0).all(axis=1) & (pixel[:, 0] < width) & (pixel[:, 1] < height)
    facing = -(normals_camera * vertices_camera).sum(axis=1) > 0.1 * np.linalg.norm(vertices_camera, axis=1)
    candidate = np.flatnonzero(inside & facing)
    column, row = pixel[candidate, 0], pixel[candidate, 1]
    hit = mask[row, column] & (vertices_camera[candidate, 2] <= fragments.depth[row, column] + slack)
    seen = np.zeros(len(vertices_camera), bool)
    seen[candidate[hit]] = True
    return seen


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) a third of the area of the faces about each vertex."""
    area = np.linalg.norm(face_normals(vertices, faces), axis=1) / 6
    return np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(vertices))


def unseen_side(areas: np.ndarray, normals: np.ndarray, seen: np.ndarray) -> str | None:
    """Which way the unseen surface mostly looks, in words; None when it looks every way."""
    hidden = areas * ~seen
    total = hidden.sum()
    mean = (normals * hidden[:, None]).sum(axis=0) / max(total, 1e-12)
    axis = int(np.abs(mean).argmax())
    if total <= 0 or abs(mean[axis]) < 0.3:
        return None
    return _SIDES[axis, 1 if mean[axis] > 0 else -1]


@dataclass(frozen=True)
class ClipQuality:
    """Figures of one video. Arrays are a kept frame each; NaN where there is nothing to compare with.

    missing: share of the mask that the model does not cover; extra: area of the model beyond the mask, over the mask's.
    """

    name: str
    source_idx: np.ndarray
    iou: np.ndarray
    missing: np.ndarray
    extra: np.ndarray
    root_confidence: np.ndarray
    mask_confidence: np.ndarray
    flags: list[list[str]]
    source_frames: int
    skinning_error_8: float
    skinning_error_4: float
    mask_area_px: np.ndarray

    @property
    def unexplained(self) -> float:
        """Share of the object's area, over all compared frames together, that the model does not cover."""
        return unexplained_share([self])

    def as_json(self) -> dict[str, object]:
        """For ``quality.json``."""
        rows = []
        for i in range(len(self.source_idx)):
            flags = list(self.flags[i])
            if self.iou[i] < POOR_OUTLINE:
                flags.append("outline")
            if self.root_confidence[i] < POOR_CONFIDENCE:
                flags.append("pose")
            row: dict[str, Any] = {"source_idx": int(self.source_idx[i]), "iou": number(self.iou[i])}
            row |= {"missing": number(self.missing[i]), "extra": number(self.extra[i])}
            row |= {"root_confidence": number(self.root_confidence[i])}
            rows.append(row | {"mask_confidence": number(self.mask_confidence[i]), "flags": flags})
        return {
            "iou_mean": mean_number(self.iou),
            "iou_worst": number(np.nanmin(self.iou)) if np.isfinite(self.iou).any() else None,
            "missing_mean": mean_number(self.missing),
            "extra_mean": mean_number(self.extra),
            "unexplained_mask_area": number(self.unexplained),
            "root_confidence_mean": mean_number(self.root_confidence),
            "mask_confidence_mean": mean_number(self.mask_confidence),
            "kept_frames": len(self.source_idx),
            "source_frames": self.source_frames,
            "skinning_error": {"8": number(self.skinning_error_8, 6), "4": number(self.skinning_error_4, 6)},
            "frames": rows,
        }


def unexplained_share(clips: Sequence[ClipQuality]) -> float:
    """Area of the masks that the model does not cover, over the area of the masks; NaN where nothing was compared."""
    uncovered = total = 0.0
    for clip in clips:
        there = np.isfinite(clip.missing)
        uncovered += float((clip.missing[there] * clip.mask_area_px[there]).sum())
        total += float(clip.mask_area_px[there].sum())
    return uncovered / total if total else float("nan")


def number(value: float, digits: int = 4) -> float | None:
    """A rounded plain float, None if it is not finite: JSON has no NaN."""
    return round(float(value), digits) if np.isfinite(value) else None


def mean_number(values: np.ndarray) -> float | None:
    """Mean of what is finite, rounded."""
    finite = values[np.isfinite(values)]
    return number(finite.mean()) if len(finite) else None


@dataclass(frozen=True)
class Verdict:
    """trust: 0 (do not use) to 1; parts: what it is the least of; word: the same in a word; advice: sentences."""

    trust: float
    parts: dict[str, float]
    word: str
    advice: list[str]


def judge(
    clips: Sequence[ClipQuality],
    pose_trust: float | None,
    pose_advice: str | None,
    unseen: float,
    side: str | None,
    dropped_area: float,
    level: float,
) -> Verdict:
    """Overall trust, as weak as its weakest part, and what the user can do about it.

    A good outline with doubtful root poses is not a good model (a mirrored or collapsed shape can fill every mask),
    so none of the parts can make up for another.
    """
    iou = _mean([c.iou for c in clips])
    masks = _mean([c.mask_confidence for c in clips])
    roots = pose_trust if pose_trust is not None else _mean([c.root_confidence for c in clips])
    parts = {
        "outline": float(np.clip((iou - 0.4) / 0.45, 0, 1)),
        "complete": float(np.clip(1 - 3 * (_mean([c.missing for c in clips]) - 0.05), 0, 1)),
        "masks": float(np.clip(masks, 0, 1)),
        "root_poses": float(np.clip(roots, 0, 1)),
        "seen": float(np.clip(1.5 * (1 - unseen), 0, 1)),
    }
    trust = 0.0 if level != 0 else min(parts.values())
    word = "good" if trust >= 0.75 else "usable with care" if trust >= 0.45 else "doubtful"

    advice = []
    if level != 0:
        advice.append("The optimisation ended without a surface; what is exported is a guess of its rough place only.")
    for clip in clips:
        if np.nanmean(np.append(clip.iou, np.nan if np.isfinite(clip.iou).any() else 1.0)) < POOR_OUTLINE:
            share = float((clip.iou[np.isfinite(clip.iou)] < POOR_OUTLINE).mean())
            advice.append(f"{clip.name}: the model misses the object's outline in {share:.0%} of the frames.")
        missing, extra = mean_number(clip.missing) or 0.0, mean_number(clip.extra) or 0.0
        if missing > 0.1:
            advice.append(f"{clip.name}: {missing:.0%} of the object is not in the model; look for lost or thin limbs.")
        if extra > 0.25:
            advice.append(f"{clip.name}: the model covers {extra:.0%} more than the object does; it is too fat or off.")
        poor = float((clip.mask_confidence < POOR_CONFIDENCE).mean())
        if poor > 0.25:
            advice.append(f"{clip.name}: {poor:.0%} of the frames have poor masks; put better ones beside the video.")
    if parts["root_poses"] < POOR_CONFIDENCE:
        advice.append(
            f"The viewing directions are uncertain ({parts['root_poses']:.2f}), so the shape may be flattened, doubled"
            " or mirrored; slow clips that go all the way round the object help most, or give poses beside the video."
        )
    if pose_advice:
        advice.append(pose_advice)
    if unseen > 0.15:
        if parts["root_poses"] < POOR_CONFIDENCE:
            side = None  # the model's axes mean nothing then
        where = f", mostly its {side} side: add a clip from there" if side else ": add clips from other sides"
        advice.append(f"{unseen:.0%} of the surface was never seen{where}.")
    worst = max((c.skinning_error_8 for c in clips), default=0.0)
    if worst > 5e-3:
        advice.append(f"The rig in model.glb follows the model only to {worst:.1%} of the object's length.")
    if dropped_area > 0.05:
        advice.append(f"Loose pieces ({dropped_area:.0%} of the surface) were left out of the mesh.")
    return Verdict(trust, parts, word, advice)


def _mean(values: list[np.ndarray]) -> float:
    everything = np.concatenate(values) if values else np.zeros(0)
    finite = everything[np.isfinite(everything)]
    return float(finite.mean()) if len(finite) else 0.0


def report(
    mesh: Mesh,
    normals: np.ndarray,
    facts: SurfaceFacts,
    clips: Sequence[ClipQuality],
    views: np.ndarray,
    pose_summary: dict[str, Any],
) -> dict[str, Any]:
    """Everything in ``quality.json``.

    Args:
        mesh, normals, facts: the surface at rest.
        views: (V,) frames that saw each vertex.
        pose_summary: ``poses.json``: its `trust` and `advice` are used if they are there.
    """
    areas = vertex_areas(mesh.vertices, mesh.faces)
    unseen = float(areas[views == 0].sum() / max(areas.sum(), 1e-12))
    trust, advice = pose_summary.get("trust"), pose_summary.get("advice")
    verdict = judge(
        clips,
        float(trust) if isinstance(trust, int | float) else None,
        advice if isinstance(advice, str) else None,
        unseen,
        unseen_side(areas, normals, views > 0),
        facts.dropped_area,
        facts.level,
    )
    return {
        "trust": round(verdict.trust, 3),
        "verdict": verdict.word,
        "trust_parts": {k: round(v, 3) for k, v in verdict.parts.items()},
        "advice": verdict.advice,
        "iou_mean": mean_number(np.concatenate([c.iou for c in clips])),
        "unseen_area": round(unseen, 4),
        "unexplained_mask_area": number(unexplained_share(clips)),
        "skinning_error": number(max(c.skinning_error_8 for c in clips), 6),
        "skinning_error_4": number(max(c.skinning_error_4 for c in clips), 6),
        "length": mesh.length,
        **asdict(facts),
        "videos": {c.name: c.as_json() for c in clips},
        "views_per_vertex": views.astype(int).tolist(),
    }
