"""Where a network that knows the category thinks the object is: coarse, but with no hint and no motion needed.

First windows of three sizes over some of the frames give candidates; the chain of candidates that fits together best
over time gives a box a frame; then every frame is looked at again on a crop round its box, twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.perception.descriptors import crop_resize
from stages.perception.viewpoint import INPUT_PX, PoseNetwork, normalised

CROP_MARGIN = 1.35
"""Side of the crop that is segmented over the longer side of the box."""
SEARCH_EVERY = 4
"""Frames between those that are searched with windows."""
LEAST_SHRINK = 0.8
"""A refined box is never smaller than this share of the box before: refinement tends to fall onto a part."""
PART_PRICE = 0.2
"""What it costs a candidate to lie within a larger one, and brings that one."""
_BATCH = 16


@dataclass(frozen=True)
class Candidate:
    """A place where an object may be: box x0, y0, x1, y1 in pixels, and how much speaks for it."""

    box: np.ndarray
    score: float


def object_prior(frames: np.ndarray, session: PoseNetwork) -> np.ndarray:
    """(T, H, W) uint8 probability (255 = 1) that a pixel of `frames` (T, H, W, 3) uint8 RGB shows the object.

    All zero where nothing of the category was found in any frame.
    """
    boxes = object_boxes(frames, session)
    if boxes is None:
        return np.zeros(frames.shape[:3], np.uint8)
    out = np.zeros(frames.shape[:3], np.uint8)
    for i, crop, probability in _looked_at(frames, boxes, session, mirrored=True):
        out[i] = np.round(255 * paste(probability, crop, frames.shape[1], frames.shape[2])).astype(np.uint8)
    return out


def object_boxes(frames: np.ndarray, session: PoseNetwork) -> np.ndarray | None:
    """(T, 4) box of the object in every frame, in pixels; None where nothing was found at all."""
    count, height, width = frames.shape[:3]
    searched = np.unique(np.append(np.arange(0, count, SEARCH_EVERY), count - 1))
    found = [candidates(frames[i], session) for i in searched]
    chosen = best_chain(found)
    known = [(i, c.box) for i, c in zip(searched, chosen, strict=True) if c is not None]
    if not known:
        return None
    at = np.array([i for i, _ in known], float)
    boxes = np.stack([np.interp(np.arange(count), at, [b[k] for _, b in known]) for k in range(4)], 1)
    refined = boxes.copy()
    for i, crop, probability in _looked_at(frames, boxes, session, mirrored=False):
        new = _box_of(probability, crop)
        if new is not None:
            refined[i] = _not_much_smaller(new, boxes[i])
    refined = _steady(refined)
    return np.clip(refined, 0, [width, height, width, height])


def candidates(frame: np.ndarray, session: PoseNetwork, most: int = 6) -> list[Candidate]:
    """Objects that windows of three sizes over one frame (H, W, 3) show, best first."""
    height, width = frame.shape[:2]
    crops = windows(height, width)
    found: list[Candidate] = []
    for first in range(0, len(crops), _BATCH):
        part = crops[first : first + _BATCH]
        answer = session(np.stack([_unprompted(frame, crop) for crop in part]))
        dense = _sigmoid(answer["dense"][:, 0])
        for crop, probability in zip(part, dense, strict=True):
            found += _in_window(probability, crop, height, width)
    found = sorted(_whole_before_part(found), key=lambda c: -c.score)
    kept: list[Candidate] = []
    for c in found:
        if all(overlap(c.box, other.box) < 0.6 for other in kept):
            kept.append(c)
    return kept[:most]


def _whole_before_part(found: list[Candidate]) -> list[Candidate]:
    """A place that holds other finds is a whole, and they are its parts: a close window sees a face as an animal."""
    boxes = [c.box for c in found]
    out = []
    for c in found:
        holds = any(_inside(b, c.box) > 0.85 and _area(b) < 0.6 * _area(c.box) for b in boxes)
        held = any(_inside(c.box, b) > 0.85 and _area(c.box) < 0.6 * _area(b) for b in boxes)
        out.append(Candidate(c.box, c.score + PART_PRICE * (holds - held)))
    return out


def _area(box: np.ndarray) -> float:
    return float(np.prod(box[2:] - box[:2]))


def _inside(part: np.ndarray, whole: np.ndarray) -> float:
    """Share of a box's area that lies in another box."""
    shared = np.clip(np.minimum(part[2:], whole[2:]) - np.maximum(part[:2], whole[:2]), 0, None)
    return float(np.prod(shared)) / max(_area(part), 1e-9)


def windows(height: int, width: int) -> list[np.ndarray]:
    """Square crops (4,) x0, y0, x1, y1: the whole picture, and windows of the shorter side and of 0.6 of it."""
    long, short = max(height, width), min(height, width)
    centre = np.array([width / 2, height / 2])
    out = [np.concatenate([centre - long / 2, centre + long / 2])]
    for side in (short, 0.6 * short):
        across, down = (max(1, int(np.ceil((n - side) / (0.5 * side) - 1e-6)) + 1) for n in (width, height))
        for y in np.linspace(0, height - side, down) if down > 1 else [(height - side) / 2]:
            for x in np.linspace(0, width - side, across) if across > 1 else [(width - side) / 2]:
                if side < long:
                    out.append(np.array([x, y, x + side, y + side]))
    return out


