"""Where a network that knows the categories thinks the object is: coarse, but with no hint and no motion needed.

First windows of three sizes over some of the frames give candidates of every category; the chain of candidates that
fits together best over time gives a box a frame; then every frame is looked at again on a crop round its box, twice.
One network sees all categories at once, and neighbouring windows of one size in one go.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from stages.perception.descriptors import crop_resize
from stages.perception.viewpoint import INPUT_PX, normalised

CROP_MARGIN = 1.35
"""Side of the crop that is segmented over the longer side of the box."""
SEARCH_EVERY = 4
"""Frames between those that are searched with windows."""
JUDGED_EVERY, REFINED_EVERY = 8, 2
"""Frames between those that say which category it may be, and those whose box is made exact."""
LEAST_SHRINK = 0.8
"""A refined box is never smaller than this share of the box before: refinement tends to fall onto a part."""
PART_PRICE = 0.2
"""What it costs a candidate to lie within a larger one, and brings that one."""
SMALL_WINDOW = 0.6
"""Side of the smallest windows over the picture's shorter side."""
LEAST_SURE = 0.75
"""A category that some frames show with less than this share of the surest one's certainty is not looked at again."""
NARROWEST = 1 / 12
"""Windows smaller than this share of the picture's longer side are not looked at: there would be hundreds."""
_BATCH = 16
_MULTIPLE = 16  # of pixels, what the network takes
_HALF = INPUT_PX // 2


class FindingNetwork(Protocol):
    """As training/export.py writes it."""

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """(N, K, H/2, W/2) mask logits of K categories, of (N, 3, H, W) pictures normalised by ImageNet's mean and
        deviation, H and W multiples of 16."""
        ...


@dataclass(frozen=True)
class Candidate:
    """A place where an object may be: box x0, y0, x1, y1 in pixels, and how much speaks for it."""

    box: np.ndarray
    score: float


def object_priors(frames: np.ndarray, network: FindingNetwork, categories: dict[str, int]) -> dict[str, np.ndarray]:
    """Of each category that may be it, (T, H, W) uint8 probability (255 = 1) that a pixel shows the object.

    `frames` is (T, H, W, 3) uint8 RGB; `categories` says which of the network's channels is whose. All zero where
    nothing of the category was found in any frame; a category that is seen much worse than another is left out.
    """
    boxes = searched_boxes(frames, network, tuple(categories.values()))
    sure = {k: _certainty(frames[::JUDGED_EVERY], b[::JUDGED_EVERY], network, k) for k, b in boxes.items()}
    least = LEAST_SURE * max(sure.values(), default=0.0)
    out = {}
    for name, channel in categories.items():
        if channel not in boxes:
            out[name] = np.zeros(frames.shape[:3], np.uint8)
        elif sure[channel] >= least:
            out[name] = _object_prior(frames, refined_boxes(frames, boxes[channel], network, channel), network, channel)
    return out


def searched_boxes(frames: np.ndarray, network: FindingNetwork, channels: tuple[int, ...]) -> dict[int, np.ndarray]:
    """(T, 4) box in pixels of the object in every frame, by channel; those that found nothing at all are missing."""
    count = len(frames)
    searched = np.unique(np.append(np.arange(0, count, SEARCH_EVERY), count - 1))
    found = [candidates(frames[i], network, channels) for i in searched]
    out = {}
    for channel in channels:
        chosen = best_chain([row[channel] for row in found])
        known = [(i, c.box) for i, c in zip(searched, chosen, strict=True) if c is not None]
        if known:
            at = np.array([i for i, _ in known], float)
            out[channel] = np.stack([np.interp(np.arange(count), at, [b[k] for _, b in known]) for k in range(4)], 1)
    return out


def refined_boxes(frames: np.ndarray, boxes: np.ndarray, network: FindingNetwork, channel: int) -> np.ndarray:
    """(T, 4) boxes round what the network sees on crops round the boxes before."""
    height, width = frames.shape[1:3]
    some = np.unique(np.append(np.arange(0, len(frames), REFINED_EVERY), len(frames) - 1))
    refined = boxes[some].copy()
    for i, crop, probability in _looked_at(frames[some], boxes[some], network, channel):
        new = _box_of(probability, crop)
        if new is not None:
            refined[i] = _not_much_smaller(new, boxes[some[i]])
    steady = _steady(refined)
    between = np.stack([np.interp(np.arange(len(frames)), some, side) for side in steady.T], 1)
    return np.clip(between, 0, [width, height, width, height])


