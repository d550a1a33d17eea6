"""Which pixels of which frames make up a step: seeded by (seed, step, rank), so that resuming needs no state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.fitting.observations import Observations


class Batch(NamedTuple):
    """P pixels of each of F frames."""

    frame_idx: Tensor  # (F,) int64
    partner_idx: Tensor  # (F,) int64; the frame itself where there is no partner
    pixels: Tensor  # (F, P, 2) float32: pixel centres
    rgb: Tensor  # (F, P, 3) in 0..1
    mask: Tensor  # (F, P) in 0..1
    weight: Tensor  # (F, 1) trust in the frame
    flow: Tensor  # (F, P, 2) pixels, to the partner frame
    flow_confidence: Tensor  # (F, P) in 0..1; zero where there is none
    features: Tensor | None  # (F, P, 16) unit length, or zero off the object
    beside: Tensor | None  # (F, h, w) uint8: how far a cell of a small picture is from the mask (see Observations)
    beside_scale: Tensor  # (F, 1): cells of that picture a pixel of the frame

    def to(self, device: torch.device) -> Batch:
        """The same batch on another device."""
        return Batch._make(None if x is None else x.to(device, non_blocking=True) for x in self)

    def of(self, part: slice) -> Batch:
        """Some frames of the batch."""
        return Batch._make(None if x is None else x[part] for x in self)

    def pixels_of(self, columns: Tensor) -> Batch:
        """Some pixels (F, Q) of each frame."""
        wide = columns[..., None]
        return self._replace(
            pixels=self.pixels.gather(1, wide.expand(-1, -1, 2)),
            rgb=self.rgb.gather(1, wide.expand(-1, -1, 3)),
            mask=self.mask.gather(1, columns),
            flow=self.flow.gather(1, wide.expand(-1, -1, 2)),
            flow_confidence=self.flow_confidence.gather(1, columns),
            features=None if self.features is None else self.features.gather(1, wide.expand(-1, -1, 16)),
        )


class Draws:
    """The random numbers of a step for `part` of a batch of `frames` frames.

    They are drawn for the whole batch and then cut, so that a frame gets the same ones whoever renders it.
    """

    def __init__(self, generator: torch.Generator, frames: int, part: slice, device: torch.device) -> None:
        self.generator, self.frames, self.part, self.device = generator, frames, part, device

    def uniform(self, *shape: int) -> Tensor:
        """Numbers in 0..1 of `shape` for each frame of the part."""
        return torch.rand(self.frames, *shape, generator=self.generator)[self.part].to(self.device)

    def below(self, high: int, *shape: int) -> Tensor:
        """Integers in 0..high - 1 of `shape` for each frame of the part."""
        return torch.randint(high, (self.frames, *shape), generator=self.generator)[self.part].to(self.device)


def step_generator(seed: int, step: int, rank: int = 0) -> torch.Generator:
    """The source of every random draw of one step."""
    mixed = np.random.SeedSequence([seed, step, rank]).generate_state(2, np.uint32)
    return torch.Generator().manual_seed(int(mixed[0]) << 31 ^ int(mixed[1]))


def draw(
    observations: Observations, frames: int, pixels: int, generator: torch.Generator, edge_share: float = 0.0
) -> Batch:
    """Draw a batch: frames in proportion to their weight, pixels evenly near the object.

    Of a frame's pixels the first `edge_share` are drawn near the mask's edge alone, where limbs and outlines are.
    """
    chosen = torch.multinomial(observations.frame_weight, frames, replacement=True, generator=generator)
    return look(observations, chosen, pixels, generator, edge_share)


def look(
    observations: Observations, chosen: Tensor, pixels: int, generator: torch.Generator, edge_share: float = 0.0
) -> Batch:
    """`pixels` of each of the frames `chosen` (F,), drawn as :func:`draw` does."""
    frames = len(chosen)
    start, count = observations.offsets[chosen], observations.offsets[chosen + 1] - observations.offsets[chosen]
    unit = torch.rand(frames, pixels, generator=generator)
    count = count[:, None].repeat(1, pixels)
    edge = observations.edge_count[chosen][:, None]
    count[:, : round(edge_share * pixels)] = torch.where(edge > 0, edge, count[:, :1])
    rows = start[:, None] + (unit * count).long().minimum(count - 1)

    flow = torch.zeros(frames, pixels, 2)
    confidence = torch.zeros(frames, pixels)
    partner = chosen.clone()
    if observations.flow:
        steps = list(observations.flow)
        pick = torch.randint(len(steps), (frames,), generator=generator)
        for i, step in enumerate(steps):
            using = (pick == i) & (observations.partner[step][chosen] >= 0)
            if using.any():
                flow[using] = observations.flow[step][rows[using]].float()
                confidence[using] = observations.flow_confidence[step][rows[using]].float() / 255
                partner[using] = observations.partner[step][chosen[using]]

    xy = observations.xy[rows].float() + 0.5
    return Batch(
        frame_idx=chosen,
        partner_idx=partner,
        pixels=xy,
        rgb=observations.rgb[rows].float() / 255,
        mask=observations.mask[rows].float() / 255,
        weight=observations.frame_weight[chosen][:, None],
        flow=flow,
        flow_confidence=confidence,
        features=_features(observations, chosen, xy),
        beside=None if observations.beside is None else observations.beside[chosen],
        beside_scale=observations.silhouette_scale[chosen][:, None],
    )


def _features(observations: Observations, frame_idx: Tensor, pixels: Tensor) -> Tensor | None:
    """Nearest feature cell of each pixel, (F, P, 16) of unit length or zero."""
    if observations.features is None or observations.crops is None:
        return None
    crop = observations.crops[frame_idx][:, None]
    side = (crop[..., 2:] - crop[..., :2]).clamp_min(1e-6)
    size = observations.features.shape[1]
    cell = ((pixels - crop[..., :2]) / side * size).floor()
    inside = ((cell >= 0) & (cell < size)).all(-1)
    cell = cell.clamp(0, size - 1).long().numpy()
    values = observations.features[frame_idx.numpy()[:, None], cell[..., 1], cell[..., 0]]
    features = torch.from_numpy(np.ascontiguousarray(values)).float() * inside[..., None]
    return torch.nn.functional.normalize(features, dim=-1, eps=1e-3)
