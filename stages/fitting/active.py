"""Active sampling: a small network learns where in (x, y, t) the picture is still explained badly (supplement, B)."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from stages.fitting.batches import Batch
from stages.model.banmo import Banmo
from stages.model.fields import positional_encoding
from stages.model.motion import FourierCode


class Uncertainty(nn.Module):
    """U(x, y, t) of each video: the error expected at a pixel. Two hidden layers instead of the paper's eight."""

    bands, channels = 5, 16

    def __init__(self, videos: int, octaves: int, generator: torch.Generator, width: int = 64) -> None:
        super().__init__()
        self.code = FourierCode(videos, self.channels, octaves, generator)
        encoded = 2 * (1 + 2 * self.bands)
        sizes = (encoded + self.channels, width, width, 1)
        layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        self.layers = nn.ModuleList(layers)
        with torch.no_grad():
            for layer in layers:
                layer.weight.normal_(0, (2 / layer.in_features) ** 0.5, generator=generator)
                layer.bias.zero_()
            layers[-1].weight.mul_(0.1)

    def forward(self, video_idx: Tensor, time: Tensor, unit_xy: Tensor) -> Tensor:
        """Expected error (F, P) at `unit_xy` (F, P, 2) in 0..1 of frames at `time` (F,) of videos (F,)."""
        code = self.code(video_idx, time)[:, None].expand(-1, unit_xy.shape[1], -1)
        encoded = positional_encoding((2 * unit_xy - 1).reshape(-1, 2), self.bands).reshape(*unit_xy.shape[:2], -1)
        hidden = torch.cat([encoded, code], -1)
        for layer in self.layers[:-1]:
            hidden = torch.relu(layer(hidden))
        return self.layers[-1](hidden)[..., 0]

    def of(self, model: Banmo, batch: Batch) -> Tensor:
        """Expected error (F, P) at the pixels of a batch."""
        video = model.video_idx[batch.frame_idx.to(model.video_idx.device)]
        size = torch.tensor([(v.width, v.height) for v in model.videos], device=video.device)[video]
        time = model.time[batch.frame_idx.to(video.device)]
        return self(video, time, batch.pixels / size[:, None])


def most_uncertain(expected: Tensor, count: int) -> Tensor:
    """Columns (F, count) of the highest `expected` errors (F, N)."""
    return expected.topk(count, dim=1).indices
