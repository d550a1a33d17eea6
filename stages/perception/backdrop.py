"""Which pixels beside a mask contradict the background: what other frames of the clip show there is not there now.

Dark shoes on dark ground have its colours, but not its pattern. Other frames show the same ground without the foot.
They are registered to this one by the background's motion, and small patches compared by their correlation, which a
shadow leaves alone. What correlation to expect where the background is seen says, around each place, how far to
believe a low one. Frames see a place at different times, so a foot that stands still for a while is found, too; an
object that never leaves its place is not. Things nearer and farther than the rest seem to contradict as well; it is for
`missing_pieces` to tell them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from stages.perception.background import background_flow, polynomial_basis
from stages.perception.optical_flow import Matcher, compose, pixel_grid
from stages.perception.temporal import disc, enlarge, mask_box

ANCHOR_STEP = 12
"""Every so many frames one is compared with those around it."""
ANCHOR_SPAN, ANCHOR_NEAR = 36, 3
"""Frames at most, and at least, between the two compared."""
PATCH_PX = 1.5  # Gaussian width of a patch; pixel figures are at the working size of 256
OBJECT_CORRELATION = 0.1, 0.22  # mean and deviation of the correlation where something else is seen
LIMIT = 4.0  # largest log-likelihood ratio one comparison gives a pixel
GAIN = 1.5  # of the mean over comparisons, which are far from independent
_NOISE = 4.0  # variance of lightness (0..100) that carries no pattern
_PATTERN = 15.0  # variance at which a patch counts half
_SPREAD_FLOOR = 0.05
_AROUND_PX = 16.0  # width of the surroundings that say what to expect
_FAT_PX, _SKIN_PX, _CLEAR_PX = 12, 1, 6  # about a mask: not registered by; not compared; surely background beyond
_RING_PX = 60
_LEAST_SEEN = 0.25  # of a patch outside both masks
Tick = Callable[[int, int], None]


@dataclass(frozen=True)
class Contradiction:
    """What other frames say of each pixel outside the masks, (T, h, w) float32 each.

    `evidence`: log-odds that the object covers it, 0 where nothing is known. `weight`: how many comparisons bear on it.
    """

    evidence: np.ndarray
    weight: np.ndarray


def contradiction(
    work: list[np.ndarray],
    masks: np.ndarray,
    to_next: list[np.ndarray],
    to_previous: list[np.ndarray],
    tick: Tick = lambda done, total: None,
) -> Contradiction:
    """Evidence beside the masks (T, h, w) bool of frames (h, w, 3) uint8 RGB.

    `to_next[t]` is the flow t -> t+1 and `to_previous[t]` t+1 -> t, at any smaller size.
    """
    count, height, width = masks.shape
    lightness = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) * (100 / 255) for image in work]
    eight = masks.astype(np.uint8)
    free = [(cv2.dilate(m, disc(_SKIN_PX)) == 0).astype(np.float32) for m in eight]
    clear = [(cv2.dilate(m, disc(_CLEAR_PX)) == 0).astype(np.float32) for m in eight]
    windows = [_window(m) for m in masks]
    total, weight = np.zeros((2, count, height, width), np.float32)
    for t, anchor, at in registered(work, eight, to_next, to_previous, tick):
        if (part := windows[t]) is None:
            continue
        at = np.ascontiguousarray(at[part])
        other = _looked_up(lightness[anchor], at)
        off_other = cv2.remap(free[anchor], at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)  # type: ignore[call-overload]
        seen = np.where(off_other > 0.99, free[t][part], 0.0).astype(np.float32)
        ratio, trust = _compared(lightness[t][part], other, seen, clear[t][part])
        total[t][part] += trust * ratio
        weight[t][part] += trust
    evidence = GAIN * total / (weight + 1.0)
    for t in range(count):
        # Where the background itself seems to contradict, as past an edge of two planes, that much is no evidence.
        usual = _around(clear[t] * np.maximum(evidence[t], 0)) / (_around(clear[t]) + 1e-3)
        evidence[t] -= usual * (weight[t] > 0)
    return Contradiction(evidence, weight)


def registered(
    work: list[np.ndarray],
    masks: np.ndarray,
    to_next: list[np.ndarray],
    to_previous: list[np.ndarray],
    tick: Tick = lambda done, total: None,
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Frame, anchor and where the frame's background is in the anchor, (h, w, 2) float32 column and row of pixels.

    From an anchor outwards the background's motion is joined frame by frame, and at each frame fitted anew to what is
    left of it, so that it does not drift. `masks` is (T, h, w) uint8.
    """
    count, height, width = masks.shape
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in work]
    trust = [_registration_trust(m) for m in masks]
    basis, grid = polynomial_basis(height, width), pixel_grid(height, width)
    forth = _backgrounds(to_next, trust[:-1])
    back = _backgrounds(to_previous, trust[1:])
    matcher = Matcher("ultrafast")
    anchors = range(0, count, ANCHOR_STEP)
    for done, anchor in enumerate(anchors):
        for way in (1, -1):
            at = grid
            for t in range(anchor + way, anchor + way * (ANCHOR_SPAN + 1), way):
                if not 0 <= t < count:
                    break
                nearer = back[t - 1] if way > 0 else forth[t]
                at = _joined(at, enlarge(nearer, width, height), grid)
                left, _ = background_flow(matcher(grey[t], _looked_up(grey[anchor], at)), trust[t], basis, 512)
                at = _joined(at, left, grid)
                if abs(t - anchor) >= ANCHOR_NEAR:
                    yield t, anchor, at
        tick(done + 1, len(anchors))


