"""Is the object of a clip a quadruped, a person or something else? Each category's network is asked, on some frames.

Two answers are joined: what the network calls the masked object, and how well the mask that it finds without being
shown one covers the given mask. An object that no network can find again is `other`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stages.perception.descriptors import crop_box, crop_resize
from stages.perception.viewpoint import INPUT_PX, PoseNetwork, mask_box, normalised, prompted_input

OTHER = "other"
LEAST_NAMED, LEAST_EXPLAINED = 0.6, 0.35
"""Below this mean probability, or this overlap of masks, the object is called `other`."""
_MARGIN = 1.35
_MOST_FRAMES = 16


@dataclass(frozen=True)
class Verdict:
    """What the object is, and what spoke for it."""

    category: str
    margin: float
    """Score of the best category less that of the next, 0..1."""
    named: dict[str, float]
    """Mean probability of each category, by the network's own word."""
    explained: dict[str, float]
    """Mean overlap (IoU) of the mask that the category's network finds by itself with the mask given."""


def choose_category(frames: np.ndarray, masks: np.ndarray, sessions: Mapping[str, PoseNetwork]) -> Verdict:
    """Judge a clip: `frames` (T, H, W, 3) uint8 RGB, `masks` (T, H, W) uint8; networks by category, in the order of
    their `category` output.
    """
    boxes = [mask_box(mask) for mask in masks]
    seen = [i for i, box in enumerate(boxes) if box.any()]
    seen = [seen[k] for k in np.unique(np.linspace(0, len(seen) - 1, _MOST_FRAMES).astype(int))] if seen else []
    names = list(sessions)
    if not seen:
        return Verdict(OTHER, 0.0, dict.fromkeys(names, 0.0), dict.fromkeys(names, 0.0))
    height, width = masks.shape[1:]
    named = {name: 0.0 for name in names}
    explained = {name: 0.0 for name in names}
    for i in seen:
        close, wide = crop_box(boxes[i], width, height), crop_box(boxes[i], width, height, _MARGIN)
        alone = np.concatenate([normalised(crop_resize(frames[i], wide, INPUT_PX)), np.zeros((1, INPUT_PX, INPUT_PX))])
        inputs = np.stack([prompted_input(frames[i], masks[i], close), alone.astype(np.float32)])
        for k, (name, session) in enumerate(sessions.items()):
            answer = session(inputs)
            chance = np.exp(answer["category"][0].astype(np.float64) - answer["category"][0].max())
            named[name] += float(chance[k] / chance.sum()) / len(seen)
            found = answer["dense"][1, 0] > 0
            truth = crop_resize(masks[i].astype(np.float32), wide, len(found)) > 127
            explained[name] += float((found & truth).sum() / max((found | truth).sum(), 1)) / len(seen)
    score = {name: named[name] * explained[name] for name in names}
    order = sorted(names, key=lambda name: -score[name])
    best = order[0]
    margin = score[best] - (score[order[1]] if len(order) > 1 else 0.0)
    known = named[best] >= LEAST_NAMED and explained[best] >= LEAST_EXPLAINED
    return Verdict(best if known else OTHER, margin, named, explained)
