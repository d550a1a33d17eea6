"""Which frames of a clip to keep: not the standing-still ones, not more than asked for, evenly in time."""

from __future__ import annotations

import cv2
import numpy as np

THUMB_SIDE_PX = 64


def thumbnail(image: np.ndarray) -> np.ndarray:
    """Grey thumbnail of an (H, W, 3) RGB image, longer side 64 px, float32 in 0..255."""
    height, width = image.shape[:2]
    scale = THUMB_SIDE_PX / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    grey = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    return cv2.blur(grey.astype(np.float32), (3, 3))


def moving_frames(thumbs: np.ndarray, least_change: float) -> np.ndarray:
    """(K,) indices of frames that differ from the last kept one; the first frame is always kept.

    `thumbs` is (N, h, w) float32; a frame is static when no part of its thumbnail changed by `least_change` grey
    levels (of 255). Zero keeps every frame.
    """
    kept = [0]
    for idx in range(1, len(thumbs)):
        if least_change <= 0 or np.abs(thumbs[idx] - thumbs[kept[-1]]).max() >= least_change:
            kept.append(idx)
    return np.array(kept, np.int64)


def evenly_in_time(time_s: np.ndarray, count: int) -> np.ndarray:
    """Up to `count` distinct indices into increasing `time_s` (N,), as evenly spread in time as they can be."""
    if count <= 0 or len(time_s) <= count:
        return np.arange(len(time_s))
    if count == 1:
        return np.array([0])
    return _nearest(time_s, np.linspace(time_s[0], time_s[-1], count))


def at_rate(time_s: np.ndarray, fps: float) -> np.ndarray:
    """Indices of the frames nearest to the ticks of `fps` frames a second; all where `fps` is 0."""
    if fps <= 0 or len(time_s) < 2:
        return np.arange(len(time_s))
    ticks = np.arange(time_s[0], time_s[-1] + 0.5 / fps, 1.0 / fps)
    return _nearest(time_s, ticks)


def _nearest(time_s: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    after = np.clip(np.searchsorted(time_s, ticks), 1, len(time_s) - 1)
    before = after - 1
    return np.unique(np.where(ticks - time_s[before] <= time_s[after] - ticks, before, after))


def fit_size(width: int, height: int, max_side_px: int) -> tuple[int, int]:
    """Size with the same aspect whose longer side is at most `max_side_px` (0: as it is); never enlarged."""
    scale = min(1.0, max_side_px / max(width, height)) if max_side_px > 0 else 1.0
    return max(1, round(width * scale)), max(1, round(height * scale))
