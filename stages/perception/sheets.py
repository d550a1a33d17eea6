"""Contact sheets of what perception made, as (H, W, 3) uint8 RGB arrays."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

TILE_PX = 192
COLUMNS = 6


def pick(count: int, most: int = 18) -> np.ndarray:
    """Up to `most` indices spread evenly over `count`."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def tile(images: Sequence[np.ndarray], columns: int = COLUMNS, side_px: int = TILE_PX) -> np.ndarray:
    """Pictures (H, W, 3) uint8 of any size, each fitted into a square, in rows of `columns`."""
    cells = []
    for image in images:
        scale = side_px / max(image.shape[:2])
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        cell = np.full((side_px, side_px, 3), 24, np.uint8)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        top, left = (side_px - size[1]) // 2, (side_px - size[0]) // 2
        cell[top : top + size[1], left : left + size[0]] = small
        cells.append(cell)
    while len(cells) % columns:
        cells.append(np.full((side_px, side_px, 3), 24, np.uint8))
    rows = [np.concatenate(cells[i : i + columns], axis=1) for i in range(0, len(cells), columns)]
    return np.concatenate(rows, axis=0)


def frame_sheet(images: np.ndarray) -> np.ndarray:
    """Frames (T, H, W, 3) uint8, evenly spread."""
    return tile([images[i] for i in pick(len(images))])


def mask_overlay(image: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """An image with the background darkened and blue, and the mask's outline green; probability (H, W) uint8."""
    inside = probability > 127
    out = image.copy()
    out[~inside] = out[~inside] // 3 + np.array([0, 0, 60], np.uint8)
    eroded = cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    out[inside & ~eroded] = (0, 255, 0)
    return out


def mask_sheet(images: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Masks (T, H, W) uint8 over frames (T, H, W, 3)."""
    return tile([mask_overlay(images[i], masks[i]) for i in pick(len(images))])


def flow_colours(flow: np.ndarray, weight: np.ndarray, largest_px: float = 0.0) -> np.ndarray:
    """Flow (H, W, 2) on the colour wheel: hue is direction, saturation length; dark where `weight` (H, W) is 0."""
    length = np.linalg.norm(flow, axis=-1)
    on = weight > 0
    top = largest_px or (float(np.quantile(length[on], 0.98)) if on.any() else 1.0)
    hue = (np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360.0) / 2.0
    saturation = np.clip(length / max(top, 1e-6), 0, 1) * 255
    hsv = np.stack([hue, saturation, 40 + 215 * np.clip(weight, 0, 1)], axis=-1).astype(np.uint8)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def feature_colours(features: np.ndarray) -> np.ndarray:
    """Features (T, S, S, C), zero off the object, as their first three principal components: (T, S, S, 3) uint8."""
    flat = features.reshape(-1, features.shape[-1]).astype(np.float32)
    on = (flat != 0).any(axis=1)
    out = np.full((len(flat), 3), 24, np.uint8)
    if on.sum() > 3:
        values = flat[on] - flat[on].mean(axis=0)
        _, _, axes = np.linalg.svd(values[:: max(1, len(values) // 20000)], full_matrices=False)
        projected = values @ axes[:3].T
        low, high = np.quantile(projected, [0.02, 0.98], axis=0)
        out[on] = np.clip((projected - low) / np.maximum(high - low, 1e-6) * 235 + 20, 0, 255).astype(np.uint8)
    return out.reshape(*features.shape[:3], 3)


def feature_sheet(features: np.ndarray) -> np.ndarray:
    """Features (T, S, S, C) of evenly spread frames, in the colours of their principal components."""
    chosen = pick(len(features))
    return tile(list(feature_colours(np.asarray(features[chosen]))))
