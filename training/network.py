"""The network: a small UNet shared by the categories, with a mask, an embedding and a view of its own for each.

Input 4 x H x W: an RGB crop normalised by ImageNet's mean and deviation, and a mask. Where the object's mask is known,
it is the fourth channel (0 or 1) and the picture is zero off it; where it is not, the fourth channel is zero
everywhere. H and W are multiples of 16 for the dense outputs; the view's head takes 96 x 96.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

CATEGORIES = ("quadruped", "human")
INPUT_PX = 96
EMBEDDING = 16
AZIMUTHS, ELEVATIONS, ROLLS = 36, 12, 12
ELEVATION_DEG = tuple(-25.0 + 10.0 * i for i in range(ELEVATIONS))
ROLL_DEG = tuple(-41.25 + 7.5 * i for i in range(ROLLS))
AZIMUTH_DEG = tuple(-175.0 + 10.0 * i for i in range(AZIMUTHS))
"""Centres of the bins of the three angles of a view (synthetic.bank says what they mean)."""
VIEW_OUTPUTS = AZIMUTHS + ELEVATIONS + ROLLS
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def _conv(inputs: int, outputs: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class _Block(nn.Module):
    """Two convolutions and a way round them."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _conv(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.second(self.first(x)))


class _View(nn.Module):
    """From the coarsest features and the pooled fine ones to logits over azimuth, elevation and roll."""

    def __init__(self, coarse: int, fine: int) -> None:
        super().__init__()
        self.mix = _conv(coarse + fine, 64, size=1)
        self.spread = _conv(64, 64)
        side = INPUT_PX // 16
        self.hidden = nn.Linear(64 * side * side, 128)
        self.logits = nn.Linear(128, VIEW_OUTPUTS)

    def forward(self, features: Tensor) -> Tensor:
        x = self.spread(self.mix(features)).flatten(1)
        return self.logits(torch.relu(self.hidden(x)))


class Network(nn.Module):
    """See the module's text. About 2 million parameters."""

    def __init__(self) -> None:
        super().__init__()
        w2, w4, w8, w16 = 32, 64, 128, 176
        self.stem = _conv(16, w2)
        self.down4 = _conv(w2, w4, 2)
        self.at4 = _Block(w4)
        self.down8 = _conv(w4, w8, 2)
        self.at8 = nn.Sequential(_Block(w8), _Block(w8))
        self.down16 = _conv(w8, w16, 2)
        self.at16 = nn.Sequential(_Block(w16), _Block(w16))
        self.up8, self.side8, self.join8 = _lift(w16, w4), _side(w8, w4), _conv(w4, w4)
        self.up4, self.side4, self.join4 = _lift(w4, w4), _side(w4, w4), _Block(w4)
        self.up2, self.side2, self.join2 = _lift(w4, w2), _side(w2, w2), _conv(w2, w2)
        self.mask = nn.Conv2d(w2, len(CATEGORIES), 1)
        self.embedding = nn.ModuleList(nn.Sequential(_conv(w4, w4), nn.Conv2d(w4, EMBEDDING, 1)) for _ in CATEGORIES)
        self.view = nn.ModuleList(_View(w16, w4) for _ in CATEGORIES)
        self.category = nn.Linear(w16, len(CATEGORIES) + 1)

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """mask (N, 2, H/2, W/2) logits; fine (N, 64, H/4, W/4) for `embed`; coarse for `look`; category (N, 3)."""
        fine2, fine4, at16 = self._levels(x)
        pooled = nn.functional.avg_pool2d(fine4, 4)
        return {
            "mask": self.mask(fine2),
            "fine": fine4,
            "coarse": torch.cat([at16, pooled], 1),
            "category": self.category(at16.mean((2, 3))),
        }

    def features(self, x: Tensor) -> Tensor:
        """(N, 32, H/2, W/2) finest features alone."""
        return self._levels(x)[0]

    def _levels(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features at a half and a quarter of the size on the way up, and at a sixteenth."""
        at2 = self.stem(nn.functional.pixel_unshuffle(x, 2))
        at4 = self.at4(self.down4(at2))
        at8 = self.at8(self.down8(at4))
        at16 = self.at16(self.down16(at8))
        fine8 = self.join8(self.up8(at16) + self.side8(at8))
        fine4 = self.join4(self.up4(fine8) + self.side4(at4))
        return self.join2(self.up2(fine4) + self.side2(at2)), fine4, at16

    def embed(self, fine: Tensor, category_idx: int) -> Tensor:
        """(N, 16, H/4, W/4) embedding of a category, unit length."""
        return nn.functional.normalize(self.embedding[category_idx](fine).float(), dim=1)

    def look(self, coarse: Tensor, category_idx: int) -> Tensor:
        """(N, 36 + 12 + 12) logits over azimuth, elevation and roll of a category; input of 96 x 96 only."""
        return self.view[category_idx](coarse)


def _lift(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs), nn.Upsample(scale_factor=2, mode="nearest")
    )


def _side(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs))
