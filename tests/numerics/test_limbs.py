"""Limbs in other poses: what counts as one, and that a leg which was taken for the other is found where it is."""

from __future__ import annotations

import math

import pytest
import torch

from stages.fitting import rethink
from stages.fitting.diagnose import FrameFigures
from stages.fitting.limbs import hung, limbs, other_limbs
from stages.fitting.observations import Observations
from stages.fitting.renew import imitate, posed
from stages.geometry.cameras import project, transform
from stages.geometry.rotations import so3_exp
from stages.model.banmo import Architecture, Banmo, VideoFacts
from stages.model.skeleton import Bones

pytestmark = pytest.mark.usefixtures("one_thread")

FRAMES, SIDE, FOCAL = 40, 64, 80.0
WRONG = slice(22, 30)  # of the second clip, where the front leg is where the hind leg's mirror image would be
HIPS = torch.tensor([[0.0, -0.2, 0.45], [0.0, -0.2, -0.45]])


def test_what_hangs_on_forks_is_a_limb() -> None:
    #        0 - 1 - 2 (fork) - 3 - 4,  2 - 5 - 6,  0 - 7
    parents = torch.tensor([0, 0, 1, 2, 3, 2, 5, 0])
    assert [limb.tolist() for limb in limbs(parents)] == [[3, 4], [5, 6], [7]]
    assert limbs(torch.tensor([0, 0, 1, 2])) == []


def body() -> tuple[torch.Tensor, torch.Tensor]:
    """Surface points (N, 3) of a trunk along z with two legs that hang from it, and the leg (N,) of each or -1."""
    generator = torch.Generator().manual_seed(0)
    trunk = torch.rand(160, 3, generator=generator) * torch.tensor([0.2, 0.3, 1.4]) - torch.tensor([0.1, 0.15, 0.7])
    leg = torch.rand(60, 3, generator=generator) * torch.tensor([0.1, 0.7, 0.1]) - torch.tensor([0.05, 0.7, 0.05])
    return torch.cat([trunk, HIPS[0] + leg, HIPS[1] + leg]), torch.tensor([-1] * 160 + [0] * 60 + [1] * 60)


def swung(angles: torch.Tensor) -> torch.Tensor:
    """The body with legs turned about x by `angles` (T, 2): (T, N, 3)."""
    points, leg = body()
    out = points.expand(len(angles), -1, -1).clone()
    for which in (0, 1):
        turns = so3_exp(torch.stack([angles[:, which], 0 * angles[:, which], 0 * angles[:, which]], 1))
        mine = leg == which
        out[:, mine] = (out[:, mine] - HIPS[which]) @ turns.transpose(1, 2) + HIPS[which]
    return out


def gait(wrong: bool) -> torch.Tensor:
    """Angles (2 T, 2) of a walk and of a faster one; where it is `wrong` the front leg swings the other way."""
    time = torch.arange(FRAMES) / 20
    walk = 0.7 * torch.stack([torch.sin(6 * time), torch.sin(6 * time + 2.0)], 1)
    run = 0.7 * torch.stack([torch.sin(8 * time + 1.0), torch.sin(8 * time + 1.0 + math.pi / 2)], 1)
    if wrong:
        run[WRONG, 0] = -run[WRONG, 0]
    return torch.cat([walk, run])


