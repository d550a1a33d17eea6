"""Frames of a clip as the search compares them: windows about the mask's centroid, in two scales.

*Like* windows are as wide as the square root of the mask's area asks for, so that a picture can be compared with a
rendered view without knowing its distance. *True* windows span ``+-EXTENT`` units, once the scale is estimated.
"""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import grid_sample

from stages.registration.cues import CROP_MARGIN, Cues
from stages.registration.volume import EXTENT, Picture, centre_and_area, pixel_grid

LIKE_HALF = 1.8
"""Half the side of a like window over the square root of the mask's area."""


class Windows:
    """Some frames of one clip. `units` (T,) is the estimate of object units in half a crop."""

    def __init__(self, cues: Cues, frame_idx: np.ndarray, size: int) -> None:
        some = cues.select(frame_idx)
        self.frame_idx, self.size, self.count = frame_idx, size, len(frame_idx)
        self.mask = torch.as_tensor(some.mask)
        colour = torch.as_tensor(some.colour)
        total = self.mask.sum().clamp(min=1.0)
        brightness = ((colour[..., :3] * self.mask[..., None]).sum((0, 1, 2)) / total).mean()
        scale = torch.ones(colour.shape[-1])
        scale[:3] = brightness.clamp(min=1e-3)  # exposure differs from clip to clip
        self.colour = colour / scale
        self.weight = torch.as_tensor(np.where(some.cut, 0.3, 1.0) * some.known, dtype=torch.float32)
        self.centre, self.area = centre_and_area(self.mask)
        self.half = half = torch.as_tensor(some.half_px, dtype=torch.float32)
        # first guess: the camera keeps its distance, and the object shows its full length (2 units) at times
        self.first_units = CROP_MARGIN * half / torch.quantile(half, 0.8)
        self.units = self.first_units.clone()

    def whiten(self, mean: torch.Tensor, deviation: torch.Tensor) -> None:
        """Colours (whole collection) to zero mean and unit total variance."""
        self.colour = (self.colour - mean) / deviation

    def _cut(self, half: torch.Tensor) -> torch.Tensor:
        at = pixel_grid(self.size)[None] * half[:, None, None, None] + self.centre[:, None, None]
        image = torch.cat([self.mask[:, None], (self.colour * self.mask[..., None]).permute(0, 3, 1, 2)], 1)
        return grid_sample(image, at, align_corners=False)

    def like(self) -> torch.Tensor:
        """(T, 1 + C, S, S): mask and colour times mask, scaled by area."""
        return self._cut(LIKE_HALF * self.area.sqrt())

    def true(self) -> torch.Tensor:
        """(T, 1 + C, S, S): mask and colour times mask, in object units about the mask's centroid."""
        return self._cut(EXTENT / self.units)


def whiten_together(windows: list[Windows]) -> None:
    """Bring the colours of a collection to zero mean and unit total variance, and likewise its embeddings if any."""
    colours = torch.cat([w.colour[w.mask > 0.5] for w in windows])
    mean = colours.mean(0)
    variance = (colours - mean).pow(2).mean(0)
    deviation = torch.ones_like(variance)
    for group in (slice(0, 3), slice(3, None)):
        deviation[group] = variance[group].sum().sqrt().clamp(min=1e-3)
    for w in windows:
        w.whiten(mean, deviation)


def like_views(picture: Picture) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rendered views cut as :meth:`Windows.like` cuts frames: (P, 1 + C, S, S).

    Also the square root of their area in units (P,), and their centroids (P, 2) with the window as -1..1.
    """
    centre, area = centre_and_area(picture.opacity)
    root = area.sqrt()
    at = pixel_grid(picture.opacity.shape[-1])[None] * (LIKE_HALF * root)[:, None, None, None] + centre[:, None, None]
    image = torch.cat([picture.opacity[:, None], picture.colour], 1)
    return grid_sample(image, at, align_corners=False), root * EXTENT, centre


def difference(frames: torch.Tensor, views: torch.Tensor, colour_weight: float) -> torch.Tensor:
    """How badly each view explains each frame, (T, P): 0 is perfect, about 1 unrelated.

    Squared difference of the masks plus, where both are object, that of the colours, over the frame's mask area.
    All bilinear, hence one matrix product.
    """
    count, size = len(frames), frames.shape[-1]
    mask, opacity = frames[:, 0], views[:, 0]
    frame_square = (frames[:, 1:] ** 2).sum(1) / mask.clamp(min=0.05)
    view_square = (views[:, 1:] ** 2).sum(1) / opacity.clamp(min=0.05)
    left = torch.cat([mask[:, None], frame_square[:, None], frames[:, 1:]], 1)
    right = torch.cat(
        [
            (colour_weight * view_square - 2 * opacity)[:, None],
            colour_weight * opacity[:, None],
            -2 * colour_weight * views[:, 1:],
        ],
        1,
    )
    product = left.reshape(count, -1) @ right.reshape(len(views), -1).T
    total = product + (mask**2).sum((1, 2))[:, None] + (opacity**2).sum((1, 2))[None]
    return total / mask.sum((1, 2)).clamp(min=0.01 * size**2)[:, None]
