"""What moves against the background: flow that a smooth camera motion does not explain, and pixels that prove it.

The background's flow between two frames is fitted by a cubic polynomial of the image coordinates (a rotation, a zoom
and a plane at any slant are close to quadratic; the cubic takes up a room of several planes), robustly, with the
border of the image trusted more than its middle, and then bent locally to what the surrounding background does.
Dense flow is smooth and so bleeds over an object's edge by several pixels. Whether a pixel itself belongs to the
background is therefore asked of the images: is its colour explained better by the background's motion or by the flow?
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stages.perception.optical_flow import Matcher, pixel_grid, sample

STEPS = (1, 3, 6)
"""Frames before and after that each frame is compared with."""
SETTLED_PX = 0.02
"""The background's flow is found when another step changes it nowhere by more."""
EVIDENCE_LIMIT = 3.0
"""Largest log-likelihood ratio one comparison may give a pixel."""


@dataclass(frozen=True)
class MotionCues:
    """Per pixel of (T, h, w) frames, float32.

    `moving` in 0..1: the flow differs from the background's (blurred at edges). `evidence`: log-likelihood ratio object
    against background from colours under both motions (sharp; 0 where the two motions agree, so that nothing is known).
    """

    moving: np.ndarray
    evidence: np.ndarray


def polynomial_basis(height: int, width: int) -> np.ndarray:
    """(H*W, 10) float32 cubic monomials of coordinates scaled to -1..1."""
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    x = (2.0 * columns / max(width - 1, 1) - 1.0).ravel()
    y = (2.0 * rows / max(height - 1, 1) - 1.0).ravel()
    terms = [np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    return np.stack(terms, axis=1)


def background_flow(
    flow: np.ndarray, trust: np.ndarray, basis: np.ndarray, samples: int = 2048
) -> tuple[np.ndarray, float]:
    """The background's flow (H, W, 2) under a flow, and its scatter about the fit in pixels.

    `trust` (H, W) in 0..1 says how surely a pixel is background before looking at its motion. Iteratively reweighted
    least squares with Geman-McClure weights on about `samples` pixels, the width annealed from wide to narrow.
    """
    height, width = flow.shape[:2]
    stride = max(1, int(np.sqrt(height * width / samples)))
    grid = (slice(stride // 2, None, stride), slice(stride // 2, None, stride))
    a = basis.reshape(height, width, -1)[grid].reshape(-1, basis.shape[1]).astype(np.float64)
    b = flow[grid].reshape(-1, 2).astype(np.float64)
    prior = trust[grid].ravel().astype(np.float64)
    sure = prior >= np.quantile(prior, 0.5)
    weight, scatter = prior, 1.0
    coefficients: np.ndarray = np.zeros((a.shape[1], 2))
    fitted = np.zeros_like(b)
    for step in range(10):
        weighted = a * weight[:, None]
        coefficients = np.linalg.solve(weighted.T @ a + 1e-4 * np.eye(a.shape[1]), weighted.T @ b)
        before, fitted = fitted, a @ coefficients
        left = b - fitted
        error = np.hypot(left[:, 0], left[:, 1])
        scatter = max(1.48 * upper_median(error[sure]), 0.1)
        if step > 4 and np.abs(fitted - before).max() < SETTLED_PX:
            break
        weight = prior / (1.0 + (error / (scatter * (3.0 if step < 4 else 1.5))) ** 2) ** 2
    return (basis @ coefficients.astype(np.float32)).reshape(height, width, 2), scatter


def bend_to_surroundings(fitted: np.ndarray, flow: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """A fitted background flow plus what the flow of nearby background pixels adds, spread over the object too.

    `weight` (H, W) in 0..1 is 1 on the background. Normalised convolution at a quarter of the size, narrow where there
    is background near, wide where there is not.
    """
    height, width = weight.shape
    size = (max(1, width // 4), max(1, height // 4))
    weight = weight.astype(np.float32) + 1e-4
    added = cv2.resize((flow - fitted) * weight[..., None], size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    sums = [(cv2.GaussianBlur(added, (0, 0), s), cv2.GaussianBlur(total, (0, 0), s)) for s in (2.0, 6.0)]
    numerator, denominator = sums[0][0] + 0.05 * sums[1][0], sums[0][1] + 0.05 * sums[1][1]
    spread = numerator / (denominator + 1e-6)[..., None]
    return fitted + cv2.resize(spread, (width, height), interpolation=cv2.INTER_LINEAR)


def envelope_error(colours: np.ndarray, warped: np.ndarray) -> np.ndarray:
    """(H, W) distance of colours (H, W, 3) from the range of the warped image's 3x3 neighbourhood.

    Zero where a shift of up to a pixel explains the colour.
    """
    kernel = np.ones((3, 3), np.uint8)
    above = cv2.subtract(colours, cv2.dilate(warped, kernel))
    below = cv2.subtract(cv2.erode(warped, kernel), colours)
    outside = np.maximum(np.maximum(above, below), 0.0)
    return np.sqrt(np.einsum("hwc,hwc->hw", outside, outside))


def motion_cues(
    images: Sequence[np.ndarray],
    steps: Sequence[int] = STEPS,
    tick: Callable[[int], None] = lambda done: None,
) -> MotionCues:
    """Motion cues of every frame (h, w, 3) uint8 RGB, each against the frames `steps` before and after.

    `moving` is the mean of r^2 / (r^2 + (2.5 s + 0.4 px)^2), r the distance from the background's flow, s its scatter.
    `evidence` is averaged over steps, after the smaller of before and after: what is covered in one of them would
    otherwise look like an object there.
    """
    count = len(images)
    height, width = images[0].shape[:2]
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    lab = [cv2.GaussianBlur(to_lab(image), (0, 0), 0.6) for image in images]
    basis, grid = polynomial_basis(height, width), pixel_grid(height, width)
    trust = np.where(border_distance(height, width) > 0.55, 1.0, 0.25).astype(np.float32)
    matcher = Matcher("medium")
    moving = np.zeros((count, height, width), np.float32)
    evidence = np.zeros((count, height, width), np.float32)
    for t in range(count):
        votes, proofs = [], []
        for step in steps:
            sides = []
            for other in (t - step, t + step):
                if 0 <= other < count:
                    flow = matcher(grey[t], grey[other])
                    vote, proof = _compare(lab[t], lab[other], flow, trust, basis, grid)
                    votes.append(vote)
                    sides.append(proof)
            if sides:
                proofs.append(np.minimum(*sides) if len(sides) == 2 else 0.5 * sides[0])
        if votes:
            moving[t] = np.mean(votes, axis=0)
            evidence[t] = cv2.GaussianBlur(np.mean(proofs, axis=0), (0, 0), 0.7)
        tick(t + 1)
    return MotionCues(moving, evidence)


def _compare(
    here: np.ndarray, there: np.ndarray, flow: np.ndarray, trust: np.ndarray, basis: np.ndarray, grid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Moving vote and colour evidence of one frame against another."""
    height, width = flow.shape[:2]
    fitted, scatter = background_flow(flow, trust, basis)
    left = flow - fitted
    squared = np.einsum("hwc,hwc->hw", left, left)
    vote = squared / (squared + (2.5 * scatter + 0.4) ** 2)
    background = bend_to_surroundings(fitted, flow, np.clip(1 - 2 * vote, 0, 1))
    beside = flow - background
    apart = np.hypot(beside[..., 0], beside[..., 1])
    as_background = envelope_error(here, sample(there, background, grid))
    as_flow = envelope_error(here, sample(there, flow, grid))
    noise = max(1.48 * upper_median(as_flow), 1.0)
    ratio = np.clip((as_background**2 - as_flow**2) / (2 * noise**2), -EVIDENCE_LIMIT, EVIDENCE_LIMIT)
    at = grid + background
    inside = (at[..., 0] >= 0) & (at[..., 0] <= width - 1) & (at[..., 1] >= 0) & (at[..., 1] <= height - 1)
    return vote, np.where(inside, ratio * np.clip(apart - 0.5, 0, 1), 0.0).astype(np.float32)


def upper_median(values: np.ndarray) -> float:
    """The median, the upper of the two in the middle of an even number: half the time of numpy's."""
    middle = values.size // 2
    return float(np.partition(values, middle, axis=None)[middle])


def to_lab(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 CIE Lab (L 0..100) of an 8-bit RGB image."""
    return cv2.cvtColor(image.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)


def border_distance(height: int, width: int) -> np.ndarray:
    """(H, W) float32: 0 in the middle of the image, 1 at its border (the larger of the two coordinates)."""
    x = np.abs((np.arange(width) + 0.5) / width * 2 - 1)
    y = np.abs((np.arange(height) + 0.5) / height * 2 - 1)
    return np.maximum(x[None, :], y[:, None]).astype(np.float32)


def shrink(image: np.ndarray, side_px: int) -> np.ndarray:
    """An image whose longer side is at most `side_px`, by area averaging."""
    scale = side_px / max(image.shape[:2])
    if scale >= 1:
        return image
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
