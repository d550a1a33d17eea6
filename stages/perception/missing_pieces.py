"""Pieces of the object that look like its background, added to masks where the background is seen not to be there.

Evidence that other frames contradict (`backdrop`) is averaged along the flow; what it finds in some frames teaches a
classifier of colours how the missing piece looks, which helps to decide in the others. Where the pieces do not look
alike, and unlike what is around them, it is not a piece of one object that was found but the depth of the background,
and none is added.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.perception.appearance import LOGIT_LIMIT, PixelColours, coloured_surroundings
from stages.perception.backdrop import Contradiction, Tick, contradiction
from stages.perception.optical_flow import sample
from stages.perception.temporal import disc, mask_box, resize_maps, signed_distance

REACH_PX = 20.0
"""How far from the mask a piece may stretch, at the working size of 256."""
FIRST_BAR, BAR = 0.5, 1.0
"""Log-odds that a pixel must reach, before and with its looks."""
LOOKS_SHARE, LOOKS_LIMIT = 0.3, 3.0
"""How much the classifier's log-odds count (raised by 1, what its diet of one third object takes), and up to where:
alone they pass the bar only where they are very sure."""
LEAST_ALIKE = 0.9
"""Share of both the pieces and the background that must be told right by looks, or else nothing was found. Shoes on
five kinds of ground and paws in grass give 0.92 and more, furniture at many depths 0.88 and less."""
LEAST_PX = 12
LARGEST_SHARE = 0.5
"""A piece larger than this share of the mask is none: something else came by."""
LEAST_FRAMES = 8
_CARRIED_FRAMES, _CARRIED_SHARE = 3, 0.7
_LEAST_WEIGHT = 0.2
_UNSEEN = -99.0
_TAUGHT_REACH_PX, _TAUGHT_PER_FRAME, _TAUGHT_FRAMES = 40.0, 1500, 48
_STEPS, _PIXELS = 240, 2048


def with_missing_pieces(
    work: list[np.ndarray],
    soft: np.ndarray,
    told: np.ndarray,
    to_next: list[np.ndarray],
    to_previous: list[np.ndarray],
    seed: int,
    tick: Tick = lambda done, total: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Probability (T, H, W) with pieces added, and how many pixels each frame gained, (T,) at the working size.

    `soft` (T, H, W) is the probability so far, `work` the frames (h, w, 3) uint8 RGB, `told` (T, h, w) log-odds from
    hints. `to_next[t]` is the flow t -> t+1, `to_previous[t]` t+1 -> t, at any smaller size.
    """
    height, width = work[0].shape[:2]
    small = resize_maps(soft, width, height) if soft.shape[1:] != (height, width) else soft
    inside = small > 0.5
    gained = np.zeros(len(work), int)
    if len(work) < LEAST_FRAMES or not inside.any():
        return soft, gained
    found = carried(contradiction(work, inside, to_next, to_previous, tick), to_next, to_previous)
    away = np.stack([-signed_distance(mask) for mask in inside])
    evidence, known = found.evidence + told, found.weight > _LEAST_WEIGHT
    added = pieces(evidence - FIRST_BAR, inside, away, known)
    looks = _looks(work, evidence, inside, added, away, known, seed + 30)
    if looks is None or told_right(looks, added, known & ~added & (evidence < -FIRST_BAR)) < LEAST_ALIKE:
        return soft, gained
    both = evidence + LOOKS_SHARE * (np.minimum(looks, LOOKS_LIMIT) + 1.0)
    added = pieces(both - BAR, inside, away, ~inside & (away < REACH_PX))
    out = soft.astype(np.float32, copy=True)
    for t in np.flatnonzero(added.reshape(len(added), -1).any(axis=1)):
        seam = inside[t] & (cv2.dilate(added[t].astype(np.uint8), disc(1)) > 0)  # so that no gap opens when enlarged
        sure = cv2.resize((added[t] | seam).astype(np.float32), soft.shape[:0:-1], interpolation=cv2.INTER_LINEAR)
        out[t] = np.maximum(out[t], 0.9 * sure)
        gained[t] = np.count_nonzero(added[t])
    return out, gained


def carried(found: Contradiction, to_next: list[np.ndarray], to_previous: list[np.ndarray]) -> Contradiction:
    """Each frame's evidence averaged with its neighbours', brought here by flow and falling off with each frame."""
    share = np.minimum(found.weight, 3.0) / 3.0
    total, weight = found.evidence * share, share.copy()
    height, width = share.shape[1:]
    if not to_next:
        return found
    small_height, small_width = to_next[0].shape[:2]
    for way in (1, -1):
        far = [resize_maps(maps, small_width, small_height) for maps in (found.evidence * share, share)]
        for _ in range(_CARRIED_FRAMES):
            moved = [np.zeros_like(maps) for maps in far]
            for t in range(len(share)):
                if 0 <= t - way < len(share):
                    flow = to_previous[t - 1] if way > 0 else to_next[t]
                    for old, new in zip(far, moved, strict=True):
                        new[t] = _CARRIED_SHARE * sample(old[t - way], flow)
            far = moved
            total += resize_maps(far[0], width, height)
            weight += resize_maps(far[1], width, height)
    return Contradiction((total / np.maximum(weight, 1e-3)).astype(np.float32), weight)