def _object_prior(frames: np.ndarray, boxes: np.ndarray, network: FindingNetwork, channel: int) -> np.ndarray:
    out = np.zeros(frames.shape[:3], np.uint8)
    for i, crop, probability in _looked_at(frames, boxes, network, channel, mirrored=True):
        out[i] = np.round(255 * paste(probability, crop, frames.shape[1], frames.shape[2])).astype(np.uint8)
    return out


def _certainty(frames: np.ndarray, boxes: np.ndarray, network: FindingNetwork, channel: int) -> float:
    """How sure the network is of the object where it sees one, 0..1: probability on it over all that is not surely off.

    Not in how many frames: something that comes into the picture late may be what moves.
    """
    maps = np.stack([probability for _, _, probability in _looked_at(frames, boxes, network, channel)])
    return float(maps[maps > 0.5].sum()) / max(int(np.count_nonzero(maps > 0.2)), 1)


def candidates(
    frame: np.ndarray, network: FindingNetwork, channels: tuple[int, ...], most: int = 6
) -> dict[int, list[Candidate]]:
    """Objects of each channel that windows of three sizes over one frame (H, W, 3) show, best first."""
    height, width = frame.shape[:2]
    found: dict[int, list[Candidate]] = {channel: [] for channel in channels}
    for crop, logits in window_logits(frame, network):
        for channel in channels:
            found[channel] += _in_window(_sigmoid(logits[channel]), crop, height, width)
    out = {}
    for channel in channels:
        kept: list[Candidate] = []
        for c in sorted(_whole_before_part(found[channel]), key=lambda c: -c.score):
            if all(overlap(c.box, other.box) < 0.6 for other in kept):
                kept.append(c)
        out[channel] = kept[:most]
    return out


def window_logits(frame: np.ndarray, network: FindingNetwork) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Square windows (4,) x0, y0, x1, y1 over a frame (H, W, 3), and the network's logits (K, 48, 48) in each.

    The whole picture, and windows of its shorter side and of 0.6 of it, which overlap by half. Windows of one size are
    cut from one pass over the picture.
    """
    height, width = frame.shape[:2]
    long, short = max(height, width), min(height, width)
    centre = np.array([width / 2, height / 2])
    whole = np.concatenate([centre - long / 2, centre + long / 2])
    yield whole, network(normalised(crop_resize(frame, whole, INPUT_PX))[None])[0]
    for side in (short, SMALL_WINDOW * short):
        if not NARROWEST * long < side < long:
            continue
        scale = INPUT_PX / side
        # Even, so that the last windows end where the picture does.
        size = max(INPUT_PX, 2 * round(width * scale / 2)), max(INPUT_PX, 2 * round(height * scale / 2))
        picture = cv2.resize(frame, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        padding = [(0, -n % _MULTIPLE) for n in (size[1], size[0])]
        logits = network(normalised(np.pad(picture, [*padding, (0, 0)]))[None])[0]
        unit = np.array([width, height]) / size * 2  # pixels of the frame a cell of the logits
        for y in _starts(size[1] // 2):
            for x in _starts(size[0] // 2):
                low = np.array([x, y]) * unit
                crop = np.concatenate([low, low + _HALF * unit])
                yield crop, logits[:, y : y + _HALF, x : x + _HALF]


def _starts(cells: int) -> list[int]:
    """Where windows of 48 cells begin that cover so many and overlap by half."""
    number = int(np.ceil((cells - _HALF) / (0.5 * _HALF) - 1e-6)) + 1
    return [int(v) for v in np.round(np.linspace(0, cells - _HALF, number))]


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


def _looked_at(
    frames: np.ndarray, boxes: np.ndarray, network: FindingNetwork, channel: int, mirrored: bool = False
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Frame, crop and probability (48, 48) on the crop round each box; `mirrored` asks about the mirror image, too."""
    for first in range(0, len(frames), _BATCH):
        rows = range(first, min(first + _BATCH, len(frames)))
        crops = [_square(boxes[i]) for i in rows]
        inputs = [normalised(crop_resize(frames[i], crop, INPUT_PX)) for i, crop in zip(rows, crops, strict=True)]
        images = np.stack(inputs)
        logits = network(images)[:, channel]
        if mirrored:
            logits = 0.5 * (logits + network(np.ascontiguousarray(images[..., ::-1]))[:, channel, :, ::-1])
        yield from zip(rows, crops, _sigmoid(logits), strict=True)


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


def _steady(boxes: np.ndarray, reach: int = 1) -> np.ndarray:
    """Median of each box with its neighbours in time."""
    padded = np.pad(boxes, ((reach, reach), (0, 0)), mode="edge")
    return np.asarray(np.median(np.stack([padded[k : k + len(boxes)] for k in range(2 * reach + 1)]), axis=0))


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(values.astype(np.float32), -30, 30))))
