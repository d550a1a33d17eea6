"""Deformation without bones: every point moves by what a network says. For comparison with skinning (Table 3).

``se3`` is in the manner of Nerfies (Park et al. 2021): a rotation and a translation at each point. ``translation`` is
in the manner of NSFF and D-NeRF (Li et al., Pumarola et al. 2021): a displacement. Each direction has its own
network, held together by the 3D cycle alone.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stages.geometry.rotations import so3_exp
from stages.model.fields import positional_encoding


class DenseWarp(nn.Module):
    """One direction: ``x' = R(x, omega) x + t(x, omega)``, or ``x + t`` alone; still at the start."""

    bands = 4

    def __init__(self, code_channels: int, turns: bool, generator: torch.Generator, width: int = 128) -> None:
        super().__init__()
        self.turns = turns
        self.point_layer = nn.Linear(3 * (1 + 2 * self.bands), width)
        self.code_layer = nn.Linear(code_channels, width, bias=False)
        self.hidden1 = nn.Linear(width, width)
        self.hidden2 = nn.Linear(width, width)
        self.out = nn.Linear(width, 6 if turns else 3)
        with torch.no_grad():
            for layer in (self.point_layer, self.code_layer, self.hidden1, self.hidden2):
                layer.weight.normal_(0, (2 / (layer.in_features + width)) ** 0.5, generator=generator)
            self.out.weight.normal_(0, 1e-3, generator=generator)
            self.out.bias.zero_()

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        """Moved points (F, N, 3) of points (F, N, 3) under pose codes (F, C)."""
        encoded = positional_encoding(points.reshape(-1, 3), self.bands).reshape(*points.shape[:2], -1)
        hidden = torch.relu(self.point_layer(encoded) + self.code_layer(code)[:, None])
        hidden = torch.relu(self.hidden1(hidden))
        hidden = torch.relu(self.hidden2(hidden))
        out = self.out(hidden)
        if not self.turns:
            return points + out
        return (so3_exp(out[..., :3]) @ points[..., None])[..., 0] + out[..., 3:]
