"""What the search sees of a clip: small square crops of masks, colours and flow, all cut round the object alike."""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np

CROP_MARGIN = 1.15
"""Side of the crop over the longer side of the mask's box."""


@dataclass(frozen=True)
class Cues:
    """One clip of T frames as S x S crops. Crop pixel (r, c) is centred on full-image pixel
    ``centre + half * (2 (c + 0.5) / S - 1, 2 (r + 0.5) / S - 1)``.
    """

    mask: np.ndarray  # (T, S, S) float32, foreground probability
    colour: np.ndarray  # (T, S, S, 3 or more) float32: RGB in 0..1, then embeddings if any; zero off the object
    flow_px: np.ndarray  # (T, S, S, 2) float32, full-image pixels to the frame `flow_step` later; zero at the end
    flow_confidence: np.ndarray  # (T, S, S) float32; zero at the end
    centre_px: np.ndarray  # (T, 2) float64
    half_px: np.ndarray  # (T,) float64, half the crop's side
    box_px: np.ndarray  # (T, 4) float64, x0 y0 x1 y1
    known: np.ndarray  # (T,) bool, the mask shows an object
    cut: np.ndarray  # (T,) bool, the object is cut off by the picture's border
    flow_step: int = 1

    def __len__(self) -> int:
        return len(self.mask)

    def select(self, frame_idx: np.ndarray) -> Cues:
        """The cues of some frames (their flow still leads to where it led in the whole clip)."""
        parts = {f.name: getattr(self, f.name)[frame_idx] for f in fields(self) if f.name != "flow_step"}
        return Cues(**parts, flow_step=self.flow_step)


def square_crop(image: np.ndarray, centre_px: np.ndarray, half_px: float, size: int) -> np.ndarray:
    """Area-averaged crop (size, size[, C]) float32 of an (H, W[, C]) image; zero outside the image."""
    scale = size / (2 * half_px)
    taps = max(1, int(np.ceil(1.0 / scale)))  # supersample, so that shrinking averages
    fine = size * taps
    matrix = np.array(
        [
            [
                fine / (2 * half_px),
                0,
                fine / 2 - centre_px[0] * fine / (2 * half_px) + 0.5 * fine / (2 * half_px) - 0.5,
            ],
            [
                0,
                fine / (2 * half_px),
                fine / 2 - centre_px[1] * fine / (2 * half_px) + 0.5 * fine / (2 * half_px) - 0.5,
            ],
        ]
    )
    warped = cv2.warpAffine(image.astype(np.float32), matrix, (fine, fine), flags=cv2.INTER_LINEAR)
    return warped if taps == 1 else cv2.resize(warped, (size, size), interpolation=cv2.INTER_AREA)


def crop_frame(
    image: np.ndarray,
    mask: np.ndarray,
    flow: tuple[np.ndarray, np.ndarray] | None,
    centre: np.ndarray,
    half: float,
    size: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Crops of one frame: mask (S, S), colour (S, S, 3), flow (S, S, 2) in full-image px and its confidence (S, S).

    Colour and flow are averaged over the object only (weights times values over weights), so that neither the
    background nor doubtful flow leaks in at the outline.
    """
    weight = mask.astype(np.float32) / 255.0
    small = square_crop(weight, centre, half, size)
    colour = square_crop(image.astype(np.float32) / 255.0 * weight[..., None], centre, half, size)
    colour = np.where(small[..., None] > 0.05, colour / np.maximum(small[..., None], 0.05), 0.0)
    if flow is None:
        return small, colour, np.zeros((size, size, 2), np.float32), np.zeros((size, size), np.float32)
    trust = flow[1] * (weight > 0.5)
    confidence = square_crop(trust, centre, half, size)
    motion = square_crop(flow[0] * trust[..., None], centre, half, size)
    motion = np.where(confidence[..., None] > 0.05, motion / np.maximum(confidence[..., None], 0.05), 0.0)
    return small, colour, motion, confidence


def crop_embedding(
    embedding: np.ndarray, box: np.ndarray, basis: np.ndarray, centre: np.ndarray, half: float, size: int
) -> np.ndarray:
    """A map (M, M, D), zero off the object, that covers `box` (x0, y0, x1, y1 px), cut as :func:`crop_frame` cuts.

    Its channels are projected on `basis` (D, K); returns (size, size, K) float32, averaged over the object only.
    """
    cells = len(embedding) / (box[2] - box[0])
    centre, half = (centre - box[:2]) * cells, half * cells
    embedding = embedding.astype(np.float32)
    inside = (np.abs(embedding).sum(-1) > 0).astype(np.float32)
    share = square_crop(inside, centre, half, size)
    values = square_crop((embedding @ basis).astype(np.float32), centre, half, size).reshape(size, size, -1)
    return np.where(share[..., None] > 0.05, values / np.maximum(share[..., None], 0.05), 0.0)


def principal_directions(samples: np.ndarray, count: int) -> np.ndarray:
    """Orthonormal directions (D, count) in which (N, D) samples vary most; signs fixed, so that runs agree."""
    centred = samples.astype(np.float64) - samples.mean(axis=0, dtype=np.float64)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    directions = vectors[:, ::-1][:, :count]
    return directions * np.sign(directions[np.abs(directions).argmax(axis=0), np.arange(directions.shape[1])])


def inflate(masks: np.ndarray, iterations: int = 200) -> np.ndarray:
    """Half thickness (T, S, S), in pixels, of a rounded body with these (T, S, S) silhouettes (S even).

    Solves ``laplace(h) = -3`` inside, ``h = 0`` outside, and returns ``sqrt(h)``: a disc becomes nearly a ball
    (exactly so for -4), a bar nearly a round bar (exactly so for -2). No claim beyond being convex towards the camera.
    Solved by relaxation, first at half the resolution, where it converges four times sooner.
    """
    count, size = masks.shape[:2]
    half = masks.reshape(count, size // 2, 2, size // 2, 2).mean(axis=(2, 4))
    coarse = _relax(np.zeros_like(half, np.float32), half > 0.5, iterations)
    return np.sqrt(_relax(4 * coarse.repeat(2, axis=1).repeat(2, axis=2), masks > 0.5, iterations // 5))


def _relax(height: np.ndarray, inside: np.ndarray, iterations: int) -> np.ndarray:
    for _ in range(iterations):
        total = np.zeros_like(height)
        total[:, 1:] += height[:, :-1]
        total[:, :-1] += height[:, 1:]
        total[:, :, 1:] += height[:, :, :-1]
        total[:, :, :-1] += height[:, :, 1:]
        height = inside * (total + 3.0) / 4.0
    return height
