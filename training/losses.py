"""What the network is trained for: masks, places on the canonical surface, views, categories."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from training.dressing import Batch
from training.network import (
    AZIMUTH_DEG,
    AZIMUTHS,
    ELEVATION_DEG,
    ELEVATIONS,
    EMBEDDING,
    IMAGENET_MEAN,
    IMAGENET_STD,
    ROLL_DEG,
)
from training.wardrobe import Random

AZIMUTH_SPREAD_DEG, ANGLE_SPREAD_DEG = 7.0, 6.0
NEAR = 0.09
"""Distance on the canonical surface (object units) over which a label is smeared."""


class Surface(nn.Module):
    """The canonical surface's embedding: unit vectors, a learnt mixture of its Laplace-Beltrami eigenfunctions."""

    basis: Tensor
    target: Tensor

    def __init__(self, vertices: np.ndarray, basis: np.ndarray, seed: int) -> None:
        super().__init__()
        self.register_buffer("basis", torch.from_numpy(basis).float())
        distance = torch.cdist(torch.from_numpy(vertices).float(), torch.from_numpy(vertices).float())
        # Points near in space may be far along the surface: the slow eigenfunctions tell them apart.
        slow = torch.from_numpy(basis[:, :12]).float()
        distance = distance + 0.25 * (torch.cdist(slow, slow) - 0.6).clamp_min(0)
        self.register_buffer("target", functional.softmax(-(distance**2) / (2 * NEAR**2), dim=1))
        generator = torch.Generator().manual_seed(seed)
        fall = 1.0 / (1.0 + torch.arange(basis.shape[1]) / 8.0)
        self.mixture = nn.Parameter(torch.randn(basis.shape[1], EMBEDDING, generator=generator) * fall[:, None])
        self.sharpness = nn.Parameter(torch.tensor(2.5))

    def embedding(self) -> Tensor:
        """(V, 16) unit vectors."""
        return functional.normalize(self.basis @ self.mixture, dim=1)

    def loss(self, embedded: Tensor, label: Tensor, draw: Random, pixels: int = 1500) -> Tensor:
        """Cross-entropy of pixels' embeddings (B, 16, L, L) against their smeared vertices; label -1 is left out."""
        at = (label >= 0).flatten().nonzero()[:, 0]
        if len(at) == 0:
            return embedded.sum() * 0
        at = at[draw.below(len(at), min(pixels, len(at))).to(at.device)]
        chosen = embedded.permute(0, 2, 3, 1).reshape(-1, EMBEDDING)[at]
        logits = self.sharpness.exp() * (chosen @ self.embedding().T)
        return functional.cross_entropy(logits, self.target[label.flatten()[at]])


def view_targets(view: Tensor) -> Tensor:
    """(B, 36 + 12 + 12) soft bins of azimuth, elevation and roll (B, 3) in radians; each block sums to 1."""
    degrees = torch.rad2deg(view)
    around = (degrees[:, :1] - degrees.new_tensor(AZIMUTH_DEG) + 180) % 360 - 180
    blocks = [functional.softmax(-(around**2) / (2 * AZIMUTH_SPREAD_DEG**2), dim=1)]
    for k, centres in ((1, ELEVATION_DEG), (2, ROLL_DEG)):
        off = degrees[:, k : k + 1].clamp(centres[0], centres[-1]) - degrees.new_tensor(centres)
        blocks.append(functional.softmax(-(off**2) / (2 * ANGLE_SPREAD_DEG**2), dim=1))
    return torch.cat(blocks, 1)


def view_blocks(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Azimuth, elevation and roll of (B, 60) logits or probabilities."""
    return (
        values[:, :AZIMUTHS],
        values[:, AZIMUTHS : AZIMUTHS + ELEVATIONS],
        values[:, AZIMUTHS + ELEVATIONS :],
    )


def view_loss(logits: Tensor, view: Tensor, present: Tensor) -> Tensor:
    """Cross-entropy over the three angles, azimuth counting most; pictures without the object are left out."""
    if not present.any():
        return logits.sum() * 0
    total = logits.new_zeros(())
    targets = view_targets(view[present])
    for weight, logit, target in zip(
        (1.0, 0.35, 0.25), view_blocks(logits[present].float()), view_blocks(targets), strict=True
    ):
        total = total + weight * functional.cross_entropy(logit, target)
    return total


def mask_loss(logits: Tensor, mask: Tensor) -> Tensor:
    """Cross-entropy and overlap (Dice) of (B, h, w) logits against coverage (B, 1, S, S)."""
    target = functional.interpolate(mask, logits.shape[1:], mode="area")[:, 0]
    logits = logits.float()
    crossed = functional.binary_cross_entropy_with_logits(logits, target)
    probability = logits.sigmoid()
    shared = (probability * target).sum((1, 2)) * 2 + 8
    return crossed + 0.5 * (1 - shared / (probability.sum((1, 2)) + target.sum((1, 2)) + 8)).mean()


def network_input(batch: Batch, draw: Random, prompted: Tensor) -> Tensor:
    """(B, 4, S, S): the normalised picture, and for `prompted` (B,) pictures an imperfect mask, the rest taken off.

    A picture with nothing to show a mask of is not prompted.
    """
    mean = torch.tensor(IMAGENET_MEAN)[None, :, None, None]
    std = torch.tensor(IMAGENET_STD)[None, :, None, None]
    image = (batch.image - mean) / std
    mask = imperfect(batch.shown, draw)
    given = prompted[:, None, None, None] & (batch.shown.amax((1, 2, 3), keepdim=True) > 0)
    return torch.cat([torch.where(given, image * mask, image), mask * given], 1)


def imperfect(mask: Tensor, draw: Random) -> Tensor:
    """A mask (B, 1, S, S) as segmentation gives it: outline off by a few pixels, pieces missing, stray pieces."""
    count, side = len(mask), mask.shape[-1]
    soft = functional.avg_pool2d(functional.pad(mask, (3, 3, 3, 3)), 7, 1)
    wobble = functional.interpolate(draw.normal(count, 1, 12, 12), (side, side), mode="bilinear", align_corners=False)
    amount = draw.uniform(count, 1, 1, 1, high=0.35)
    level = 0.5 + 0.15 * draw.normal(count, 1, 1, 1).clamp(-2, 2)
    rough = (soft + amount * wobble > level).float()
    broad = functional.interpolate(draw.normal(count, 1, 5, 5), (side, side), mode="bicubic", align_corners=False)
    lost = (broad > 1.3) & draw.chance(count, 0.2)[:, None, None, None]
    stray = (broad < -1.5) & draw.chance(count, 0.15)[:, None, None, None]
    rough = torch.where(lost, 0.0, torch.where(stray, 1.0, rough))
    return torch.where(draw.chance(count, 0.4)[:, None, None, None], mask, rough)
