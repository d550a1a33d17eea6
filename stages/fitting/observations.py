"""What was seen, packed for sampling: pixels near the object of every kept frame, one row a pixel.

Only pixels within a margin of the mask are kept: the rest of the picture says nothing that its silhouette rows do
not. Rows of frame f are ``offsets[f] : offsets[f + 1]``, those near the mask's edge first. T frames, M rows. Flow of
step s leads s kept frames ahead (behind if negative) in the same clip.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

BESIDE_UNITS = 4
"""Distances beside a silhouette are kept in quarters of its pixels, up to 63 of them."""
FREE_PX = 3.0
"""As far beside the mask the surface may stick out: rays are drawn there, too."""


@dataclass
class Observations:
    """Packed rows of a collection; see the module's docstring."""

    video_idx: Tensor  # (T,) int64
    frame_weight: Tensor  # (T,) float32 in 0..1: how far the mask is trusted; 0 = unusable
    offsets: Tensor  # (T + 1,) int64
    edge_count: Tensor  # (T,) int64: how many of a frame's first rows lie near the mask's edge
    xy: Tensor  # (M, 2) int16: column, row
    rgb: Tensor  # (M, 3) uint8
    mask: Tensor  # (M,) uint8, 255 = object
    silhouettes: Tensor  # (T, h, w) uint8: all masks at a common small size (padding = 0)
    silhouette_scale: Tensor  # (T,) float32: silhouette pixels a frame pixel
    image_size: Tensor  # (T, 2) float32: width, height in pixels
    flow: dict[int, Tensor] = field(default_factory=dict)  # step -> (M, 2) float16, pixels
    flow_confidence: dict[int, Tensor] = field(default_factory=dict)  # step -> (M,) uint8
    partner: dict[int, Tensor] = field(default_factory=dict)  # step -> (T,) int64, -1 = none
    features: np.ndarray | None = None  # (T, 112, 112, 16) float16, may be memory-mapped
    crops: Tensor | None = None  # (T, 4): x0, y0, x1, y1 of the feature maps, pixels
    beside: Tensor | None = None  # (T, h, w) uint8: beyond FREE_PX from the mask, 1 / BESIDE_UNITS of a silhouette's

    def __len__(self) -> int:
        return len(self.video_idx)


class ObservationBuilder:
    """Packs frames one by one, in order; `small_px` bounds the side of the kept silhouettes."""

    def __init__(self, steps: tuple[int, ...], margin_share: float = 0.035, small_px: int = 128) -> None:
        self.steps, self.margin_share, self.small_px = steps, margin_share, small_px
        self._rows: dict[str, list[np.ndarray]] = {}
        self._frames: dict[str, list[np.ndarray]] = {}

    def _push(self, table: dict[str, list[np.ndarray]], **columns: Any) -> None:
        for name, value in columns.items():
            table.setdefault(name, []).append(value)

    def add(
        self,
        video_idx: int,
        image: np.ndarray,
        mask: np.ndarray,
        flows: dict[int, tuple[np.ndarray, np.ndarray]],
        weight: float,
    ) -> None:
        """Add one frame: image (H, W, 3) uint8, mask (H, W) uint8, flow and confidence by step."""
        from skimage.transform import resize

        height, width = mask.shape
        inside = mask > 127
        margin = max(4.0, self.margin_share * max(height, width))
        beyond = distance_transform_edt(~inside) if inside.any() else np.full(inside.shape, np.inf)
        rows, columns = np.nonzero(beyond <= margin)
        depth = np.where(inside, distance_transform_edt(inside), beyond)[rows, columns]
        order = np.argsort(depth > margin / 2, kind="stable")
        rows, columns, edge = rows[order], columns[order], int((depth <= margin / 2).sum())
        scale = min(1.0, self.small_px / max(height, width))
        size = (max(1, round(height * scale)), max(1, round(width * scale)))
        small = resize(mask.astype(np.float32), size, order=1, anti_aliasing=scale < 1, preserve_range=True)
        canvas = np.zeros((self.small_px, self.small_px), np.uint8)
        canvas[: size[0], : size[1]] = np.clip(np.round(small), 0, 255)
        beside = np.zeros_like(canvas)
        if inside.any():
            away = resize(np.maximum(beyond - FREE_PX, 0.0), size, order=1, anti_aliasing=scale < 1)
            beside[: size[0], : size[1]] = np.round(np.minimum(BESIDE_UNITS * scale * away, 255))
        self._push(
            self._rows,
            xy=np.stack([columns, rows], 1).astype(np.int16),
            rgb=image[rows, columns],
            mask=mask[rows, columns],
        )
        for step in self.steps:
            flow, confidence = flows.get(step, (None, None))
            count = len(rows)
            self._push(
                self._rows,
                **{
                    f"flow{step}": np.zeros((count, 2), np.float16)
                    if flow is None
                    else flow[rows, columns].astype(np.float16),
                    f"confidence{step}": np.zeros(count, np.uint8)
                    if confidence is None
                    else np.round(confidence[rows, columns] * 255).astype(np.uint8),
                },
            )
        self._push(
            self._frames,
            video=np.int64(video_idx),
            weight=np.float32(weight if inside.any() else 0.0),
            small=canvas,
            beside=beside,
            scale=np.float32(size[1] / width),
            size=np.array([width, height], np.float32),
            count=np.int64(len(rows)),
            edge=np.int64(edge),
        )

    def finish(self, features: np.ndarray | None = None, crops: np.ndarray | None = None) -> Observations:
        """The packed collection; `features` (T, 112, 112, 16) with their `crops` (T, 4) if there are any."""
        rows = {name: torch.from_numpy(np.concatenate(parts)) for name, parts in self._rows.items()}
        video = torch.tensor(np.array(self._frames["video"]))
        frame = torch.arange(len(video))
        partner = {}
        for step in self.steps:
            other = frame + step
            valid = (other >= 0) & (other < len(frame))
            valid &= video[other.clamp(0, len(frame) - 1)] == video
            partner[step] = torch.where(valid, other, torch.full_like(other, -1))
        counts = torch.tensor(np.array(self._frames["count"]))
        return Observations(
            video_idx=video,
            frame_weight=torch.tensor(np.array(self._frames["weight"])),
            offsets=torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)]),
            edge_count=torch.tensor(np.array(self._frames["edge"])),
            xy=rows["xy"],
            rgb=rows["rgb"],
            mask=rows["mask"],
            silhouettes=torch.from_numpy(np.stack(self._frames["small"])),
            silhouette_scale=torch.tensor(np.array(self._frames["scale"])),
            image_size=torch.from_numpy(np.stack(self._frames["size"])),
            flow={step: rows[f"flow{step}"] for step in self.steps},
            flow_confidence={step: rows[f"confidence{step}"] for step in self.steps},
            partner=partner,
            features=features,
            crops=None if crops is None else torch.from_numpy(np.asarray(crops, np.float32)),
            beside=torch.from_numpy(np.stack(self._frames["beside"])),
        )
