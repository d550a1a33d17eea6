"""What moves against the background: flow that a smooth camera motion does not explain.

The background's flow between two frames is fitted by a cubic polynomial of the image coordinates (a rotation, a zoom
and a plane at any slant are close to quadratic; the cubic takes up a room of several planes), robustly, with the
border of the image trusted more than its middle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from stages.perception.optical_flow import new_matcher


def polynomial_basis(height: int, width: int) -> np.ndarray:
    """(H*W, 10) cubic monomials of coordinates scaled to -1..1."""
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    x = (2.0 * columns / max(width - 1, 1) - 1.0).ravel()
    y = (2.0 * rows / max(height - 1, 1) - 1.0).ravel()
    terms = [np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    return np.stack(terms, axis=1)


def background_residual(
    flow: np.ndarray, trust: np.ndarray, basis: np.ndarray, stride: int = 3
) -> tuple[np.ndarray, float]:
    """Distance (H, W) in pixels of a flow from the fitted background flow, and the background's own scatter.

    `trust` (H, W) in 0..1 says how surely a pixel is background before looking at its motion. Iteratively reweighted
    least squares with Geman-McClure weights on every `stride`-th pixel, the width annealed from wide to narrow.
    """
    height, width = flow.shape[:2]
    picked = np.zeros((height, width), bool)
    picked[stride // 2 :: stride, stride // 2 :: stride] = True
    chosen = picked.ravel()
    a, b, prior = (
        basis[chosen],
        flow.reshape(-1, 2)[chosen].astype(np.float64),
        trust.ravel()[chosen].astype(np.float64),
    )
    sure = prior >= np.quantile(prior, 0.5)
    weight, scatter = prior, 1.0
    coefficients = np.zeros((a.shape[1], 2))
    for step in range(10):
        weighted = a * weight[:, None]
        coefficients = np.linalg.solve(weighted.T @ a + 1e-4 * np.eye(a.shape[1]), weighted.T @ b)
        error = np.linalg.norm(b - a @ coefficients, axis=1)
        scatter = max(1.48 * float(np.median(error[sure])), 0.05)
        width_px = scatter * (3.0 if step < 4 else 1.5)
        weight = prior / (1.0 + (error / width_px) ** 2) ** 2
    residual = np.linalg.norm(flow.reshape(-1, 2) - basis @ coefficients, axis=1)
    return residual.reshape(height, width).astype(np.float32), scatter


def motion_saliency(
    grey: Sequence[np.ndarray],
    trust: Callable[[int], np.ndarray],
    steps: Sequence[int] = (1, 3, 6),
    tick: Callable[[int], None] = lambda done: None,
) -> np.ndarray:
    """(T, h, w) float32 in 0..1: how surely each pixel of (h, w) uint8 grey frames moves against the background.

    The mean over the frames `steps` before and after of r^2 / (r^2 + (2.5 s + 0.2 px)^2), r the residual and s the
    background's scatter; `trust(t)` gives the background prior of frame t.
    """
    height, width = grey[0].shape
    basis = polynomial_basis(height, width)
    matcher = new_matcher("medium")
    out = np.zeros((len(grey), height, width), np.float32)
    for t in range(len(grey)):
        prior = trust(t)
        votes = []
        for other in [t + sign * step for step in steps for sign in (-1, 1)]:
            if 0 <= other < len(grey):
                flow = matcher.calc(grey[t], grey[other], None)
                residual, scatter = background_residual(flow, prior, basis)
                votes.append(residual**2 / (residual**2 + (2.5 * scatter + 0.2) ** 2))
        if votes:
            out[t] = np.mean(votes, axis=0)
        tick(t + 1)
    return out


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
