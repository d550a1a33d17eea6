"""How the object looks in this very clip: small classifiers fitted to the clip's own uncertain labels, then read back.

Labels come from motion; a classifier of low capacity cannot copy their errors, so what it predicts is cleaner than
what it was taught: pixel by pixel, on colour (`PixelColours`).
"""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np

from stages.perception.background import to_lab

LAB_UNIT = np.array([50.0, 25.0, 25.0], np.float32)
LOGIT_LIMIT = 6.0
RATE = 1.5e-2
HIDDEN = (48, 32)
_DECAY, _MEMORY, _TINY = 1e-2, (0.9, 0.999), 1e-8  # AdamW's usual ones
_AT_ONCE = 1 << 13  # pixels whose values are kept in the cache


class PixelColours:
    """Foreground log-odds of a pixel from its features, a small multi-layer perceptron.

    Without torch on purpose: it is a hundred lines of products, and torch takes longer to import than they run.
    """

    def __init__(self, channels: int, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        sizes = [channels, *HIDDEN, 1]
        shapes = list(pairwise(sizes))
        self._all = np.zeros(sum(a * b + b for a, b in shapes), np.float32)
        self._kernels, self._biases = _views(self._all, shapes)
        for kernel in self._kernels:  # Kaiming
            kernel[:] = self._rng.uniform(-1, 1, kernel.shape) * math.sqrt(6.0 / len(kernel))
        self._shapes = shapes
        self.mean, self.scale = np.zeros(channels, np.float32), np.ones(channels, np.float32)

    def fit(
        self,
        values: np.ndarray,
        label: np.ndarray,
        weight: np.ndarray,
        steps: int = 240,
        batch: int = 4096,
        mixed: float = 0.0,
    ) -> bool:
        """Fit to features (..., C), labels (...) in {0, 1} and weights (...); False where one class has no pixels.

        A third of each batch is foreground. A share `mixed` of it is blended with background at random, and counts as
        what it is mostly: pixels on an outline are such blends, and look more like the object than they are.
        """
        flat = values.reshape(-1, values.shape[-1])
        w = np.asarray(weight, np.float32).ravel()
        inside = np.asarray(label).ravel() > 0.5
        positive, negative = np.flatnonzero((w > 0.05) & inside), np.flatnonzero((w > 0.05) & ~inside)
        if len(positive) < 20 or len(negative) < 20:
            return False
        some = flat[self._rng.integers(len(flat), size=20000)]
        self.mean, self.scale = some.mean(0), some.std(0) + np.float32(1e-3)
        front, rest = batch // 3, 2 * batch // 3
        wanted = np.concatenate([np.ones(front, np.float32), np.zeros(rest, np.float32)])
        blended = round(mixed * front)
        descend = _Descent(self._all)
        for step in range(steps):
            # Settles along a cosine: better than twice the steps at one rate.
            rate = RATE * max(0.03, 0.5 + 0.5 * math.cos(math.pi * (step + 1) / steps))
            chosen = np.concatenate(
                [
                    positive[self._rng.integers(len(positive), size=front)],
                    negative[self._rng.integers(len(negative), size=rest)],
                ]
            )
            inputs, trust = (flat[chosen] - self.mean) / self.scale, w[chosen]
            if blended:
                alpha = self._rng.random(blended, np.float32)
                back = inputs[-blended:]
                inputs[:blended] = back + alpha[:, None] * (inputs[:blended] - back)
                wanted[:blended] = alpha > 0.5
                trust[:blended] *= np.abs(2 * alpha - 1)
            descend(self._gradient(inputs, wanted, trust), rate)
        return True

    def logit(self, values: np.ndarray) -> np.ndarray:
        """Log-odds (...) of features (..., C), limited to +-6."""
        flat = values.reshape(-1, values.shape[-1])
        kernel = self._kernels[0] / self.scale[:, None]
        bias = self._biases[0] - self.mean @ kernel
        out = np.empty(len(flat), np.float32)
        for first in range(0, len(flat), _AT_ONCE):
            x = flat[first : first + _AT_ONCE] @ kernel
            x += bias
            for inner, shift in zip(self._kernels[1:], self._biases[1:], strict=True):
                x = np.maximum(x, 0, out=x) @ inner
                x += shift
            out[first : first + _AT_ONCE] = x[:, 0]
        return np.clip(out, -LOGIT_LIMIT, LOGIT_LIMIT).reshape(values.shape[:-1])

    def _gradient(self, inputs: np.ndarray, wanted: np.ndarray, trust: np.ndarray) -> np.ndarray:
        """Of the mean binary cross-entropy, each pixel weighed by its trust, with respect to all weights (flat)."""
        layers = [inputs]
        for kernel, bias in zip(self._kernels[:-1], self._biases[:-1], strict=True):
            x = layers[-1] @ kernel
            x += bias
            layers.append(np.maximum(x, 0, out=x))
        logit = np.clip(layers[-1] @ self._kernels[-1] + self._biases[-1], -30, 30)[:, 0]
        back = (trust * (1.0 / (1.0 + np.exp(-logit)) - wanted) / np.float32(len(wanted)))[:, None]
        out = np.empty_like(self._all)
        kernels, biases = _views(out, self._shapes)
        for k in range(len(layers) - 1, -1, -1):
            kernels[k][:] = layers[k].T @ back
            biases[k][:] = back.sum(0)
            if k:
                back = (back @ self._kernels[k].T) * (layers[k] > 0)
        return out


class _Descent:
    """AdamW (Loshchilov and Hutter, 2019) on one flat array of weights, in place."""

    def __init__(self, weights: np.ndarray) -> None:
        self.weights, self.count = weights, 0
        self.first, self.second = np.zeros_like(weights), np.zeros_like(weights)

    def __call__(self, gradient: np.ndarray, rate: float) -> None:
        self.count += 1
        for moment, value, memory in ((self.first, gradient, _MEMORY[0]), (self.second, gradient**2, _MEMORY[1])):
            moment += np.float32(1 - memory) * (value - moment)
        first = self.first / np.float32(1 - _MEMORY[0] ** self.count)
        second = self.second / np.float32(1 - _MEMORY[1] ** self.count)
        self.weights *= np.float32(1 - rate * _DECAY)
        self.weights -= np.float32(rate) * first / (np.sqrt(second) + np.float32(_TINY))


def _views(flat: np.ndarray, shapes: list[tuple[int, int]]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Kernels (a, b) and biases (b,) that share a flat array's memory."""
    kernels, biases, at = [], [], 0
    for a, b in shapes:
        kernels.append(flat[at : at + a * b].reshape(a, b))
        biases.append(flat[at + a * b : at + a * b + b])
        at += a * b + b
    return kernels, biases


def scaled_lab(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 Lab of an 8-bit RGB image in units of about 1."""
    return to_lab(image) / LAB_UNIT - np.array([1.0, 0.0, 0.0], np.float32)


def coloured_surroundings(image: np.ndarray) -> np.ndarray:
    """(h, w, 12) float32: Lab as it is, blurred twice, and its local spread."""
    lab = scaled_lab(image)
    spread = cv2.GaussianBlur(lab**2, (0, 0), 1.2) - cv2.GaussianBlur(lab, (0, 0), 1.2) ** 2
    blurred = [cv2.GaussianBlur(lab, (0, 0), s) for s in (0.8, 1.6)]
    return np.concatenate([lab, *blurred, 3 * np.sqrt(np.maximum(spread, 0))], axis=-1)
