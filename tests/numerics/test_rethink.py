"""Second thoughts: who is asked again, what else it might be, and that only what is better is taken."""

from __future__ import annotations

import pytest
import torch

from stages.fitting import known_poses, rethink, stretches, trainer
from stages.fitting.diagnose import FrameFigures
from stages.fitting.observations import Observations
from stages.fitting.renew import posed
from stages.geometry.rotations import rigid, so3_exp
from stages.model.banmo import Banmo
from stages.model.motion import FourierCode
from tests.numerics.analytic_scene import Scene, ellipsoid, scene
from tests.numerics.moving_body import FRAMES, RADII, codes, moving, observations, resumes_exactly

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(ellipsoid(RADII), frames=6)


@pytest.fixture
def model(seen: Scene) -> Banmo:
    """Two clips of 40 frames, 20 a second, of a body that moves."""
    return moving(seen, 20.0)


def test_a_code_is_steered_where_it_is_told_and_stays_elsewhere() -> None:
    code = FourierCode(2, 6, 3, torch.Generator().manual_seed(0), splines=43)
    time = torch.linspace(-1, 1, FRAMES)
    before = code(torch.zeros(FRAMES, dtype=torch.int64), time).detach()
    other = code.coefficients[1].clone()
    change = torch.zeros(FRAMES, 6)
    change[15:25] = torch.randn(6, generator=torch.Generator().manual_seed(1))
    code.steer(0, time, change, ridge=1e-3)
    after = code(torch.zeros(FRAMES, dtype=torch.int64), time).detach()
    assert torch.allclose(after, before + change, atol=0.02)
    assert torch.equal(code.coefficients[1], other)


def test_a_stretch_is_doubted_but_no_single_frame_and_no_clip_as_a_whole(model: Banmo) -> None:
    error = torch.ones(2 * FRAMES)
    error[10:20] = 1.5
    error[30] = 1.2
    error[FRAMES:] = 3.0  # bad, but no worse in one place than in another
    error[5] = torch.nan
    found = torch.nonzero(rethink.doubtful(error, model))[:, 0]
    assert found.min() in range(7, 11) and found.max() in range(19, 23)
    assert set(range(10, 20)) <= set(found.tolist())
    assert not rethink.doubtful(torch.full((2 * FRAMES,), torch.nan), model).any()


@pytest.mark.parametrize("frames_a_second", [6.0, 10.0, 15.0, 20.0, 24.0, 30.0, 60.0])
def test_one_bad_frame_and_even_errors_are_no_other_reading(seen: Scene, frames_a_second: float) -> None:
    model = moving(seen, frames_a_second)
    error = torch.ones(2 * FRAMES)
    assert not rethink.doubtful(error, model).any()
    error[12] = error[FRAMES + 30] = 3.0
    assert not rethink.doubtful(error, model).any()
    error[:8] = torch.nan
    assert not rethink.doubtful(error, model).any()


def test_what_was_not_looked_at_says_nothing(model: Banmo) -> None:
    """Of long collections only some frames are compared: the others neither gain nor dilute."""
    error, asked = torch.full((2 * FRAMES,), torch.nan), torch.zeros(2 * FRAMES, dtype=torch.bool)
    error[::3] = 1.0
    error[12:24:3] = 1.5
    found = torch.nonzero(rethink.doubtful(error, model))[:, 0]
    assert set(range(12, 21)) <= set(found.tolist()) <= set(range(8, 28))
    asked[10:30] = True
    gain = torch.full((2 * FRAMES,), torch.nan)
    assert not rethink.better(gain, asked, model).any()
    gain[10:30:4] = -0.2
    assert not rethink.better(gain, asked, model).any()
    gain[10:30:4] = 0.2
    assert torch.equal(rethink.better(gain, asked, model), asked)


def test_what_is_gained_briefly_or_lost_is_not_taken(model: Banmo) -> None:
    asked = torch.zeros(2 * FRAMES, dtype=torch.bool)
    asked[:38] = asked[45:75] = True
    gain = torch.full((2 * FRAMES,), -0.1)
    gain[10:30] = 0.3
    gain[50:70] = -0.03
    found = torch.nonzero(rethink.better(gain, asked, model))[:, 0]
    assert set(range(10, 30)) <= set(found.tolist()) <= set(range(4, 36))
    gain[10:30], gain[20] = -0.1, 0.5
    assert not rethink.better(gain, asked, model).any()


