"""Two clips of a body that moves, and frames of which only masks are known."""

from __future__ import annotations

from typing import Any

import torch

from stages.fitting.observations import Observations
from stages.fitting.surface import surface_points
from stages.fitting.trainer import Trainer
from stages.model.banmo import Banmo, VideoFacts
from tests.numerics.analytic_scene import Scene, model_of, orbit, stir, tiny_settings

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


def resumes_exactly(seen: Scene, looks_back: str, **settings: Any) -> Trainer:
    """A phase of six steps that looks back after the third, resumed before and after it; returns it when it is done."""

    def start() -> Trainer:
        model = model_of(seen, solid)
        stir(model, 1.0)
        return Trainer(model, seen.observations, tiny_settings(iterations=6, rethink_share=0.7, **settings))

    one, states = start(), []
    while not one.done:
        assert (getattr(one, looks_back) is not None) == (one.step_idx > 3)
        states.append(one.state())
        one.step()
    for at in (3, 4):
        two = start()
        two.restore(states[at])
        while not two.done:
            two.step()
        for name, value in two.state().items():
            assert torch.equal(value, one.state()[name]), name
    return one
