"""What a prompted network is told of each frame: the user's box and clicks, else the box and core of a rough mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stages.perception.segmentation import Hint
from stages.perception.temporal import mask_box


@dataclass(frozen=True)
class Prompt:
    """A box (4,) x0, y0, x1, y1 or none, and clicks (N, 2) on the object and beside it, in pixels of the frame."""

    box: np.ndarray | None
    inside: np.ndarray
    outside: np.ndarray

    @property
    def empty(self) -> bool:
        """Nothing to point at."""
        return self.box is None and len(self.inside) == 0


def prompts_of(masks: np.ndarray, hints: Sequence[Hint]) -> list[Prompt]:
    """A prompt for each frame of rough boolean (T, H, W) masks.

    Hints hold for their own frames, and each kind of hint takes the place of what the mask says: a box for its box,
    clicks on the object for its core, which is the pixel farthest from its outline.
    """
    out = []
    for frame_idx, mask in enumerate(masks):
        own = [h for h in hints if h.frame_idx == frame_idx]
        box = next((h.box for h in own if h.box is not None), mask_box(mask) if mask.any() else None)
        inside = np.concatenate([np.zeros((0, 2)), *[h.inside for h in own]])
        outside = np.concatenate([np.zeros((0, 2)), *[h.outside for h in own]])
        if len(inside) == 0 and mask.any():
            depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
            row, column = np.unravel_index(int(depth.argmax()), depth.shape)
            inside = np.array([[column + 0.5, row + 0.5]])
        out.append(Prompt(box, inside, outside))
    return out
