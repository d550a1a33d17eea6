"""The first model: hull, limbs, bones and motion, before any rendering (see hull.py, limbs.py, prefit.py)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from torch import Tensor

from stages.fitting import growth, initialise, limbs, prefit
from stages.fitting.observations import Observations
from stages.fitting.schedule import PhaseSettings
from stages.model.banmo import Architecture, Banmo, VideoFacts

Watch = Callable[[range], Iterator[int]]


@dataclass(frozen=True)
class Beginning:
    """What the first model is made of."""

    bones: int = 25
    hull_voxel: float = 0.04
    limb_rounds: int = 2
    motion_iterations: int = 150
    margin: float = 0.15


def first_model(
    observations: Observations,
    poses: Tensor,
    intrinsics: Tensor,
    videos: list[VideoFacts],
    architecture: Architecture,
    beginning: Beginning,
    settings: PhaseSettings,
    root_free: Tensor,
    watch: Watch,
    log: logging.Logger,
) -> Banmo:
    """A model whose shape is the soft visual hull with limbs, and whose motion covers the masks.

    Poses (T, 4, 4) and intrinsics (T, 3, 3) at kept frames, in canonical units; `root_free` (V,).
    """
    body = initialise.rigid_hull(observations, poses, intrinsics, beginning.hull_voxel)
    voting = body.share
    log.info("hull: vote level %.2f, %d voxels", body.level, int(body.solid.sum()))
    model = _build(architecture, videos, poses, body, beginning, settings.seed, root_free)
    frames = initialise.usable_frames(observations, 400)
    taken: set[int] = set()
    for r in range(beginning.limb_rounds + 1):
        points = growth.shell(body.solid, body.nodes)
        last = r == beginning.limb_rounds
        # At first only what lies close pulls: a torso must not stretch to cover an arm that it does not have yet.
        reach = 0.15 if last else (0.02 if r == 0 else 0.08)
        count = beginning.motion_iterations * (2 if last else 1)
        prefit.fit_motion(model, observations, points, settings, count, settings.seed + r, reach, watch)
        if last:
            break
        found = limbs.unexplained(model, observations, intrinsics, body, frames)
        log.info("unexplained mask area: mean %.3f, most %.3f", found.area.mean(), found.area.max())
        frame = limbs.choose_frame(found, observations, taken)
        if found.area[frame] < 0.02:
            continue
        taken.add(frame)
        grown = limbs.limb_voxels(model, observations, intrinsics, body, frame, found.regions[frame], voting)
        body = limbs.attach(body, grown)
        points = growth.shell(body.solid, body.nodes)
        bones = initialise.place_bones(points, beginning.bones, settings.seed + r)
        growth.change_bones(model, bones, points, settings.seed + r)
    final = _build(architecture, videos, poses, body, beginning, settings.seed, root_free)
    final.bones, final.body, final.root = model.bones, model.body, model.root
    return final


def _build(
    architecture: Architecture,
    videos: list[VideoFacts],
    poses: Tensor,
    body: initialise.Hull,
    beginning: Beginning,
    seed: int,
    root_free: Tensor,
) -> Banmo:
    solid = body.nodes[body.solid]
    model = initialise.build(
        architecture, videos, poses, solid, beginning.hull_voxel, beginning.bones, seed, beginning.margin
    )
    model.root_free.copy_(root_free)
    return model


