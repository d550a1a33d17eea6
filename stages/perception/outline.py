"""Where exactly the outline runs: each pixel near it weighed between the colours just inside and just outside."""

from __future__ import annotations

import cv2
import numpy as np

from stages.perception.background import to_lab
from stages.perception.temporal import mask_box, signed_distance

_LAB_SCALE = np.array([2.55, 1.0, 1.0], np.float32)
"""Lightness shows an outline better than hue, and survives compression."""
_NOISE_LAB = 4.0
"""Spread of colours that noise alone makes, scaled Lab."""
_PRIOR_SHARE, _PRIOR_LEAST = 0.7, 0.02
"""How much of its log-odds the given probability keeps beside the colours, and what keeps those finite."""


def settle_outline(probability: np.ndarray, image: np.ndarray, reach_px: float = 4.0) -> np.ndarray:
    """Foreground probability (H, W) float32 with its outline moved to where the colours say it is.

    A pixel's share of object is how far its colour lies along the line from the mean colour outside to the mean colour
    inside, both taken within about `reach_px` (the blend of an edge pixel). It counts by how well the two are told
    apart there, and is added to the log-odds of `probability` (H, W) in 0..1 of the 8-bit RGB `image` (H, W, 3).
    What is certain, 0 or 1, and not near the outline, stays so: a fit takes these values as the opacity that it wants.
    """
    prior = np.log((probability + _PRIOR_LEAST) / (1 + _PRIOR_LEAST - probability))
    odds = _PRIOR_SHARE * prior
    part = _surroundings(probability > 0.5, reach_px)
    odds[part] += 2.0 * _looks(probability[part], image[part], reach_px)
    found = 1.0 / (1.0 + np.exp(-odds))
    certain = 1.0 / (1.0 + ((1 + _PRIOR_LEAST) / _PRIOR_LEAST) ** _PRIOR_SHARE)  # what a probability of 0 has become
    return np.clip((found - certain) / (1 - 2 * certain), 0.0, 1.0).astype(np.float32)


def _surroundings(mask: np.ndarray, reach_px: float) -> tuple[slice, slice]:
    """The part of a picture in which colours can move the outline of a mask (H, W); empty if it has none."""
    x0, y0, x1, y1 = (int(v) for v in mask_box(mask))
    margin = int(6 * reach_px) + 1 if x1 > x0 else 0
    return slice(max(0, y0 - margin), y1 + margin), slice(max(0, x0 - margin), x1 + margin)


def _looks(probability: np.ndarray, image: np.ndarray, reach_px: float) -> np.ndarray:
    """(H, W) log-odds by where each colour is between those just outside and just inside; 0 far from both."""
    if probability.size == 0:
        return np.zeros(probability.shape, np.float32)
    rim_px = 0.375 * reach_px
    depth = signed_distance(probability > 0.5)
    lab = to_lab(image) * _LAB_SCALE
    front, front_spread, front_known = _local_colours(lab, depth >= rim_px, reach_px / 2)
    beside = (depth <= -rim_px) & (depth > -3.5 * reach_px)
    back, back_spread, back_known = _local_colours(lab, beside, reach_px / 2)
    line = front - back
    length = np.square(line).sum(-1)
    share = ((lab - back) * line).sum(-1) / np.maximum(length, 1.0)
    apart = np.clip(np.sqrt(length) / (front_spread + back_spread + _NOISE_LAB) - 0.7, 0.0, 2.0)
    return np.clip(4.0 * (share - 0.5), -3.0, 3.0) * apart * (front_known & back_known)


def _local_colours(lab: np.ndarray, chosen: np.ndarray, sigma_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gaussian-weighted mean (H, W, 3), spread (H, W) and presence (H, W) of the `chosen` pixels' colours."""
    weight = chosen.astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), sigma_px) + 1e-6
    mean = cv2.GaussianBlur(lab * weight[..., None], (0, 0), sigma_px) / total[..., None]
    square = cv2.GaussianBlur(lab**2 * weight[..., None], (0, 0), sigma_px) / total[..., None]
    return mean, np.sqrt(np.maximum((square - mean**2).mean(-1), 0.0)), total > 0.01