def _joined(at: np.ndarray, flow: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Where a frame's pixels are in the anchor, by their flow to a frame whose pixels are there at `at`.

    Beyond that frame's border its motion goes on, so that what enters the picture is known to be outside the anchor's.
    """
    return grid + compose(flow, at - grid, grid)


def _registration_trust(mask: np.ndarray) -> np.ndarray:
    """(h, w) how far a pixel's motion counts as the background's: most around the object, not at all on it."""
    fat = cv2.dilate(mask, disc(_FAT_PX))
    ring = cv2.dilate(fat, np.ones((2 * _RING_PX + 1, 2 * _RING_PX + 1), np.uint8))
    return np.where(fat > 0, 0.0, np.where(ring > 0, 1.0, 0.3)).astype(np.float32)


def _backgrounds(flows: list[np.ndarray], trust: list[np.ndarray]) -> list[np.ndarray]:
    """The background's motion under each flow (h', w', 2)."""
    if not flows:
        return []
    height, width = flows[0].shape[:2]
    basis = polynomial_basis(height, width)
    small = [cv2.resize(t, (width, height), interpolation=cv2.INTER_AREA) for t in trust]
    return [background_flow(flow, t, basis)[0] for flow, t in zip(flows, small, strict=True)]


def _compared(
    here: np.ndarray, there: np.ndarray, seen: np.ndarray, clear: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihood ratio object against background of registered lightness (h, w), and its trust in 0..1.

    `seen` is 1 where neither frame shows the object, `clear` where this one surely shows the background.
    """
    correlation, pattern, share = patch_correlation(here, there, seen)
    bears = (share > _LEAST_SEEN) * seen * (pattern / (pattern + _PATTERN))
    known = (bears * clear).astype(np.float32)
    amount = _around(known) + 1e-6
    expected = _around(known * correlation) / amount
    spread = np.sqrt(np.maximum(_around(known * correlation**2) / amount - expected**2, 0) + _SPREAD_FLOOR**2)
    mean, deviation = OBJECT_CORRELATION
    ratio = 0.5 * ((correlation - expected) / spread) ** 2 + np.log(spread / deviation)
    ratio -= 0.5 * ((correlation - mean) / deviation) ** 2
    # Beyond either mean the nearer explanation holds, whatever the tails of the two would say.
    ratio = np.where(correlation > expected, np.minimum(ratio, -1.0), ratio)
    ratio = np.where(correlation < mean, np.maximum(ratio, 0.0), ratio)
    telling = np.clip((expected - mean - 1.2 * spread) / 0.2, 0, 1) * np.clip(amount / 0.05, 0, 1)
    return np.clip(ratio, -LIMIT, LIMIT).astype(np.float32), (telling * bears).astype(np.float32)


def patch_correlation(
    first: np.ndarray, second: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlation of Gaussian patches of two images (h, w), each pixel counting by its weight (h, w).

    Also the larger of the two variances, and the share of the patch that counts. Two patches without a pattern, whose
    variance is noise, correlate by 0.
    """
    share = _blurred(weight)
    norm = share + 1e-6
    mean_a, mean_b = _blurred(weight * first) / norm, _blurred(weight * second) / norm
    var_a = np.maximum(_blurred(weight * first * first) / norm - mean_a * mean_a, 0)
    var_b = np.maximum(_blurred(weight * second * second) / norm - mean_b * mean_b, 0)
    joint = _blurred(weight * first * second) / norm - mean_a * mean_b
    return joint / np.sqrt((var_a + _NOISE) * (var_b + _NOISE)), np.maximum(var_a, var_b), share


def _window(mask: np.ndarray) -> tuple[slice, slice] | None:
    """The part of the frame around its object that is compared; None without an object."""
    box = mask_box(mask)
    if not box.any():
        return None
    x0, y0, x1, y1 = (int(v) for v in box)
    margin = _RING_PX
    return slice(max(0, y0 - margin), y1 + margin), slice(max(0, x0 - margin), x1 + margin)


def _looked_up(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`values` (H, W, ...) at columns and rows `at` (h, w, 2), bilinear, the border repeated."""
    return cv2.remap(values, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]


def _blurred(values: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(values, (0, 0), PATCH_PX)


def _around(values: np.ndarray) -> np.ndarray:
    """Mean over the surroundings (h, w), worked out at a quarter of the size."""
    height, width = values.shape
    small = cv2.resize(values, (max(1, width // 4), max(1, height // 4)), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), _AROUND_PX / 4), (width, height), interpolation=cv2.INTER_LINEAR)