def best_chain(found: list[list[Candidate]]) -> list[Candidate | None]:
    """One candidate a frame: the chain with the highest sum of scores and of overlaps from each to the next."""
    best: list[np.ndarray] = []
    back: list[np.ndarray] = []
    previous: list[Candidate] = []
    last = np.zeros(0)
    for row in found:
        if not row:
            best.append(np.zeros(0))
            back.append(np.zeros(0, int))
            continue
        score = np.array([c.score for c in row])
        if previous:
            link = np.array([[overlap(c.box, p.box) for p in previous] for c in row]) + last[None]
            back.append(link.argmax(1))
            score = score + link.max(1)
        else:
            back.append(np.full(len(row), -1))
        best.append(score)
        previous, last = row, score
    out: list[Candidate | None] = [None] * len(found)
    k = -1
    for i in range(len(found) - 1, -1, -1):
        if not found[i]:
            continue
        if k < 0:
            k = int(best[i].argmax())
        out[i] = found[i][k]
        k = int(back[i][k])
    return out


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boxes."""
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    shared = float(np.prod(np.clip(high - low, 0, None)))
    whole = float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared)
    return shared / whole if whole > 0 else 0.0


def paste(probability: np.ndarray, crop: np.ndarray, height: int, width: int) -> np.ndarray:
    """(H, W) float32 of a map (S, S) that covers a square crop of the picture; zero elsewhere."""
    scale = len(probability) / (crop[2] - crop[0])
    columns = ((np.arange(width) + 0.5 - crop[0]) * scale - 0.5).astype(np.float32)
    rows = ((np.arange(height) + 0.5 - crop[1]) * scale - 0.5).astype(np.float32)
    x, y = np.meshgrid(columns, rows)
    return cv2.remap(probability.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _unprompted(frame: np.ndarray, crop: np.ndarray) -> np.ndarray:
    """(4, 96, 96) input of a crop whose mask is not known."""
    image = normalised(crop_resize(frame, crop, INPUT_PX))
    return np.concatenate([image, np.zeros_like(image[:1])])


def _looked_at(
    frames: np.ndarray, boxes: np.ndarray, session: PoseNetwork, mirrored: bool
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Frame, crop and probability (48, 48) on the crop round each box."""
    out: list[tuple[int, np.ndarray, np.ndarray]] = []
    for first in range(0, len(frames), _BATCH):
        rows = range(first, min(first + _BATCH, len(frames)))
        crops = [_square(boxes[i]) for i in rows]
        inputs = np.stack([_unprompted(frames[i], crop) for i, crop in zip(rows, crops, strict=True)])
        logits = session(inputs)["dense"][:, 0]
        if mirrored:
            turned = session(np.ascontiguousarray(inputs[..., ::-1]))["dense"][:, 0, :, ::-1]
            logits = 0.5 * (logits + turned)
        out += list(zip(rows, crops, _sigmoid(logits), strict=True))
    return out


def _square(box: np.ndarray) -> np.ndarray:
    centre, half = (box[:2] + box[2:]) / 2, max(float((box[2:] - box[:2]).max()), 8.0) * CROP_MARGIN / 2
    return np.concatenate([centre - half, centre + half])


def _in_window(probability: np.ndarray, crop: np.ndarray, height: int, width: int) -> list[Candidate]:
    """Connected pieces of one window's map; one that runs out of the window (not out of the picture) counts less."""
    side = len(probability)
    number, labels, stats, _ = cv2.connectedComponentsWithStats((probability > 0.5).astype(np.uint8), connectivity=8)
    scale = (crop[2] - crop[0]) / side
    out = []
    for k in range(1, number):
        x, y, w, h, area = (int(v) for v in stats[k])
        if area < 24:
            continue
        box = np.array([x, y, x + w, y + h], float) * scale + np.tile(crop[:2], 2)
        inside = np.clip(box, 0, [width, height, width, height])
        cut = [x == 0 and crop[0] > 1, y == 0 and crop[1] > 1, x + w == side and crop[2] < width - 1,
               y + h == side and crop[3] < height - 1]  # fmt: skip
        sure = float(probability[labels == k].mean())
        size = np.sqrt(area) / side  # larger in its window: better seen
        out.append(Candidate(inside, sure * min(1.0, 0.4 + 1.5 * size) * 0.45 ** sum(cut)))
    return out


def _box_of(probability: np.ndarray, crop: np.ndarray) -> np.ndarray | None:
    """Box in pixels of the largest piece of a map and of what lies near it in size; None where it is empty."""
    number, labels, stats, _ = cv2.connectedComponentsWithStats((probability > 0.5).astype(np.uint8), connectivity=8)
    if number < 2:
        return None
    areas = stats[1:, cv2.CC_STAT_AREA]
    keep = np.flatnonzero(areas >= 0.15 * areas.max()) + 1
    rows, columns = np.nonzero(np.isin(labels, keep))
    scale = (crop[2] - crop[0]) / len(probability)
    corners = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)
    return corners * scale + np.tile(crop[:2], 2)


def _not_much_smaller(new: np.ndarray, old: np.ndarray) -> np.ndarray:
    centre = (new[:2] + new[2:]) / 2
    size = np.maximum(new[2:] - new[:2], LEAST_SHRINK * (old[2:] - old[:2]))
    return np.concatenate([centre - size / 2, centre + size / 2])


def _steady(boxes: np.ndarray, reach: int = 2) -> np.ndarray:
    """Median of each box with its neighbours in time."""
    padded = np.pad(boxes, ((reach, reach), (0, 0)), mode="edge")
    return np.asarray(np.median(np.stack([padded[k : k + len(boxes)] for k in range(2 * reach + 1)]), axis=0))


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(values.astype(np.float32), -30, 30))))