def test_the_other_reading_is_another_pose(model: Banmo) -> None:
    asked = torch.zeros(2 * FRAMES, dtype=torch.bool)
    asked[10:20] = True
    known = observations(2 * FRAMES)
    wanted, excess = rethink.other_readings(model, known, asked)
    assert torch.equal(wanted >= 0, asked) and torch.equal(torch.isfinite(excess), asked)
    points = model.surface[:: max(1, len(model.surface) // 160)]
    shapes = known_poses.known_shapes(model, torch.arange(2 * FRAMES), points)
    apart = (shapes[wanted[asked]] - shapes[asked]).square().sum(-1).mean(-1).sqrt()
    assert float(apart.min()) > 0.9 * rethink._APART
    wide = known.silhouettes.clone()
    known.silhouettes[:, :, :20] = 0  # something to choose by
    wanted, excess = rethink.other_readings(model, known, asked)
    turn = so3_exp(torch.randn(2 * FRAMES, 3, generator=torch.Generator().manual_seed(2)))
    model.gauge.copy_(rigid(turn, torch.zeros(2 * FRAMES, 3)))  # no picture tells root from bones
    turned = rethink.other_readings(model, known, asked)
    assert torch.equal(turned.frame, wanted) and torch.allclose(turned.excess, excess, atol=1e-3)
    known.silhouettes = wide
    known.frame_weight[wanted[asked].unique()] = 0
    assert known.frame_weight[rethink.other_readings(model, known, asked).frame[asked & (known.frame_weight > 0)]].all()
    known.frame_weight[:] = 0
    assert (rethink.other_readings(model, known, asked).frame < 0).all()


def test_what_another_pose_suits_as_well_is_looked_at_though_nothing_stands_out(model: Banmo) -> None:
    excess, without = torch.full((2 * FRAMES,), 0.9), torch.zeros(2 * FRAMES, dtype=torch.bool)
    excess[:FRAMES] = 0.2 + torch.arange(FRAMES) / 100
    excess[50:60] = 0.1
    excess[70:73] = -0.3  # too short
    without[:8] = True
    found = torch.nonzero(rethink.closest(excess, model, without, most=25))[:, 0].tolist()
    assert 20 <= len(found) <= 25
    assert set(range(51, 59)) | set(range(8, 18)) <= set(found) <= set(range(48, 62)) | set(range(8, 30))
    assert not rethink.closest(excess, model, without, most=0).any()
    assert torch.equal(rethink.closest(excess, model, without, most=999), ~without)
    excess[:FRAMES] = torch.inf
    assert not rethink.closest(excess, model, without, most=999)[:FRAMES].any()
    assert not rethink.closest(torch.full_like(excess, torch.inf), model, without, most=999).any()


def test_a_path_goes_on_as_the_motion_did_and_ends_with_its_clip(model: Banmo) -> None:
    every = torch.arange(2 * FRAMES)
    after = known_poses.following(every, model)
    assert after[:3].tolist() == [1, 2, 3] and after[[FRAMES - 1, -1]].tolist() == [FRAMES - 1, 2 * FRAMES - 1]
    shapes = known_poses.known_shapes(model, every, model.surface)
    price = known_poses.jumps(shapes, shapes[after])
    assert torch.equal(price.argmin(1), after)
    # A clip whose middle says nothing is read as the course that led from its start to its end.
    cost = torch.full((20, 2 * FRAMES), 0.1)
    cost[0, 50] = cost[-1, 69] = 0.0
    assert known_poses.best_sequence(cost, price).tolist() == list(range(50, 70))


def test_of_long_collections_some_stretches_are_read(model: Banmo) -> None:
    known = observations(2 * FRAMES)
    known.frame_weight[15:20] = 0
    every = stretches.drawn(known, model, 999, seed=0)
    assert torch.equal(every, known.frame_weight > 0)
    few = stretches.drawn(known, model, 20, seed=0)
    assert 15 <= few.sum() <= 20 and not (few & ~every).any()
    assert any(not torch.equal(few, stretches.drawn(known, model, 20, seed)) for seed in range(1, 5))


def test_the_worst_stretches_come_first_if_there_is_no_time_for_all(model: Banmo) -> None:
    asked = torch.zeros(2 * FRAMES, dtype=torch.bool)
    asked[5:15] = asked[30:50] = asked[60:68] = True  # the second runs on into the other clip
    error = torch.ones(2 * FRAMES)
    error[60:68], error[30:40], error[40:50] = 3.0, 2.0, 1.5
    kept = rethink.worst(asked, error, model, most=20)
    assert torch.nonzero(kept)[:, 0].tolist() == [*range(30, 40), *range(60, 68)]
    assert torch.equal(rethink.worst(asked, error, model, most=99), asked)
    assert rethink.worst(asked, error, model, most=4).sum() == 4
    assert not rethink.worst(torch.zeros_like(asked), error, model, most=99).any()


@pytest.mark.parametrize(("gain", "taken"), [(0.01, False), (0.2, True)])
def test_a_clip_misread_from_end_to_end_must_gain_clearly(model: Banmo, gain: float, taken: bool) -> None:
    """Nothing stands out: every frame is explained as well as every other."""
    before, known = codes(model), observations(2 * FRAMES)

    def figures_of(some: Banmo, focus: Observations) -> FrameFigures:
        moved = (codes(some) - before).norm(dim=1) > 0.1 * float(before.norm(dim=1).mean())
        error = torch.full((2 * FRAMES,), 0.1)
        error[moved] *= 1 - gain
        error[focus.frame_weight == 0] = torch.nan
        return FrameFigures(1 - error, error, torch.full_like(error, torch.nan), error)

    told = rethink.second_thoughts(model, known, figures_of, lambda some, focus: None, most=40, seed=0)
    assert 20 <= told.looked_at <= 40
    assert (told.taken >= 0.5 * told.looked_at) == taken and (told.taken > 0) == taken


@pytest.mark.parametrize("helps", [True, False])
def test_the_better_reading_is_kept_and_only_there(model: Banmo, helps: bool) -> None:
    """Figures as they would be if some frames' own codes were right, or the other ones."""
    before, were = codes(model), posed(model, model.surface)
    known, stretch = observations(2 * FRAMES), slice(10, 22)
    practised = []

    def figures_of(some: Banmo, focus: Observations) -> FrameFigures:
        moved = (codes(some) - before).norm(dim=1) > 0.1 * float(before.norm(dim=1).mean())
        error = torch.full((2 * FRAMES,), 0.1)
        error[stretch] = 0.2
        error[moved] = 0.1 if helps else 0.3
        error[focus.frame_weight == 0] = torch.nan
        return FrameFigures(1 - error, error, torch.full_like(error, torch.nan), error)

    def practise(some: Banmo, focus: Observations) -> None:
        assert some is not model and bool((focus.frame_weight[:5] == 0).all())
        practised.append(some)

    told = rethink.second_thoughts(model, known, figures_of, practise, most=40, seed=0)
    assert len(practised) == 2 and told.looked_at >= 12
    change = (posed(model, model.surface) - were).square().sum(-1).mean(-1).sqrt()
    if not helps:
        assert told.taken == 0 and float(change.max()) == 0
        return
    assert told.taken >= 8
    assert float(change[stretch].mean()) > 0.08
    assert float(change[stretch].mean()) > 6 * float(change[25:].mean())
    wanted = posed(practised[1], model.surface)[14:18]
    assert float((posed(model, model.surface)[14:18] - wanted).norm(dim=-1).mean()) < 0.03


def test_a_phase_thinks_again_at_its_times_and_resumes_exactly(seen: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where it reads everything anew."""
    monkeypatch.setattr(rethink, "doubtful", lambda error, model: torch.ones(len(error), dtype=torch.bool))
    monkeypatch.setattr(rethink, "_LEAST_GAIN", -1e9)
    monkeypatch.setattr(rethink, "_APART", 1e-3)
    monkeypatch.setattr(trainer, "_PRACTISED", 1)
    done = resumes_exactly(seen, "rethought", rethink_at=(0.5,))
    assert done.rethought is not None and done.rethought.taken > 0
    assert done.reread.tolist() == [done.rethought.looked_at, done.rethought.taken]
