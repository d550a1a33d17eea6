"""Dense optical flow between the frames of a clip: DIS, forward-backward confidence, chaining.

A flow (H, W, 2) float32 is in pixels, x to the right and y down: ``frame_j[p + flow[p]]`` shows what
``frame_i[p]`` does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
    "fine": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}


_LEAST_SIDE_PX, _LONGEST_ASPECT = 24, 4


class Matcher:
    """DIS optical flow (Kroeger et al. 2016); `preset` is ultrafast, fast, medium or fine.

    "fine" is medium carried down to full resolution: 15 to 40 % less error on small motion, 2.5 times the time. Its
    digits depend on OpenCV's thread count, so stages set that to one.
    """

    def __init__(self, preset: str = "medium") -> None:
        self._dis = cv2.DISOpticalFlow.create(PRESETS[preset])
        if preset == "fine":
            self._dis.setFinestScale(0)

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Flow (H, W, 2) from `first` to `second`, (H, W) uint8 each."""
        height, width = first.shape
        least = max(_LEAST_SIDE_PX, -(-max(height, width) // _LONGEST_ASPECT))
        if min(height, width) < least:  # the library crashes on narrow pictures
            sides = 0, max(0, least - height), 0, max(0, least - width)
            first, second = (cv2.copyMakeBorder(image, *sides, cv2.BORDER_REPLICATE) for image in (first, second))
        return np.asarray(self._dis.calc(first, second, None))[:height, :width]  # type: ignore[arg-type, call-overload]


def pixel_grid(height: int, width: int) -> np.ndarray:
    """(H, W, 2) float32 column and row index of every pixel."""
    rows, columns = np.mgrid[0:height, 0:width]
    return np.stack([columns, rows], axis=-1).astype(np.float32)


def sample(values: np.ndarray, flow: np.ndarray, grid: np.ndarray | None = None) -> np.ndarray:
    """`values` (H, W) or (H, W, C) of the other frame, brought here: out[p] = values[p + flow[p]], bilinear.

    Outside the other frame its border is repeated.
    """
    grid = pixel_grid(*flow.shape[:2]) if grid is None else grid
    at = grid + flow
    return cv2.remap(values, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def compose(first: np.ndarray, second: np.ndarray, grid: np.ndarray | None = None) -> np.ndarray:
    """Flow i->k from i->j and j->k: first[p] + second[p + first[p]]."""
    return first + sample(second, first, grid)


def round_trip_error(forward: np.ndarray, backward: np.ndarray, grid: np.ndarray | None = None) -> np.ndarray:
    """(H, W) distance in pixels between a pixel and where forward, then backward flow takes it."""
    return np.linalg.norm(forward + sample(backward, forward, grid), axis=-1)


def confidence(forward: np.ndarray, backward: np.ndarray, grid: np.ndarray | None = None) -> np.ndarray:
    """(H, W) float32 in 0..1 from the round trip: 1 where it closes, 1/2 at the tolerance, 0 far off or outside.

    The tolerance is 0.75 px + 5 % of the flow's length (after Sundaram et al. 2010, made soft).
    """
    height, width = forward.shape[:2]
    grid = pixel_grid(height, width) if grid is None else grid
    tolerance = 0.75 + 0.05 * np.linalg.norm(forward, axis=-1)
    ratio = round_trip_error(forward, backward, grid) / tolerance
    soft = 1.0 / (1.0 + ratio**4)
    at = grid + forward
    inside = (at[..., 0] >= -0.5) & (at[..., 0] <= width - 0.5) & (at[..., 1] >= -0.5) & (at[..., 1] <= height - 0.5)
    return np.where(inside & (soft > 0.01), soft, 0.0).astype(np.float32)


@dataclass(frozen=True)
class FlowPair:
    """Flow between two frames of a clip, both ways, each (H, W, 2) with its confidence (H, W)."""

    step: int
    first_idx: int
    second_idx: int
    forward: np.ndarray
    backward: np.ndarray
    forward_confidence: np.ndarray
    backward_confidence: np.ndarray


def make_pair(step: int, first_idx: int, forward: np.ndarray, backward: np.ndarray, grid: np.ndarray) -> FlowPair:
    """A pair with its confidences."""
    return FlowPair(
        step,
        first_idx,
        first_idx + step,
        forward,
        backward,
        confidence(forward, backward, grid),
        confidence(backward, forward, grid),
    )


def direct_pairs(
    images: np.ndarray, steps: Sequence[int], match: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> Iterator[FlowPair]:
    """All pairs of (T, H, W, ...) frames at the given steps, by one matcher (first, second) -> flow."""
    grid = pixel_grid(*images.shape[1:3])
    for step in steps:
        for i in range(len(images) - step):
            a, b = images[i], images[i + step]
            yield make_pair(step, i, match(a, b), match(b, a), grid)


@dataclass(frozen=True)
class Chain:
    """All pairs of a clip: neighbours are matched, longer steps are chains of theirs.

    A chain drifts, but far less than a direct match goes astray: on generated clips it is wrong by a third to a half as
    much as a match that starts from the chain, at steps of 2, 4 and 8, and closes its round trip more often
    (docs/perception.md). `frames` is (T, H, W) uint8.
    """

    frames: np.ndarray
    matcher: Matcher

    def pairs(self, steps: Sequence[int]) -> Iterator[FlowPair]:
        """Every pair (i, i + step) of every step, ascending; what all steps are multiples of is matched."""
        grid = pixel_grid(*self.frames.shape[1:3])
        ascending = sorted(set(steps))
        link = math.gcd(*ascending)
        count = len(self.frames)
        links = [self._matched(i, i + link) for i in range(max(0, count - link))]
        before, length = links, link
        for step in ascending:
            after = []
            for i in range(max(0, count - step)):
                if step == link:
                    there, back = links[i]
                elif step == 2 * length:
                    there, back = _joined(before[i], before[i + length], grid)
                else:
                    there, back = links[i]
                    for k in range(link, step, link):
                        there, back = _joined((there, back), links[i + k], grid)
                after.append((there, back))
                yield make_pair(step, i, there, back, grid)
            before, length = after, step

    def _matched(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        a, b = self.frames[i], self.frames[j]
        return self.matcher(a, b), self.matcher(b, a)


def _joined(
    one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray], grid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Flow there and back over two links."""
    return compose(one[0], two[0], grid), compose(two[1], one[1], grid)
