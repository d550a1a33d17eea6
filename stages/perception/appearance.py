"""How the object looks in this very clip: small classifiers fitted to the clip's own uncertain labels, then read back.

Labels come from motion; a classifier of low capacity cannot copy their errors, so what it predicts is cleaner than
what it was taught: pixel by pixel, on colour (`PixelColours`).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn import functional
from torch.optim.adamw import adamw

from stages.perception.background import to_lab

LAB_UNIT = np.array([50.0, 25.0, 25.0], np.float32)
LOGIT_LIMIT = 6.0
RATE = 1.5e-2


class PixelColours:
    """Foreground log-odds of a pixel from its features, a small multi-layer perceptron."""

    def __init__(self, channels: int, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.net = nn.Sequential(nn.Linear(channels, 48), nn.ReLU(), nn.Linear(48, 32), nn.ReLU(), nn.Linear(32, 1))
        _seed_weights(self.net, generator)
        self.generator = generator
        self.mean, self.scale = torch.zeros(channels), torch.ones(channels)

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
        flat = torch.from_numpy(values.reshape(-1, values.shape[-1]))
        y = torch.from_numpy(np.ascontiguousarray(label, np.float32).ravel())
        w = torch.from_numpy(np.ascontiguousarray(weight, np.float32).ravel())
        positive = torch.nonzero((w > 0.05) & (y > 0.5))[:, 0]
        negative = torch.nonzero((w > 0.05) & (y < 0.5))[:, 0]
        if len(positive) < 20 or len(negative) < 20:
            return False
        some = flat[torch.randint(len(flat), (20000,), generator=self.generator)]
        self.mean, self.scale = some.mean(0), some.std(0) + 1e-3
        descend = _Descent(list(self.net.parameters()))
        for step in range(steps):
            # Settles along a cosine: better than twice the steps at one rate.
            rate = RATE * max(0.03, 0.5 + 0.5 * math.cos(math.pi * (step + 1) / steps))
            chosen = torch.cat(
                [
                    positive[torch.randint(len(positive), (batch // 3,), generator=self.generator)],
                    negative[torch.randint(len(negative), (2 * batch // 3,), generator=self.generator)],
                ]
            )
            inputs, wanted, trust = (flat[chosen] - self.mean) / self.scale, y[chosen], w[chosen]
            count = round(mixed * (batch // 3))
            if count:
                alpha = torch.rand(count, generator=self.generator)
                front, back = inputs[:count], inputs[-count:]
                blend = back + alpha[:, None] * (front - back)
                inputs = torch.cat([blend, inputs[count:]])
                wanted = torch.cat([(alpha > 0.5).float(), wanted[count:]])
                trust = torch.cat([(2 * alpha - 1).abs() * trust[:count], trust[count:]])
            logit = self.net(inputs)[:, 0]
            loss = functional.binary_cross_entropy_with_logits(logit, wanted, weight=trust)
            descend(torch.autograd.grad(loss, descend.weights), rate)
        return True

    @torch.no_grad()
    def logit(self, values: np.ndarray) -> np.ndarray:
        """Log-odds (...) of features (..., C), limited to +-6."""
        flat = torch.from_numpy(np.ascontiguousarray(values.reshape(-1, values.shape[-1])))
        found = torch.cat([self.net((part - self.mean) / self.scale)[:, 0] for part in flat.split(1 << 17)])
        return found.clamp(-LOGIT_LIMIT, LOGIT_LIMIT).numpy().reshape(values.shape[:-1])


class _Descent:
    """AdamW as a function of torch: its class brings in the whole compiler, 1.5 s of every process that segments."""

    def __init__(self, weights: list[nn.Parameter]) -> None:
        self.weights = weights
        self.first = [torch.zeros_like(w) for w in weights]
        self.second = [torch.zeros_like(w) for w in weights]
        self.counts = [torch.zeros(()) for _ in weights]

    @torch.no_grad()
    def __call__(self, gradients: tuple[torch.Tensor, ...], rate: float) -> None:
        adamw(
            list(self.weights), list(gradients), self.first, self.second, [], self.counts, foreach=False,
            amsgrad=False, beta1=0.9, beta2=0.999, lr=rate, weight_decay=1e-2, eps=1e-8, maximize=False,
        )  # fmt: skip


def _seed_weights(module: nn.Module, generator: torch.Generator) -> None:
    """Kaiming-uniform weights from a generator of our own (the global one is left alone)."""
    for name, parameter in module.named_parameters():
        with torch.no_grad():
            if parameter.ndim >= 2:
                fan_in = parameter[0].numel()
                parameter.uniform_(-1.0, 1.0, generator=generator).mul_((6.0 / fan_in) ** 0.5)
            elif name.endswith("bias"):
                parameter.zero_()


def scaled_lab(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 Lab of an 8-bit RGB image in units of about 1."""
    return to_lab(image) / LAB_UNIT - np.array([1.0, 0.0, 0.0], np.float32)


def coloured_surroundings(image: np.ndarray) -> np.ndarray:
    """(h, w, 12) float32: Lab as it is, blurred twice, and its local spread."""
    lab = scaled_lab(image)
    spread = cv2.GaussianBlur(lab**2, (0, 0), 1.2) - cv2.GaussianBlur(lab, (0, 0), 1.2) ** 2
    blurred = [cv2.GaussianBlur(lab, (0, 0), s) for s in (0.8, 1.6)]
    return np.concatenate([lab, *blurred, 3 * np.sqrt(np.maximum(spread, 0))], axis=-1)
