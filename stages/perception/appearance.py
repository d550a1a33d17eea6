"""How the object looks in this very clip: small classifiers fitted to the clip's own uncertain labels, then read back.

Labels come from motion; a classifier of low capacity cannot copy their errors, so what it predicts is cleaner than
what it was taught. First pixel by pixel on colour (`PixelColours`), then with surroundings by a small convolutional
network (`ClipNetwork`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from stages.perception.background import to_lab

LAB_UNIT = np.array([50.0, 25.0, 25.0], np.float32)
LOGIT_LIMIT = 6.0


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
        steps: int = 400,
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
        optimiser = torch.optim.AdamW(self.net.parameters(), 3e-3, weight_decay=1e-2)
        for _ in range(steps):
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
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        return True

    @torch.no_grad()
    def logit(self, values: np.ndarray) -> np.ndarray:
        """Log-odds (...) of features (..., C), limited to +-6."""
        flat = torch.from_numpy(np.ascontiguousarray(values.reshape(-1, values.shape[-1])))
        found = torch.cat([self.net((part - self.mean) / self.scale)[:, 0] for part in flat.split(1 << 17)])
        return found.clamp(-LOGIT_LIMIT, LOGIT_LIMIT).numpy().reshape(values.shape[:-1])


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1),
        nn.GroupNorm(4, outputs),
        nn.ReLU(),
        nn.Conv2d(outputs, outputs, 3, padding=1),
        nn.GroupNorm(4, outputs),
        nn.ReLU(),
    )


class _SmallUnet(nn.Module):
    """(N, 3, H, W) -> (N, 1, H, W), H and W multiples of 4; most of the work is done at half and quarter size."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.stem = nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.ReLU())
        self.at_half = _block(8, width)
        self.at_quarter = _block(width, 2 * width)
        self.join = _block(3 * width, width)
        self.narrow = nn.Conv2d(width, 8, 1)
        self.head = nn.Sequential(nn.Conv2d(16, 8, 3, padding=1), nn.ReLU(), nn.Conv2d(8, 1, 1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        stem = self.stem(x)
        half = self.at_half(functional.avg_pool2d(stem, 2))
        quarter = self.at_quarter(functional.avg_pool2d(half, 2))
        joined = self.join(torch.cat([half, functional.interpolate(quarter, scale_factor=2.0, mode="nearest")], 1))
        wide = functional.interpolate(self.narrow(joined), scale_factor=2.0, mode="nearest")
        head: torch.Tensor = self.head(torch.cat([stem, wide], 1))
        return head


class ClipNetwork:
    """A small U-Net fitted to one clip's crops around the object, on labels that are partly unknown."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.net = _SmallUnet().to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast on a CPU
        _seed_weights(self.net, self.generator)

    def fit(
        self,
        crops: np.ndarray,
        target: np.ndarray,
        weight: np.ndarray,
        steps: int,
        batch: int = 6,
        patch_px: int = 96,
        tick: Callable[[int], None] = lambda done: None,
    ) -> None:
        """Fit to Lab crops (N, H, W, 3) float32, soft targets (N, H, W) in 0..1 and weights (N, H, W)."""
        x = torch.from_numpy(np.ascontiguousarray(crops.transpose(0, 3, 1, 2)))
        y, w = torch.from_numpy(target.astype(np.float32)), torch.from_numpy(weight.astype(np.float32))
        optimiser = torch.optim.AdamW(self.net.parameters(), 4e-3, weight_decay=1e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=steps, pct_start=0.15)
        for step in range(steps):
            inputs, wanted, trust = self._patches(x, y, w, batch, patch_px)
            if torch.rand(1, generator=self.generator) < 0.5:
                inputs, wanted, trust = inputs.flip(-1), wanted.flip(-1), trust.flip(-1)
            gain = 1.0 + 0.08 * torch.randn(batch, 3, 1, 1, generator=self.generator)
            logit = self.net(inputs * gain)[:, 0]
            loss = functional.binary_cross_entropy_with_logits(logit, wanted, weight=trust)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            tick(step + 1)

    def _patches(
        self, x: torch.Tensor, y: torch.Tensor, w: torch.Tensor, batch: int, patch_px: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Random patches of the crops at 0.7 to 1.5 times their size: inputs, targets and weights, stacked."""
        picked = []
        for _ in range(batch):
            zoom = float(torch.empty(1).uniform_(-0.35, 0.4, generator=self.generator).exp())
            side = round(patch_px / zoom)
            height, width = min(side, x.shape[2]), min(side, x.shape[3])
            n, top, left = (
                int(torch.randint(high, (1,), generator=self.generator))
                for high in (len(x), x.shape[2] - height + 1, x.shape[3] - width + 1)
            )
            rows, columns = slice(top, top + height), slice(left, left + width)
            patch = torch.cat([x[n, :, rows, columns], y[n, None, rows, columns], w[n, None, rows, columns]])[None]
            picked.append(
                functional.interpolate(patch, size=(patch_px, patch_px), mode="bilinear", align_corners=False)
            )
        stacked = torch.cat(picked)
        return stacked[:, :3], stacked[:, 3], stacked[:, 4]

    @torch.no_grad()
    def logit(self, crops: np.ndarray) -> np.ndarray:
        """Log-odds (N, H, W) of Lab crops (N, H, W, 3), the mean of the crop and its mirror image, limited to +-6."""
        out = []
        for crop in crops:
            x = torch.from_numpy(np.ascontiguousarray(crop.transpose(2, 0, 1)))[None]
            both = torch.cat([x, x.flip(-1)])
            logit = self.net(both)[:, 0]
            out.append(((logit[0] + logit[1].flip(-1)) / 2).clamp(-LOGIT_LIMIT, LOGIT_LIMIT).numpy())
        return np.stack(out)


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
