"""Masks through time: boxes, areas, what is missing, cut off or jumps, and how far each frame may be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.perception.optical_flow import sample

MISSING_AREA = 5e-4
"""A mask smaller than this fraction of the image counts as missing."""
JUMP_IOU = 0.35
"""Overlap with the neighbour, brought here by flow, below which a mask counts as jumped."""


@dataclass(frozen=True)
class MaskTrack:
    """What can be said of (T, H, W) masks without knowing the truth."""

    box: np.ndarray  # (T, 4) float x0, y0, x1, y1 in pixels, zeros where missing
    area: np.ndarray  # (T,) float, fraction of the image
    overlap: np.ndarray  # (T,) float in 0..1: best overlap with a neighbour brought here by flow
    flags: list[list[str]]  # a frame: subset of "missing", "border", "jumped"


def mask_box(mask: np.ndarray) -> np.ndarray:
    """(4,) x0, y0, x1, y1 of a boolean (H, W) mask, pixel edges; zeros if empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return np.zeros(4)
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], float)


def touches_border(mask: np.ndarray, share: float = 0.03) -> bool:
    """Whether more than `share` of the mask's own extent (square root of its area) lies on the image's border."""
    on_border = mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum()
    return bool(on_border > max(2.0, share * np.sqrt(mask.sum()) * 4))


def intersection_over_union(a: np.ndarray, b: np.ndarray) -> float:
    """Overlap of two boolean masks; 1 if both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def describe(masks: np.ndarray, previous: list[np.ndarray | None]) -> MaskTrack:
    """Boxes, areas, neighbour overlap and flags of boolean (T, H, W) masks.

    `previous[t]` is the mask of frame t-1 brought to frame t by flow, None for the first.
    """
    count = len(masks)
    area = masks.reshape(count, -1).mean(axis=1)
    steps = [1.0 if p is None else intersection_over_union(m, p) for m, p in zip(masks, previous, strict=True)]
    if count > 1:
        steps[0] = steps[1]
    after = [*steps[1:], steps[-1]]
    overlap = np.maximum(steps, after)
    flags: list[list[str]] = []
    for t in range(count):
        row = []
        if area[t] < MISSING_AREA:
            row.append("missing")
        else:
            if touches_border(masks[t]):
                row.append("border")
            if overlap[t] < JUMP_IOU:
                row.append("jumped")
        flags.append(row)
    box = np.stack([mask_box(m) if area[t] >= MISSING_AREA else np.zeros(4) for t, m in enumerate(masks)])
    return MaskTrack(box, area, np.asarray(overlap), flags)


def main_component(mask: np.ndarray, anchor: np.ndarray | None = None, keep_share: float = 0.12) -> np.ndarray:
    """The largest component of a boolean mask and those at least `keep_share` of it; holes of up to 1 % are filled.

    With `anchor` (H, W) float weights, components are ranked by area times mean anchor instead of area.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count <= 1:
        return mask
    sizes = stats[1:, cv2.CC_STAT_AREA].astype(float)
    if anchor is not None:
        sizes = np.bincount(labels.ravel(), weights=anchor.ravel(), minlength=count)[1:]
    kept = np.flatnonzero(sizes >= keep_share * sizes.max()) + 1
    out = np.isin(labels, kept)
    holes, hole_labels, hole_stats, _ = cv2.connectedComponentsWithStats((~out).astype(np.uint8), connectivity=4)
    small = np.flatnonzero(hole_stats[1:, cv2.CC_STAT_AREA] < 0.01 * out.sum()) + 1
    return out | np.isin(hole_labels, small) if holes > 1 else out


def flow_median(soft: np.ndarray, to_next: list[np.ndarray], to_previous: list[np.ndarray]) -> np.ndarray:
    """(T, h, w) maps; those that flicker are blended with the median of themselves and their neighbours along the flow.

    `to_next[t]` is the flow t -> t+1 and `to_previous[t]` t+1 -> t, at any smaller size. A frame flickers when its
    mask differs from that median by much more than is usual in the clip; the others keep their fast thin limbs.
    """
    count, height, width = soft.shape
    if count < 3:
        return soft
    medians = [soft[0]]
    for t in range(1, count - 1):
        before = sample(soft[t - 1], enlarge(to_previous[t - 1], width, height))
        after = sample(soft[t + 1], enlarge(to_next[t], width, height))
        medians.append(np.median([before, soft[t], after], axis=0))
    medians.append(soft[-1])
    change = np.array([1 - intersection_over_union(s > 0.5, m > 0.5) for s, m in zip(soft, medians, strict=True)])
    flickers = change > 2 * np.median(change) + 0.1
    return np.stack([0.3 * s + 0.7 * m if f else s for s, m, f in zip(soft, medians, flickers, strict=True)])


def area_steadiness(area: np.ndarray, reach: int = 7) -> np.ndarray:
    """(T,) in 0..1: how near each frame's area is to the median of the frames within `reach`; 0 where it is gone."""
    out = np.zeros(len(area))
    for t in range(len(area)):
        usual = float(np.median(area[max(0, t - reach) : t + reach + 1]))
        if min(usual, area[t]) > 0:
            out[t] = min(area[t] / usual, usual / area[t])
    return out


def enlarge(flow: np.ndarray, width: int, height: int) -> np.ndarray:
    """A flow (h, w, 2) at another size, its lengths scaled along."""
    scale = np.array([width / flow.shape[1], height / flow.shape[0]], np.float32)
    return cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR) * scale


def resize_maps(maps: np.ndarray, width: int, height: int) -> np.ndarray:
    """(T, height, width) float32 of maps of another size."""
    kind = cv2.INTER_AREA if width < maps.shape[2] else cv2.INTER_LINEAR
    return np.stack([cv2.resize(m.astype(np.float32), (width, height), interpolation=kind) for m in maps])


def signed_distance(mask: np.ndarray) -> np.ndarray:
    """(h, w) distance to the outline in pixels, positive inside."""
    eight = mask.astype(np.uint8)
    inside = cv2.distanceTransform(eight, cv2.DIST_L2, 3)
    return np.where(mask, inside, -cv2.distanceTransform(1 - eight, cv2.DIST_L2, 3)).astype(np.float32)


def disc(radius: int) -> np.ndarray:
    """(2 r + 1, 2 r + 1) uint8 structuring element."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