def pieces(odds: np.ndarray, inside: np.ndarray, away: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(T, h, w) bool: where the log-odds are positive in a piece that touches the mask, is thick enough and not huge.

    `inside` are the masks, `away` the distances from them, `known` where the log-odds mean something.
    """
    return np.stack([_pieces(*each) for each in zip(odds, inside, away, known, strict=True)])


def _pieces(odds: np.ndarray, inside: np.ndarray, away: np.ndarray, known: np.ndarray) -> np.ndarray:
    free = (known & ~inside).astype(np.float32)
    steady = cv2.GaussianBlur(odds * free, (0, 0), 1.0) / (cv2.GaussianBlur(free, (0, 0), 1.0) + 1e-3)
    wanted = ((steady > 0) & (free > 0) & (away < REACH_PX)).astype(np.uint8)
    thick = cv2.dilate(cv2.morphologyEx(wanted, cv2.MORPH_OPEN, disc(2)), disc(1)) & wanted
    count, labels, stats, _ = cv2.connectedComponentsWithStats(thick, connectivity=4)
    touching = np.bincount(labels[away < 3.0], minlength=count) > 0
    areas = stats[:, cv2.CC_STAT_AREA]
    kept = touching & (areas >= LEAST_PX) & (areas <= LARGEST_SHARE * np.count_nonzero(inside))
    kept[0] = False
    new = kept[labels]
    closed = cv2.morphologyEx((new | inside).astype(np.uint8), cv2.MORPH_CLOSE, disc(1)) > 0
    return closed & ~inside & (cv2.dilate(new.astype(np.uint8), disc(2)) > 0)


def told_right(looks: np.ndarray, added: np.ndarray, background: np.ndarray) -> float:
    """Mean of the shares of added and background pixels (T, h, w) that log-odds tell right; 0 where one has none."""
    judged = looks > _UNSEEN
    found, off = looks[added & judged], looks[background & judged]
    return float(((found > 0).mean() + (off < 0).mean()) / 2) if len(found) and len(off) else 0.0


def _looks(
    work: list[np.ndarray],
    evidence: np.ndarray,
    inside: np.ndarray,
    added: np.ndarray,
    away: np.ndarray,
    known: np.ndarray,
    seed: int,
) -> np.ndarray | None:
    """(T, h, w) log-odds by colours that a pixel near the mask belongs to a missing piece; None if none was found.

    Far below zero where a pixel is not near. Taught by the pieces against all else around the object: firmly where
    other frames say so, else a little.
    """
    draw = np.random.default_rng(seed)
    beside = ~inside & (away < _TAUGHT_REACH_PX)
    weight = np.where(beside, np.where(known & (evidence < -1), 0.7, 0.25), 0.0).astype(np.float32)
    weight[added] = np.clip(evidence[added] / 2, 0.1, 1)
    values, labels, weights = [], [], []
    for t in np.unique(np.linspace(0, len(work) - 1, min(_TAUGHT_FRAMES, len(work))).round().astype(int)):
        part = _window(beside[t])
        new, heavy = added[t][part].ravel(), weight[t][part].ravel()
        other = np.flatnonzero((heavy > 0) & ~new)
        other = draw.choice(other, min(_TAUGHT_PER_FRAME, len(other)), replace=False)
        chosen = np.union1d(np.flatnonzero(new), other)
        colours = coloured_surroundings(work[t][part])
        values.append(colours.reshape(-1, colours.shape[-1])[chosen])
        labels.append(new[chosen])
        weights.append(heavy[chosen])
    stacked = np.concatenate(values)
    classifier = PixelColours(stacked.shape[-1], seed)
    if not classifier.fit(stacked, np.concatenate(labels), np.concatenate(weights), steps=_STEPS, batch=_PIXELS):
        return None
    out = np.full(evidence.shape, _UNSEEN, np.float32)
    for t, image in enumerate(work):
        part = _window(beside[t])
        near = ~inside[t][part] & (away[t][part] < REACH_PX)
        if near.any():
            seen = np.full(near.shape, -LOGIT_LIMIT, np.float32)
            seen[near] = classifier.logit(coloured_surroundings(image[part])[near])
            out[t][part][near] = cv2.GaussianBlur(seen, (0, 0), 0.7)[near]
    return out


def _window(mask: np.ndarray) -> tuple[slice, slice]:
    """The part of a frame that holds the whole mask, and at least a pixel."""
    x0, y0, x1, y1 = (int(v) for v in mask_box(mask))
    return slice(y0, max(y1, y0 + 1)), slice(x0, max(x1, x0 + 1))
