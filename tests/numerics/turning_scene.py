"""A lopsided body of coloured balls that turns before a camera: exact pictures, masks, flow and poses."""

from __future__ import annotations

import numpy as np

from stages.registration.cues import CROP_MARGIN, Cues, crop_frame
from stages.registration.placing import default_intrinsics, mask_boxes, transforms, view_rotation

# centre (x left, y up, z front), radius, colour: a beast with a red head in front, a blue tail, a green left flank
BEAST = (
    ((0.0, 0.0, 0.0), 0.38, (0.75, 0.70, 0.55)),
    ((0.0, 0.05, -0.45), 0.30, (0.70, 0.65, 0.50)),
    ((0.0, 0.30, 0.70), 0.28, (0.90, 0.20, 0.15)),
    ((0.0, 0.25, -0.85), 0.14, (0.15, 0.25, 0.90)),
    ((0.28, -0.05, 0.05), 0.20, (0.20, 0.75, 0.25)),
    ((-0.18, -0.45, 0.3), 0.14, (0.35, 0.30, 0.25)),
    ((0.18, -0.45, -0.4), 0.14, (0.35, 0.30, 0.25)),
)


def cast(pose: np.ndarray, intrinsics: np.ndarray, side: int, balls=BEAST) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Picture (S, S, 3) in 0..1, mask (S, S) bool and the surface points (S, S, 3) in object space."""
    column, row = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    ray = np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(intrinsics).T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    nearest = np.full((side, side), np.inf)
    picture = np.zeros((side, side, 3))
    for centre, radius, colour in balls:
        c = pose[:3, :3] @ np.array(centre) + pose[:3, 3]
        along = ray @ c
        inside = along**2 - (c @ c - radius**2)
        distance = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf)
        hit = distance < nearest
        nearest[hit] = distance[hit]
        normal = (ray * np.where(hit, distance, 0)[..., None] - c) / radius
        shade = 0.75 - 0.25 * normal[..., 1:2]
        picture = np.where(hit[..., None], np.array(colour) * shade, picture)
    mask = np.isfinite(nearest)
    camera = ray * np.where(mask, nearest, 0)[..., None]
    return picture, mask, (camera - pose[:3, 3]) @ pose[:3, :3]


def clip_of(
    azimuth: np.ndarray,
    elevation: float = 0.3,
    side: int = 96,
    distance: float = 3.2,
    focal: float = 1.3,
    step: int = 1,
    balls=BEAST,
) -> tuple[Cues, np.ndarray]:
    """Cues of a clip with exact masks and flow, and its true object-to-camera transforms (T, 4, 4)."""
    intrinsics = default_intrinsics(side, side, focal * side)
    rotation = view_rotation(azimuth, np.full(len(azimuth), elevation))
    poses = transforms(rotation, np.tile([0.0, 0.0, distance], (len(azimuth), 1)))
    casts = [cast(pose, intrinsics, side, balls) for pose in poses]
    masks = np.stack([m for _, m, _ in casts]).astype(np.uint8) * 255
    boxes, known = mask_boxes(masks)
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    half = CROP_MARGIN * np.maximum(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]) / 2
    here = np.stack(np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5), -1)
    parts = []
    for i, (picture, mask, points) in enumerate(casts):
        flow = None
        if i + step < len(casts):
            after = points @ poses[i + step, :3, :3].T + poses[i + step, :3, 3]
            seen = after @ intrinsics.T
            motion = np.where(mask[..., None], seen[..., :2] / np.maximum(seen[..., 2:], 1e-6) - here, 0.0)
            flow = (motion.astype(np.float32), mask.astype(np.float32))
        parts.append(crop_frame((picture * 255).astype(np.uint8), masks[i], flow, centre[i], half[i], 48))
    mask, colour, flow_px, confidence = (np.stack(part) for part in zip(*parts, strict=True))
    cut = np.zeros(len(azimuth), bool)
    return Cues(mask, colour, flow_px, confidence, centre, half, boxes, known, cut, step), poses
