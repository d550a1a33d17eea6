"""Frames and parts that masks lost, found again by how the object looks to a network in the clip's other frames.

Fur in the shade of a table has the colours of the floor. What a trained network sees in it (shape, texture, what lies
around) changes less; so a classifier is fitted, in this very clip, to those features where the rough masks are steady,
and read where they are not. Refined masks teach it again where they are in doubt, and then it has a say in every frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from stages.perception.appearance import PixelColours, coloured_surroundings
from stages.perception.temporal import disc, intersection_over_union, main_component, resize_maps, signed_distance
from stages.perception.viewpoint import normalised

LEAST_AGREEMENT = 0.8
"""Overlap of a frame's rough mask and what the classifier says below which the frame counts as lost. Where masks are
right the two overlap by 0.85 and more (fox and dancer: every frame); the classifier's is the coarser."""
LEAST_TRUST = 0.75
"""Median overlap over the frames with steady masks below which the classifier has learnt nothing and is left out."""
LEAST_SIZE = 0.5
"""A find smaller than this share of the object in the steady frames next to it is none: the object may have left."""
DOUBTED_SHARE, CHANGED_SHARE = 0.06, 0.03
"""A piece larger than this share of a mask about which it and the classifier differ, in any frame, asks for a second
look at all; and one after which a frame counts as changed. Where masks are right, the largest is about 0.05."""
OVERRULED_LOGIT = 0.5
"""A label that the classifier contradicts by more than this is left out when it is taught again: a tail that masks lack
for a while looks like the rest of the body."""
CLASSIFIER_SHARE = 2.0
"""How much the classifier's log-odds, and those of hints, count in the second look, beside the refined mask's own."""
ENLARGED = 1.5
"""So much larger than the frames are the pictures whose features count: at 1 tails are lost that are found like this,
at 2 some background is found."""
_AREA_REACH = 8  # frames to each side that say how large the object usually is
_RIM_PX = 1.5  # beside the rough outline nothing is learnt
_FIT_FRAMES = 48
_ONE_PIXEL_IN = 4  # of a frame is learnt from: its neighbours look the same
_ROUNDS = 2
_STEPS, _PIXELS = 240, 2048
_BATCH = 8
_MULTIPLE = 16


class TrunkNetwork(Protocol):
    """As training/export.py writes it."""

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """(N, C, H/8, W/8) features of (N, 3, H, W) pictures normalised by ImageNet's mean and deviation."""
        ...


@dataclass(frozen=True)
class Found:
    """Masks with lost frames mended.

    `probability` (T, h, w) float32 in 0..1; `lost` (T,) bool: which frames were mended; `seen`: what the classifier is
    shown; `said` (T, h/2, w/2) float32: what it says of every frame, None where the features do not tell the object;
    `least` (T,): share of the frame that the object covers at least, unless it has left.
    """

    probability: np.ndarray
    lost: np.ndarray
    seen: Looks
    said: np.ndarray | None
    least: np.ndarray


