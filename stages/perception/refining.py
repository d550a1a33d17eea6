"""A rough mask made exact by a network that sees the picture and the rough mask on a crop round the object.

It was trained on generated animals and people (training/refine.py) and serves any object: what the object is, the rough
mask says; where it ends, the picture.
"""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from stages.perception.descriptors import crop_resize
from stages.perception.temporal import main_component, mask_box
from stages.perception.viewpoint import normalised

SIDE_PX = 256
"""Side of the crop that the network is shown. It was trained at 192, but what it misses is thin limbs and outlines, and
at 256 it sees them larger; at 320 little more is gained."""
MARGIN = 1.3
"""Side of the crop over the longer side of the rough mask's box."""
_BATCH = 8
_OFF_LOGIT = -6.0


class RefiningNetwork(Protocol):
    """As training/export.py writes it."""

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """(N, S, S) logits of (N, 4, S, S) float32: crop normalised by ImageNet's mean and deviation, rough mask."""
        ...


def refine(frames: np.ndarray, rough: np.ndarray, network: RefiningNetwork) -> np.ndarray:
    """(T, H, W) float32 probability in place of `rough` (T, H, W) in 0..1, of `frames` (T, H, W, 3) uint8 RGB.

    A frame whose rough mask is empty stays as it is.
    """
    out = rough.astype(np.float32, copy=True)
    crops = {t: crop for t, mask in enumerate(rough) if (crop := crop_round(mask)) is not None}
    rows = list(crops)
    for first in range(0, len(rows), _BATCH):
        part = rows[first : first + _BATCH]
        inputs = np.stack([_input(frames[t], out[t], crops[t]) for t in part])
        for t, logit in zip(part, network(inputs), strict=True):
            out[t] = 1.0 / (1.0 + np.exp(-_pasted(logit, crops[t], rough.shape[2], rough.shape[1])))
    return out


def crop_round(mask: np.ndarray) -> np.ndarray | None:
    """(4,) square crop x0, y0, x1, y1 in pixels round the main piece of a probability (H, W); None if there is none."""
    box = mask_box(main_component(mask > 0.4, mask))
    if not box.any():
        return None
    centre, half = (box[:2] + box[2:]) / 2, max(float((box[2:] - box[:2]).max()), 8.0) * MARGIN / 2
    return np.concatenate([centre - half, centre + half])


def _input(frame: np.ndarray, rough: np.ndarray, crop: np.ndarray) -> np.ndarray:
    return np.concatenate([normalised(crop_resize(frame, crop, SIDE_PX)), crop_resize(rough, crop, SIDE_PX)[None]])


def _pasted(logit: np.ndarray, crop: np.ndarray, width: int, height: int) -> np.ndarray:
    """(H, W) logits of a map on a crop, far below zero off it."""
    scale = len(logit) / (crop[2] - crop[0])
    columns = ((np.arange(width) + 0.5 - crop[0]) * scale - 0.5).astype(np.float32)
    rows = ((np.arange(height) + 0.5 - crop[1]) * scale - 0.5).astype(np.float32)
    x, y = np.meshgrid(columns, rows)
    at = logit.astype(np.float32)
    return cv2.remap(at, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=_OFF_LOGIT)
