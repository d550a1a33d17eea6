"""A solid with a closed form, seen by known cameras: what fitting is tested on. No animation, no noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.fitting.observations import ObservationBuilder, Observations
from stages.fitting.schedule import PhaseSettings
from stages.geometry.cameras import pixel_directions, project, transform
from stages.geometry.rotations import rigid, so3_exp
from stages.model.banmo import Architecture, Banmo, VideoFacts
from stages.model.fields import GridField
from stages.model.motion import MotionHead
from stages.model.skeleton import Bones

SIZES = ((48, 40), (40, 52))
"""Width and height of the two videos, pixels."""
FOCAL = 44.0
FEATURE_CELLS = 24

Hit = Callable[[Tensor, Tensor], Tensor]
"""Depth (N,) along rays from origins (N, 3) in directions (N, 3); inf where they miss."""


def ellipsoid(radii: Tensor, centre: Tensor | None = None) -> Hit:
    """First crossing of the surface |(x - centre) / radii| = 1."""
    middle = torch.zeros(3) if centre is None else centre

    def hit(origins: Tensor, directions: Tensor) -> Tensor:
        o, d = (origins - middle) / radii, directions / radii
        a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
        under = b * b - a * c
        return torch.where(under > 0, (-b - under.clamp_min(0).sqrt()) / a, torch.full_like(a, torch.inf))

    return hit


def sphere(radius: float, centre: Tensor | None = None) -> Hit:
    """A ball."""
    return ellipsoid(torch.full((3,), radius), centre)


def box(half: Tensor) -> Hit:
    """An axis-aligned box about the origin, by clipping the ray against one pair of faces after the other."""

    def hit(origins: Tensor, directions: Tensor) -> Tensor:
        near, far = torch.full(origins.shape[:1], -torch.inf), torch.full(origins.shape[:1], torch.inf)
        for k in range(3):
            crossings = torch.stack([(s * half[k] - origins[:, k]) / directions[:, k] for s in (-1, 1)])
            near, far = torch.maximum(near, crossings.amin(0)), torch.minimum(far, crossings.amax(0))
        return torch.where(near < far, near, torch.full_like(near, torch.inf))

    return hit


def intrinsics_of(size: tuple[int, int]) -> Tensor:
    """K of a camera whose principal point is a little off the middle."""
    return torch.tensor([[FOCAL, 0, size[0] / 2 + 1], [0, FOCAL, size[1] / 2 - 1], [0, 0, 1]])


def orbit(count: int, start: float, depth: float = 3.0, lift: float = 0.9) -> Tensor:
    """(count, 4, 4) camera_from_object of a camera that goes round and up and down."""
    share = torch.arange(count) / count
    zero = torch.zeros(count)
    turn = so3_exp(torch.stack([zero, start + 2 * math.pi * share, zero], 1))
    tilt = so3_exp(torch.stack([lift * torch.sin(2 * math.pi * share * 2 + start), zero, zero], 1))
    upright = torch.diag(torch.tensor([1.0, -1, -1]))
    return rigid(tilt @ upright @ turn, torch.tensor([0.05, -0.03, depth]).expand(count, 3))


def paint(points: Tensor) -> Tensor:
    """Colour (..., 3) in 0..1 of surface points (..., 3)."""
    return torch.sigmoid(2 * points)


def describe_point(points: Tensor) -> Tensor:
    """A unit 16-vector (..., 16) that tells surface points (..., 3) apart."""
    phase = points @ torch.randn(3, 8, generator=torch.Generator().manual_seed(0)) * 1.5
    return torch.nn.functional.normalize(torch.cat([phase.sin(), phase.cos()], -1), dim=-1)


def look(hit: Hit, pose: Tensor, k: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Whether pixels (N, 2) see the object, and the object-space points (N, 3) that they see."""
    directions = pixel_directions(k, pixels) @ pose[:3, :3]
    origins = (-pose[:3, :3].T @ pose[:3, 3]).expand(len(pixels), 3)
    depth = hit(origins, directions)
    seen = torch.isfinite(depth)
    return seen, origins + torch.where(seen, depth, torch.zeros(()))[:, None] * directions


def pixel_centres(width: int, height: int) -> Tensor:
    """(height * width, 2), row by row."""
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([columns, rows], -1).reshape(-1, 2)


@dataclass
class Scene:
    """What was seen and where from; F frames of both videos in order."""

    hit: Hit
    observations: Observations
    poses: Tensor  # (F, 4, 4)
    intrinsics: Tensor  # (F, 3, 3)
    videos: list[VideoFacts]
    images: list[np.ndarray]
    masks: list[np.ndarray]