@dataclass(frozen=True)
class Looks:
    """What a clip's pixels look like: `colours` (T, h, w, 12) in their surroundings, `features` (T, h', w', C)."""

    colours: np.ndarray
    features: np.ndarray

    def of(self, frame_idx: int) -> np.ndarray:
        """(h, w, 12 + C) both, at the size of the colours."""
        colours = self.colours[frame_idx]
        size = colours.shape[1], colours.shape[0]
        features = cv2.resize(self.features[frame_idx].astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        return np.concatenate([colours, features], axis=-1)


def find_again(work: list[np.ndarray], soft: np.ndarray, told: np.ndarray, network: TrunkNetwork, seed: int) -> Found:
    """Lost frames mended in rough masks: probability `soft` (T, h, w) of the frames `work` (h, w, 3) uint8 RGB.

    `told` (T, h, w) are log-odds from hints. Frames that are not lost come back as they are; so does every frame of a
    clip in which the features do not tell the object. Worked out at half the size.
    """
    height, width = soft.shape[1] // 2, soft.shape[2] // 2
    colours = [coloured_surroundings(cv2.resize(x, (width, height), interpolation=cv2.INTER_AREA)) for x in work]
    seen = Looks(np.stack(colours), trunk_features(work, network))
    small = resize_maps(soft, width, height)
    hints = resize_maps(told, width, height)
    steady = steadiness(small) > 0.5
    found, agreement, least = None, np.ones(len(soft)), np.zeros(len(soft))
    for turn in range(_ROUNDS):
        classifier = _fitted(seen, small if found is None else found, seed + 20 + turn)
        if classifier is None:
            break
        found = _probable(_read(classifier, seen) + hints)
        agreement = np.array([intersection_over_union(a > 0.5, b > 0.5) for a, b in zip(small, found, strict=True)])
        if (agreement >= LEAST_AGREEMENT).all():
            break
    if found is None or not steady.any() or float(np.median(agreement[steady])) < LEAST_TRUST:
        return Found(soft, np.zeros(len(soft), bool), seen, None, least)
    least = LEAST_SIZE * np.interp(np.arange(len(soft)), np.flatnonzero(steady), _area(small)[steady])
    there = _area(found) > least
    lost = (agreement < LEAST_AGREEMENT) & there
    mended = soft.copy()
    for t in np.flatnonzero(lost):  # the larger of both: a lost frame lacks pieces, and what it has is mostly right
        mended[t] = np.maximum(soft[t], cv2.resize(found[t], soft.shape[:0:-1], interpolation=cv2.INTER_LINEAR))
    return Found(mended, lost, seen, found * there[:, None, None], least)


def look_again(refined: np.ndarray, told: np.ndarray, seed: int, first: Found) -> tuple[np.ndarray, np.ndarray]:
    """Refined masks (T, H, W) and the classifier's opinion of them as one; where that changed a whole piece, (T,) bool.

    Refining may drop a head in the shade or a tail, in some frames of many. Where a mask and what the `first` look said
    differ by a whole piece, the classifier is taught anew, by the refined masks; what comes of it is rough, and to be
    refined again. Hints, log-odds `told` (T, h, w), count as the classifier does. Frames that the object has left stay
    as they are; so do all masks, the very array, where there is no such piece.
    """
    none = np.zeros(len(refined), bool)
    if first.said is None:
        return refined, none
    height, width = first.said.shape[1:]
    small = resize_maps(refined, width, height)
    if not (largest_piece(small > 0.5, first.said > 0.5, first.least) > DOUBTED_SHARE).any():
        return refined, none
    classifier = _fitted(first.seen, small, seed + 40, again=True)
    if classifier is None:
        return refined, none
    logits = CLASSIFIER_SHARE * (_read(classifier, first.seen) + resize_maps(told, width, height))
    own = np.log((refined + 0.01) / (1.01 - refined))
    out = _probable(own + resize_maps(logits, refined.shape[2], refined.shape[1]))
    gone = _area(out) <= first.least
    out[gone] = refined[gone]
    return out, largest_piece(small > 0.5, resize_maps(out, width, height) > 0.5, first.least) > CHANGED_SHARE


def largest_piece(masks: np.ndarray, others: np.ndarray, least: np.ndarray) -> np.ndarray:
    """(T,) area of the largest thick piece in which boolean masks (T, h, w) differ, as a share of the mask's.

    Of `least` (T,), a share of the frame, where the mask is smaller than that.
    """
    out = np.zeros(len(masks))
    for t, (mask, other) in enumerate(zip(masks, others, strict=True)):
        thick = cv2.morphologyEx((mask ^ other).astype(np.uint8), cv2.MORPH_OPEN, disc(2))
        areas = cv2.connectedComponentsWithStats(thick, connectivity=4)[2][1:, cv2.CC_STAT_AREA]
        out[t] = areas.max(initial=0) / max(int(np.count_nonzero(mask)), least[t] * mask.size, 1.0)
    return out


def _area(soft: np.ndarray) -> np.ndarray:
    """(T,) share of the frame that masks (T, h, w) cover."""
    return np.asarray((soft > 0.5).reshape(len(soft), -1).mean(axis=1))


def trunk_features(work: list[np.ndarray], network: TrunkNetwork) -> np.ndarray:
    """(T, h, w, C) float16 of frames (H, W, 3) uint8 RGB, h by w about 3/16 of it: the network sees them larger."""
    height, width = (max(_MULTIPLE, round(ENLARGED * n / _MULTIPLE) * _MULTIPLE) for n in work[0].shape[:2])
    out = []
    for first in range(0, len(work), _BATCH):
        part = [cv2.resize(x, (width, height), interpolation=cv2.INTER_LINEAR) for x in work[first : first + _BATCH]]
        out += list(network(np.stack([normalised(x) for x in part])).transpose(0, 2, 3, 1).astype(np.float16))
    return np.stack(out)


def steadiness(soft: np.ndarray) -> np.ndarray:
    """(T,) in 0..1: whether a mask is nearly as large as the larger ones of the frames around it are."""
    area = _area(soft)
    usual = [np.quantile(area[max(0, t - _AREA_REACH) : t + _AREA_REACH + 1], 0.75) for t in range(len(area))]
    return np.clip((area / np.maximum(usual, 1e-9) - 0.6) / 0.3, 0.0, 1.0)


def _fitted(seen: Looks, soft: np.ndarray, seed: int, again: bool = False) -> PixelColours | None:
    """A classifier of pixels taught by the masks (T, h, w) of steady frames; None where those hold only one class.

    With `again` it is taught twice, the second time without the labels that the first contradicts.
    """
    trust = steadiness(soft)
    good = np.flatnonzero(trust > 0)
    chosen = good[np.unique(np.linspace(0, len(good) - 1, min(_FIT_FRAMES, len(good))).round().astype(int))]
    if len(chosen) == 0:
        return None
    draw = np.random.default_rng(seed)
    pixels = [draw.permutation(soft[0].size)[: soft[0].size // _ONE_PIXEL_IN] for _ in chosen]
    values = np.concatenate([seen.of(t).reshape(soft[0].size, -1)[p] for t, p in zip(chosen, pixels, strict=True)])
    inside = np.concatenate([soft[t].ravel()[p] > 0.5 for t, p in zip(chosen, pixels, strict=True)])
    depth = [np.abs(signed_distance(soft[t] > 0.5)).ravel()[p] for t, p in zip(chosen, pixels, strict=True)]
    weight = np.concatenate([(d > _RIM_PX) * np.float32(trust[t]) for t, d in zip(chosen, depth, strict=True)])
    for turn in range(1 + again):
        classifier = PixelColours(values.shape[-1], seed + turn)
        if not classifier.fit(values, inside, weight, steps=_STEPS, batch=_PIXELS):
            return None
        if again and turn == 0:
            logit = classifier.logit(values)
            weight = weight * np.where(inside, logit > -OVERRULED_LOGIT, logit < OVERRULED_LOGIT)
    return classifier


def _read(classifier: PixelColours, seen: Looks) -> np.ndarray:
    """(T, h, w) log-odds of every frame."""
    return np.stack([cv2.GaussianBlur(classifier.logit(seen.of(t)), (0, 0), 0.6) for t in range(len(seen.colours))])


def _probable(logits: np.ndarray) -> np.ndarray:
    """(T, h, w) probability, of the main piece of every frame alone."""
    found = 1.0 / (1.0 + np.exp(-logits.astype(np.float32)))
    return np.stack([main_component(x > 0.5, x) * x for x in found])
