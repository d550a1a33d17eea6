"""Which pixels are the object, from motion, place and colour, with no network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from stages.perception.background import border_distance, motion_saliency, shrink
from stages.perception.temporal import main_component

CUE_SIDE_PX = 128


@dataclass(frozen=True)
class Hint:
    """What the user says of one frame, in pixels of the kept frames."""

    frame_idx: int
    box: np.ndarray | None = None  # (4,) x0, y0, x1, y1: the object fills it
    inside: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) clicks on the object
    outside: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) clicks on "not this"


@dataclass(frozen=True)
class Segmentation:
    """Foreground probability (T, H, W) uint8 and how well the cues agreed a frame (T,) in 0..1."""

    probability: np.ndarray
    agreement: np.ndarray


def segment(
    images: np.ndarray,
    hints: tuple[Hint, ...] = (),
    tick: Callable[[int, int, str], None] = lambda done, total, label: None,
) -> Segmentation:
    """Foreground probability of every frame of a clip, (T, H, W, 3) uint8 RGB."""
    count, height, width = images.shape[:3]
    small = [shrink(image, CUE_SIDE_PX) for image in images]
    grey = [cv2.cvtColor(s, cv2.COLOR_RGB2GRAY) for s in small]
    distance = border_distance(*grey[0].shape)
    trust = np.where(distance > 0.55, 1.0, 0.25).astype(np.float32)
    motion = motion_saliency(grey, lambda t: trust, tick=lambda done: tick(done, count, "motion"))
    soft = _appearance(small, motion, distance)
    out = np.zeros((count, height, width), np.uint8)
    agreement = np.zeros(count)
    for t in range(count):
        prior = cv2.resize(soft[t], (width, height), interpolation=cv2.INTER_LINEAR)
        cut = main_component(grab_cut(images[t], prior), prior)
        agreement[t] = np.count_nonzero(cut & (prior > 0.5)) / max(np.count_nonzero(cut | (prior > 0.5)), 1)
        out[t] = np.round(255 * np.where(cut, np.maximum(prior, 0.55), np.minimum(prior, 0.45))).astype(np.uint8)
        tick(t + 1, count, "cutting")
    return Segmentation(out, agreement)


def grab_cut(image: np.ndarray, prior: np.ndarray, iterations: int = 2) -> np.ndarray:
    """Boolean (H, W) cut of an RGB image along its edges, started from a foreground probability (H, W)."""
    marks = np.where(prior > 0.5, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    marks[prior > 0.97], marks[prior < 0.05] = cv2.GC_FGD, cv2.GC_BGD
    foreground = (marks == cv2.GC_FGD) | (marks == cv2.GC_PR_FGD)
    if not 20 <= np.count_nonzero(foreground) <= foreground.size - 20:
        return foreground
    bgr = np.ascontiguousarray(image[:, :, ::-1])
    cv2.grabCut(bgr, marks, None, np.zeros((1, 65)), np.zeros((1, 65)), iterations, cv2.GC_INIT_WITH_MASK)
    return (marks == cv2.GC_FGD) | (marks == cv2.GC_PR_FGD)


def _appearance(small: list[np.ndarray], motion: np.ndarray, distance: np.ndarray, rounds: int = 4) -> np.ndarray:
    """(T, h, w) probability from colour histograms of the whole clip, learnt from the moving middle, in rounds."""
    count = len(small)
    lab = np.stack([cv2.cvtColor(s, cv2.COLOR_RGB2LAB) for s in small])
    cell = (lab[..., 0] // 16).astype(np.int64) * 1024 + (lab[..., 1] // 8) * 32 + lab[..., 2] // 8
    soft = motion * np.exp(-0.5 * (distance / 0.6) ** 4)
    top = np.quantile(soft.reshape(count, -1), 0.97, axis=1)[:, None, None]
    soft = np.clip(soft / np.maximum(top, 0.15), 0, 1).astype(np.float32)
    for _ in range(rounds):
        ratio = np.log(
            _histogram(cell, np.where(soft > 0.6, soft, 0)) / _histogram(cell, np.where(soft < 0.35, 1 - soft, 0))
        )
        votes = np.clip(ratio[cell], -4, 4).astype(np.float32)
        logit = np.stack(
            [
                0.9 * cv2.GaussianBlur(votes[t], (0, 0), 1.0)
                + 4.0 * (cv2.GaussianBlur(soft[t], (0, 0), 5.0) - 0.35)
                + 3.0 * (motion[t] - 0.35)
                for t in range(count)
            ]
        )
        soft = 1.0 / (1.0 + np.exp(-logit))
    return soft


def _histogram(cell: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Normalised, smoothed weights of 16 x 32 x 32 Lab cells, never zero."""
    counts = np.bincount(cell.ravel(), weights=weight.ravel(), minlength=16 * 32 * 32).reshape(16, 32, 32)
    for axis in range(3):
        counts = counts + 0.4 * (np.roll(counts, 1, axis) + np.roll(counts, -1, axis))
    return (counts / max(counts.sum(), 1e-9) + 1e-6).ravel()