def scene(hit: Hit, frames: int = 5, steps: tuple[int, ...] = (1, -1), weight: float = 1.0) -> Scene:
    """Two videos of `frames` frames each, with true masks, colours, flow and features."""
    builder = ObservationBuilder(steps)
    poses = torch.cat([orbit(frames, 0.3), orbit(frames, 1.2)])
    videos, images, masks, maps, crops = [], [], [], [], []
    for v, (width, height) in enumerate(SIZES):
        k = intrinsics_of((width, height))
        videos.append(
            VideoFacts(
                name=f"clip{v}",
                time_s=tuple(0.1 * i + v for i in range(frames)),
                width=width,
                height=height,
                focal_px=(FOCAL, FOCAL),
                principal_px=(float(k[0, 2]), float(k[1, 2])),
            )
        )
        pixels = pixel_centres(width, height)
        for f in range(frames):
            pose = poses[v * frames + f]
            seen, points = look(hit, pose, k, pixels)
            flows = {}
            for step in steps:
                if 0 <= f + step < frames:
                    ahead = project(k, transform(poses[v * frames + f + step], points)) - pixels
                    confidence = seen.float().reshape(height, width).numpy()
                    flows[step] = (ahead.reshape(height, width, 2).numpy(), confidence)
            colour = torch.where(seen[:, None], paint(points), torch.tensor(0.5))
            images.append((colour * 255).round().byte().reshape(height, width, 3).numpy())
            masks.append((seen.byte() * 255).reshape(height, width).numpy())
            builder.add(v, images[-1], masks[-1], flows, weight)
            crop = torch.tensor([4.0, 2, 40, 38])
            unit = (pixel_centres(FEATURE_CELLS, FEATURE_CELLS)) / FEATURE_CELLS
            on, where = look(hit, pose, k, crop[:2] + unit * (crop[2:] - crop[:2]))
            maps.append((describe_point(where) * on[:, None]).reshape(FEATURE_CELLS, FEATURE_CELLS, 16).numpy())
            crops.append(crop.numpy())
    observations = builder.finish(np.stack(maps).astype(np.float16), np.stack(crops))
    k = torch.stack([intrinsics_of(size) for size in SIZES]).repeat_interleave(frames, 0)
    return Scene(hit, observations, poses, k, videos, images, masks)


TINY = Architecture(voxel=0.08, pose_code=8, pose_width=16, root_code=8, root_width=16, env_code=4, octaves=2)

BONE_CENTRES = torch.tensor([[0.0, 0, 0], [0.35, 0, 0], [-0.35, 0.05, 0]])


def tiny_settings(**changes: float) -> PhaseSettings:
    """Steps small enough for tests, every term switched on."""
    base = {
        "frames_per_step": 4, "pixels_per_frame": 24, "probe_samples": 16, "fine_samples": 8, "match_pixels": 24,
        "match_every": 1, "lr_root": 1e-3, "lr_focal": 1e-3, "weight_match": 0.1, "weight_cycle_2d": 0.02,
        "feature_pull": 1.0, "update_bounds_every": 3, "warmup_steps": 2,
    }  # fmt: skip
    return PhaseSettings(**{**base, **changes})


def model_of(
    seen: Scene,
    sdf: Callable[[Tensor], Tensor],
    architecture: Architecture = TINY,
    half: float = 0.9,
    centres: Tensor = BONE_CENTRES,
) -> Banmo:
    """A model of `seen` that has a known signed distance, at rest, painted like the scene."""
    bounds = torch.tensor([[-half] * 3, [half] * 3])
    parents = torch.zeros(len(centres), dtype=torch.int64)
    bones = Bones(centres, torch.full((len(centres), 3), math.log(0.2)), parents)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = Banmo(architecture, seen.videos, seen.poses, bounds, bones, torch.Generator().manual_seed(0))
    if isinstance(model.field, GridField):
        nodes = model.field.node_positions()
        model.field.set_sdf(sdf(nodes))
        with torch.no_grad():
            model.field.colour_grids[0].copy_((2 * nodes).movedim(-1, 0)[None])
            model.field.embedding_grid.normal_(generator=torch.Generator().manual_seed(1))
    for head in (model.body.head, model.root.head):
        still(head)
    return model


def still(head: MotionHead) -> None:
    """Make a head answer "no motion" whatever the code is."""
    with torch.no_grad():
        head.out.weight.zero_()
        head.out.bias.zero_()


def stir(model: Banmo, size: float, seed: int = 0) -> None:
    """Give bones and root a motion that differs from frame to frame, about `size` radians."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for head in (model.body.head, model.root.head):
            noise = torch.randn(head.out.weight.shape, generator=generator)
            noise.reshape(head.count, 6, -1)[:, 3:] *= 0.2
            head.out.weight.copy_(noise * size / math.sqrt(noise.shape[1]))
