"""Two clips of a body that moves, and frames of which only masks are known."""

from __future__ import annotations

import torch

from stages.fitting.observations import Observations
from stages.fitting.surface import surface_points
from stages.model.banmo import Banmo, VideoFacts
from tests.numerics.analytic_scene import Scene, model_of, orbit, stir

FRAMES = 40
RADII = torch.tensor([0.3, 0.2, 0.6])


def solid(points: torch.Tensor) -> torch.Tensor:
    return ((points / RADII).norm(dim=-1) - 1) * float(RADII.min())


def moving(seen: Scene, frames_a_second: float) -> Banmo:
    found = model_of(seen, solid)
    times = tuple(i / frames_a_second for i in range(FRAMES))
    videos = [VideoFacts(f"clip{v}", times, 48, 40, (44.0, 44.0), (24.0, 20.0)) for v in range(2)]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        generator = torch.Generator().manual_seed(0)
        long = Banmo(found.architecture, videos, orbit(2 * FRAMES, 0.0), found.bounds, found.bones, generator)
    long.field.load_state_dict(found.field.state_dict())
    stir(long, 1.5)
    long.surface = surface_points(long, 48)
    return long


def observations(count: int) -> Observations:
    """Only what says which frames may be used."""
    empty = torch.zeros(0)
    return Observations(
        torch.arange(count) // FRAMES, torch.ones(count), empty, empty, empty, empty, empty,
        torch.full((count, 32, 32), 255, dtype=torch.uint8), torch.full((count,), 32 / 48), torch.tensor([48.0, 40.0]),
    )  # fmt: skip


def codes(model: Banmo) -> torch.Tensor:
    return model.body.code(model.video_idx, model.time).detach()