@pytest.fixture(scope="module")
def model() -> Banmo:
    """Two clips seen from the side, fitted to the wrong gait."""
    points, _ = body()
    down = torch.tensor([0.0, 0.25, 0.0])
    centres = torch.stack([torch.zeros(3), HIPS[0] - down, HIPS[1] - down, HIPS[0] - 2 * down, HIPS[1] - 2 * down])
    # The joint lies half way to the parent: hips are where the legs' uppermost bones meet small ones in the trunk.
    centres = torch.cat([centres[:1], HIPS + 0.3 * down, HIPS - 0.3 * down, centres[3:]])
    parents = torch.tensor([0, 0, 0, 1, 2, 3, 4])
    scales = torch.full((7, 3), -2.2)
    scales[0] = torch.tensor([-2.0, -2.0, -0.8])
    times = tuple(i / 20 for i in range(FRAMES))
    videos = [VideoFacts(f"clip{v}", times, SIDE, SIDE, (FOCAL, FOCAL), (SIDE / 2, SIDE / 2)) for v in range(2)]
    side = torch.tensor([[0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
    made = Banmo(
        Architecture(voxel=0.2, splines=41),
        videos,
        side.repeat(2 * FRAMES, 1, 1),
        torch.tensor([[-0.5, -1.2, -1.2], [0.5, 0.5, 1.2]]),
        Bones(centres, scales, parents),
        torch.Generator().manual_seed(0),
    )
    made.surface = points
    assert imitate(made, points, swung(gait(wrong=True)), seed=0, steps=500) < 0.03
    return made


@pytest.fixture(scope="module")
def observations(model: Banmo) -> Observations:
    """Silhouettes of the true gait."""
    masks = torch.zeros(2 * FRAMES, SIDE, SIDE, dtype=torch.uint8)
    state = model.frames(torch.tensor([0]))
    for t, points in enumerate(swung(gait(wrong=False))):
        placed = transform(state.camera_from_object[0], points)
        column, row = project(state.intrinsics[0], placed).detach().round().long().clamp(1, SIDE - 2).unbind(-1)
        for across in (-1, 0, 1):
            for along in (-1, 0, 1):
                masks[t, row + across, column + along] = 255
    count, empty = 2 * FRAMES, torch.zeros(0)
    return Observations(
        torch.arange(count) // FRAMES, torch.ones(count), empty, empty, empty, empty, empty,
        masks, torch.ones(count), torch.tensor([float(SIDE), float(SIDE)]),
    )  # fmt: skip


def error(points: torch.Tensor) -> torch.Tensor:
    """(T,) mean distance from the true gait, of the front leg's lower half."""
    where, leg = body()
    foot = (leg == 0) & (where[:, 1] < -0.6)
    return (points[:, foot] - swung(gait(wrong=False))[:, foot]).norm(dim=-1).mean(-1)


def test_a_leg_is_found_where_it_is(model: Banmo, observations: Observations) -> None:
    wrong = torch.zeros(2 * FRAMES, dtype=torch.bool)
    wrong[FRAMES + WRONG.start : FRAMES + WRONG.stop] = True
    found, gain = other_limbs(model, observations, torch.ones(2 * FRAMES, dtype=torch.bool))
    before = error(posed(model, model.surface))
    after = error(hung(model, found, model.surface, torch.arange(2 * FRAMES)))
    far = wrong & (before > 0.25)
    assert int(far.sum()) >= 4
    assert bool((after[far] < 0.5 * before[far]).all()) and bool((gain[far] > 0.15).all())
    assert float(after[~wrong].mean()) < float(before[~wrong].mean()) + 0.02
    assert float(gain[~wrong].mean()) < 0.3 * float(gain[far].mean())


def test_frames_that_are_not_asked_about_stay(model: Banmo, observations: Observations) -> None:
    tried = torch.zeros(2 * FRAMES, dtype=torch.bool)
    tried[FRAMES:] = True
    found, gain = other_limbs(model, observations, tried)
    every, _ = other_limbs(model, observations, torch.ones_like(tried))
    assert float(gain[:FRAMES].max()) == 0 and float(gain[FRAMES:].max()) > 0
    now = posed(model, model.surface)
    some = hung(model, found, model.surface, torch.arange(2 * FRAMES))
    assert torch.allclose(some[:FRAMES], now[:FRAMES], atol=1e-5)
    assert torch.allclose(some[FRAMES:], hung(model, every, model.surface, torch.arange(FRAMES, 2 * FRAMES)), atol=1e-6)


def test_second_thoughts_take_it_up(model: Banmo, observations: Observations) -> None:
    def figures_of(some: Banmo, seen: Observations) -> FrameFigures:
        off = error(posed(some, some.surface)).clamp_max(0.9)
        unknown = torch.full_like(off, torch.nan)
        off = torch.where(seen.frame_weight > 0, off + 0.1, torch.nan)
        return FrameFigures(overlap=1 - off, flow_px=unknown, feature=unknown, colour=unknown)

    before = error(posed(model, model.surface))
    told = rethink.second_thoughts(model, observations, figures_of, lambda some, seen: None, most=40, seed=0)
    after = error(posed(model, model.surface))
    far = before > 0.25
    assert told.taken >= int(far.sum())
    assert float(after[far].mean()) < 0.6 * float(before[far].mean())
    assert float(after[~far].mean()) < float(before[~far].mean()) + 0.03
