"""Dense optical flow between the frames of a clip: DIS, forward-backward confidence, chaining.

A flow (H, W, 2) float32 is in pixels, x to the right and y down: ``frame_j[p + flow[p]]`` shows what
``frame_i[p]`` does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np


def new_matcher(preset: str = "medium") -> cv2.DISOpticalFlow:
    """A DIS matcher (Kroeger et al. 2016); `preset` is ultrafast, fast or medium."""
    presets = {
        "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
        "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
        "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
    }
    return cv2.DISOpticalFlow_create(presets[preset])


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


def chained_pairs(grey: np.ndarray, steps: Sequence[int], matcher: cv2.DISOpticalFlow) -> Iterator[FlowPair]:
    """All pairs of (T, H, W) uint8 frames at the given steps by DIS, long steps started from chained short ones.

    A step that is a sum of two earlier equal ones (2 = 1 + 1, 4 = 2 + 2 ...) is matched twice, from nothing and from
    the chain; each pixel takes the one whose round trip closes better.
    """
    grid = pixel_grid(*grey.shape[1:3])
    kept: dict[int, dict[int, FlowPair]] = {}
    for step in steps:
        level: dict[int, FlowPair] = {}
        half = kept.get(step // 2, {}) if step % 2 == 0 else {}
        for i in range(len(grey) - step):
            a, b = grey[i], grey[i + step]
            one, two = half.get(i), half.get(i + step // 2)
            if one is None or two is None:
                pair = make_pair(step, i, matcher.calc(a, b, None), matcher.calc(b, a, None), grid)
            else:
                pair = _matched_from_chain(a, b, step, i, one, two, matcher, grid)
            level[i] = pair
            yield pair
        kept = {step: level}


def _matched_from_chain(
    a: np.ndarray,
    b: np.ndarray,
    step: int,
    first_idx: int,
    one: FlowPair,
    two: FlowPair,
    matcher: cv2.DISOpticalFlow,
    grid: np.ndarray,
) -> FlowPair:
    there, back = compose(one.forward, two.forward, grid), compose(two.backward, one.backward, grid)
    chained = make_pair(step, first_idx, matcher.calc(a, b, there.copy()), matcher.calc(b, a, back.copy()), grid)
    direct = make_pair(step, first_idx, matcher.calc(a, b, None), matcher.calc(b, a, None), grid)
    forward = _better(chained.forward, chained.forward_confidence, direct.forward, direct.forward_confidence)
    backward = _better(chained.backward, chained.backward_confidence, direct.backward, direct.backward_confidence)
    return make_pair(step, first_idx, forward, backward, grid)


def _better(a: np.ndarray, sure_a: np.ndarray, b: np.ndarray, sure_b: np.ndarray) -> np.ndarray:
    """Per pixel the flow whose neighbourhood closes its round trip better; ties go to `a`."""
    lead = cv2.blur(sure_b, (7, 7)) - cv2.blur(sure_a, (7, 7))
    return np.where((lead > 0.05)[..., None], b, a)
