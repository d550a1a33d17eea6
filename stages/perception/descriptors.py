"""A 16-D descriptor of a surface point's looks, with no network: colour at several scales, texture, place in the shape.

Fixed for all clips (nothing is fitted to one), so that the same surface gives the same vector in another clip as far as
its looks allow. Light is taken out in part: lightness is relative to the object's mean in the frame, chroma is
relative to lightness. Two points that look alike get the same descriptor; `match_trust` says how often that is so.
"""

from __future__ import annotations

import cv2
import numpy as np

CROP_MARGIN = 1.2
CHANNELS = 16
CROP_CELLS = 112
SCALES_CELLS = (0.8, 3.0, 8.0)
LEAST_GAP = 0.02  # descriptor distance below which two matches are as good as equal
CHROMA_UNIT, LIGHT_UNIT, TEXTURE_UNIT = 12.0, 0.35, 0.12


def crop_box(box: np.ndarray, width: int, height: int, margin: float = CROP_MARGIN) -> np.ndarray:
    """(4,) square crop x0, y0, x1, y1 in pixels: the longer side of a mask's box times `margin`, about its centre.

    An empty box gives the whole image's square. The crop may reach outside the image.
    """
    if box[2] <= box[0] or box[3] <= box[1]:
        box, margin = np.array([0.0, 0.0, width, height]), 1.0
    centre = (box[:2] + box[2:]) / 2
    half = max(box[2] - box[0], box[3] - box[1]) * margin / 2
    return np.concatenate([centre - half, centre + half])


def crop_resize(image: np.ndarray, crop: np.ndarray, side: int = CROP_CELLS) -> np.ndarray:
    """An image (H, W) or (H, W, C) on the crop's grid of `side` x `side` cells; zero outside the image.

    Cell (r, c) is centred on pixel x0 + (c + 0.5) (x1 - x0) / side; averaged over its area when that is larger than a
    pixel.
    """
    step = (crop[2] - crop[0]) / side
    whole = max(1, round(step))  # so many samples a cell and axis, then averaged
    fine = side * whole
    centres = (np.arange(fine, dtype=np.float32) + 0.5) * np.float32((crop[2] - crop[0]) / fine) - 0.5
    columns, rows = np.meshgrid(centres + np.float32(crop[0]), centres + np.float32(crop[1]))
    sampled = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return cv2.resize(sampled, (side, side), interpolation=cv2.INTER_AREA) if whole > 1 else sampled


def describe_appearance(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(S, S, 16) float32 descriptor of a crop (S, S, 3) uint8 RGB under a mask (S, S) in 0..1; zero off the mask.

    Channels before normalisation: L, a, b blurred within the mask at three scales (9), local contrast at two (2),
    band-pass energy at two (2), depth inside the outline (1), height in the mask (1), a constant (1).
    """
    inside = mask > 0.5
    out = np.zeros((*mask.shape, CHANNELS), np.float32)
    if not inside.any():
        return out
    lab = cv2.cvtColor(image.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    light = lab[..., 0] / max(float(lab[..., 0][inside].mean()), 5.0)
    gain = np.clip(lab[..., 0], 10.0, None) / 50.0
    chroma = lab[..., 1:] / gain[..., None] ** 0.5
    weight = inside.astype(np.float32)
    blurred = [_blur_inside(np.dstack([light, chroma]), weight, s) for s in SCALES_CELLS]
    columns = []
    for layer in blurred:
        columns += [(layer[..., 0] - 1.0) / LIGHT_UNIT, layer[..., 1] / CHROMA_UNIT, layer[..., 2] / CHROMA_UNIT]
    for s in (2.0, 5.0):
        mean = _blur_inside(light[..., None], weight, s)[..., 0]
        square = _blur_inside(light[..., None] ** 2, weight, s)[..., 0]
        columns.append(np.sqrt(np.clip(square - mean**2, 0, None)) / TEXTURE_UNIT - 1.0)
    for fine, coarse in ((0, 1), (1, 2)):
        columns.append((blurred[fine][..., 0] - blurred[coarse][..., 0]) / TEXTURE_UNIT)
    rows = np.flatnonzero(inside.any(axis=1))
    extent = max(rows[-1] - rows[0], 1)
    depth = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 3)
    columns.append(np.minimum(depth / (0.12 * mask.shape[0]), 1.5) - 0.7)
    height = 1.0 - (np.arange(mask.shape[0], dtype=np.float32) - rows[0]) / extent
    columns.append(np.repeat((2.0 * height - 1.0)[:, None], mask.shape[1], axis=1))
    columns.append(np.full(mask.shape, 2.0, np.float32))
    stacked = np.clip(np.stack(columns, axis=-1), -3.0, 3.0)
    return normalise(stacked, inside)


def normalise(values: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Unit length on the object, zero off it; (S, S, C) float32."""
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    return np.where(inside[..., None], values / np.maximum(length, 1e-6), 0.0).astype(np.float32)


def _blur_inside(values: np.ndarray, weight: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur of (S, S, C) that does not mix in what lies off the mask (normalised convolution)."""
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    blurred = cv2.GaussianBlur(values * weight[..., None], (0, 0), sigma).reshape(values.shape)
    return blurred / np.maximum(total, 1e-4)[..., None]


def match_trust(features: np.ndarray, rng: np.random.Generator, pairs: int = 24, samples: int = 64) -> float:
    """How distinctly points of one frame find a place in another, 0..1: mean of 1 - d1/d2 over sampled points.

    d1 is the descriptor distance to the best cell, d2 to the best at least a fifth of the crop away from it. A
    plain-coloured object, on which everything looks alike, comes near 0. `features` is (T, S, S, C).
    """
    count, side = features.shape[:2]
    found = []
    for _ in range(pairs):
        first, second = rng.integers(count, size=2)
        a = features[first].reshape(side * side, -1).astype(np.float32)
        b = features[second].reshape(side * side, -1).astype(np.float32)
        on_a, on_b = np.flatnonzero((a != 0).any(axis=1)), np.flatnonzero((b != 0).any(axis=1))
        if first == second or len(on_a) == 0 or len(on_b) < 16:
            continue
        chosen = rng.choice(on_a, min(samples, len(on_a)), replace=False)
        distance = np.sqrt(np.clip(2.0 - 2.0 * a[chosen] @ b[on_b].T, 0, None))
        best = distance.argmin(axis=1)
        place = np.stack([on_b // side, on_b % side], axis=1)
        apart = np.linalg.norm(place[None] - place[best][:, None], axis=-1) > 0.2 * side
        second_best = np.where(apart, distance, np.inf).min(axis=1)
        ok = np.isfinite(second_best)
        found.append(1.0 - (distance[np.arange(len(chosen)), best][ok] + LEAST_GAP) / (second_best[ok] + LEAST_GAP))
    values = np.concatenate(found) if found else np.zeros(0)
    return float(values.mean()) if len(values) else 0.0
