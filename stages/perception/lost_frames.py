"""Frames in which colours and motion lost the object, found again by how it looks to a network in the clip's others.

Fur in the shade of a table has the colours of the floor. What a trained network sees in it (shape, texture, what lies
around) changes less; so a classifier is fitted, in this very clip, to those features where the rough masks are steady,
and read where they are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from stages.perception.appearance import PixelColours, coloured_surroundings
from stages.perception.temporal import intersection_over_union, main_component, resize_maps, signed_distance
from stages.perception.viewpoint import normalised

LEAST_AGREEMENT = 0.8
"""Overlap of a frame's rough mask and what the classifier says below which the frame counts as lost. Where masks are
right the two overlap by 0.85 and more (fox and dancer: every frame); the classifier's is the coarser."""
LEAST_REFINED_AGREEMENT = 0.85
"""The same of refined masks, which teach better."""
LEAST_TRUST = 0.75
"""Median overlap over the frames with steady masks below which the classifier has learnt nothing and is left out."""
LEAST_SIZE = 0.5
"""A find smaller than this share of the object in the steady frames next to it is none: the object may have left."""
WORSE_THAN_USUAL = 0.1
"""So much less overlap than the clip's frames usually have, in any of them, asks for a second look at refined masks."""
_AREA_REACH = 8  # frames to each side that say how large the object usually is
_RIM_PX = 1.5  # beside the rough outline nothing is learnt
_FIT_FRAMES = 48
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

    `probability` (T, h, w) float32 in 0..1; `lost` (T,) bool: which frames were mended; `said` (T, h/2, w/2) float32:
    what the classifier says of every frame, None where the features do not tell the object.
    """

    probability: np.ndarray
    lost: np.ndarray
    said: np.ndarray | None


def find_again(
    work: list[np.ndarray],
    soft: np.ndarray,
    told: np.ndarray,
    network: TrunkNetwork,
    seed: int,
    least: float = LEAST_AGREEMENT,
) -> Found:
    """Lost frames mended in rough masks: probability `soft` (T, h, w) of the frames `work` (h, w, 3) uint8 RGB.

    `told` (T, h, w) are log-odds from hints; `least` is the overlap below which a frame counts as lost. Other frames
    come back as they are; so does every frame of a clip in which the features do not tell the object. Worked out at
    half the size.
    """
    height, width = soft.shape[1] // 2, soft.shape[2] // 2
    colours = np.stack(
        [coloured_surroundings(cv2.resize(x, (width, height), interpolation=cv2.INTER_AREA)) for x in work]
    )
    small = resize_maps(soft, width, height)
    hints = resize_maps(told, width, height)
    features = trunk_features(work, network)
    steady = steadiness(small) > 0.5
    found, agreement = small, np.ones(len(soft))
    for turn in range(_ROUNDS):
        classifier = _fitted(colours, features, found, seed + 20 + turn)
        if classifier is None:
            break
        found = np.stack([_read(classifier, *each) for each in zip(colours, features, hints, strict=True)])
        agreement = np.array([intersection_over_union(a > 0.5, b > 0.5) for a, b in zip(small, found, strict=True)])
        if (agreement >= least).all():
            break
    if not steady.any() or float(np.median(agreement[steady])) < LEAST_TRUST:
        return Found(soft, np.zeros(len(soft), bool), None)
    area, again = ((m > 0.5).reshape(len(m), -1).mean(axis=1) for m in (small, found))
    expected = np.interp(np.arange(len(soft)), np.flatnonzero(steady), area[steady])
    lost = (agreement < least) & (again > LEAST_SIZE * expected)
    mended = soft.copy()
    for t in np.flatnonzero(lost):  # the larger of both: a lost frame lacks pieces, and what it has is mostly right
        mended[t] = np.maximum(soft[t], cv2.resize(found[t], soft.shape[:0:-1], interpolation=cv2.INTER_LINEAR))
    return Found(mended, lost, found)


def look_again(
    work: list[np.ndarray], refined: np.ndarray, told: np.ndarray, network: TrunkNetwork, seed: int, first: Found
) -> tuple[np.ndarray, np.ndarray]:
    """Refined masks (T, H, W) with what some frames lost, roughly, and which frames those are, (T,) bool.

    Refining may drop a head in the shade. Where some frame agrees with what the `first` look said by much less than
    the clip's frames do, the classifier is taught anew, by the refined masks. What it finds is to be refined again.
    """
    none = np.zeros(len(refined), bool)
    if first.said is None:
        return refined, none
    small = resize_maps(refined, first.said.shape[2], first.said.shape[1])
    overlap = np.array([intersection_over_union(a > 0.5, b > 0.5) for a, b in zip(small, first.said, strict=True)])
    if (overlap >= np.median(overlap) - WORSE_THAN_USUAL).all():
        return refined, none
    height, width = work[0].shape[:2]
    second = find_again(work, resize_maps(refined, width, height), told, network, seed, LEAST_REFINED_AGREEMENT)
    out = refined.copy()
    for t in np.flatnonzero(second.lost):
        again = cv2.resize(second.probability[t], refined.shape[:0:-1], interpolation=cv2.INTER_LINEAR)
        out[t] = np.maximum(refined[t], again)
    return out, second.lost


def trunk_features(work: list[np.ndarray], network: TrunkNetwork) -> np.ndarray:
    """(T, H/8, W/8, C) float32 of frames (H, W, 3) uint8 RGB, each resized to the nearest multiples of sixteen."""
    height, width = (max(_MULTIPLE, round(n / _MULTIPLE) * _MULTIPLE) for n in work[0].shape[:2])
    out = []
    for first in range(0, len(work), _BATCH):
        part = [cv2.resize(x, (width, height), interpolation=cv2.INTER_AREA) for x in work[first : first + _BATCH]]
        out += list(network(np.stack([normalised(x) for x in part])).transpose(0, 2, 3, 1))
    return np.ascontiguousarray(np.stack(out))


def steadiness(soft: np.ndarray) -> np.ndarray:
    """(T,) in 0..1: whether a mask is nearly as large as the larger ones of the frames around it are."""
    area = (soft > 0.5).reshape(len(soft), -1).mean(axis=1)
    usual = [np.quantile(area[max(0, t - _AREA_REACH) : t + _AREA_REACH + 1], 0.75) for t in range(len(area))]
    return np.clip((area / np.maximum(usual, 1e-9) - 0.6) / 0.3, 0.0, 1.0)


def _fitted(colours: np.ndarray, features: np.ndarray, soft: np.ndarray, seed: int) -> PixelColours | None:
    """A classifier of pixels taught by the masks of steady frames; None where those hold only one class."""
    trust = steadiness(soft)
    good = np.flatnonzero(trust > 0)
    chosen = good[np.unique(np.linspace(0, len(good) - 1, min(_FIT_FRAMES, len(good))).round().astype(int))]
    if len(chosen) == 0:
        return None
    values = np.stack([_seen(colours[t], features[t]) for t in chosen])
    inside = soft[chosen] > 0.5
    away = np.stack([np.abs(signed_distance(m)) > _RIM_PX for m in inside])
    classifier = PixelColours(values.shape[-1], seed)
    weight = away * trust[chosen, None, None].astype(np.float32)
    return (
        classifier if classifier.fit(values, inside.astype(np.float32), weight, steps=_STEPS, batch=_PIXELS) else None
    )


def _read(classifier: PixelColours, colours: np.ndarray, features: np.ndarray, told: np.ndarray) -> np.ndarray:
    logit = cv2.GaussianBlur(classifier.logit(_seen(colours, features)), (0, 0), 0.6) + told
    probability = (1.0 / (1.0 + np.exp(-logit))).astype(np.float32)
    return main_component(probability > 0.5, probability) * probability


def _seen(colours: np.ndarray, features: np.ndarray) -> np.ndarray:
    """(h, w, K + C): both at the size of the colours."""
    size = colours.shape[1], colours.shape[0]
    return np.concatenate([colours, cv2.resize(features, size, interpolation=cv2.INTER_LINEAR)], axis=-1)
