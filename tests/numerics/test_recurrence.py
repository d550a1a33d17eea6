"""Motion that recurs: where it is found, how two stretches come together, and that only what fits is taken."""

from __future__ import annotations

import pytest
import torch

from stages.fitting import recurrence, trainer
from stages.fitting.diagnose import FrameFigures
from stages.fitting.observations import Observations
from stages.fitting.recurrence import Pair
from stages.fitting.renew import posed
from stages.fitting.trainer import Trainer
from stages.geometry.cameras import project, transform
from stages.model.banmo import Banmo
from tests.numerics.analytic_scene import Scene, ellipsoid, model_of, scene, stir, tiny_settings
from tests.numerics.moving_body import FRAMES, RADII, codes, moving, observations, resumes_exactly, solid

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(ellipsoid(RADII), frames=6)


@pytest.fixture
def model(seen: Scene) -> Banmo:
    """Two clips of 40 frames, 20 a second, of a body that moves."""
    return moving(seen, 20.0)


def partners(pairs: list[tuple[range, int]]) -> torch.Tensor:
    found = torch.full((2 * FRAMES,), -1)
    for stretch, delay in pairs:
        first = torch.tensor(stretch)
        found[first], found[first + delay] = first + delay, first
    return found


def as_masks(model: Banmo) -> Observations:
    """Masks of the model's own surface as it is posed."""
    known = observations(2 * FRAMES)
    every = torch.arange(2 * FRAMES)
    state = model.frames(every)
    points = transform(state.camera_from_object, posed(model, model.surface)).detach()
    pixels = project(state.intrinsics.detach(), points) * (32 / 48)
    known.silhouettes[:] = 0
    column, row = (pixels[..., i].floor().long().clamp(0, 31) for i in range(2))
    known.silhouettes[every[:, None].expand_as(row), row, column] = 255
    return known


def repeat(model: Banmo, delay: int) -> None:
    """The second clip begins `delay` frames later in the first one's motion."""
    was, change = codes(model), torch.zeros(FRAMES, codes(model).shape[1])
    change[: FRAMES - delay] = was[delay:FRAMES] - was[FRAMES : 2 * FRAMES - delay]
    model.body.code.steer(1, model.time[FRAMES:], change, ridge=1e-4)


def test_a_motion_seen_twice_is_found_at_its_delay(model: Banmo) -> None:
    repeat(model, 12)
    partner = recurrence.recurring(model, as_masks(model), most=999, seed=0)
    paired = torch.nonzero(partner >= 0)[:, 0]
    assert torch.equal(partner[partner[paired]], paired)  # mutual
    mine = paired[paired >= FRAMES]
    assert len(mine) >= 20
    assert float((partner[mine] - (mine - FRAMES + 12)).abs().double().mean()) <= 2


def test_what_cannot_be_seen_or_runs_at_another_pace_has_no_partner(
    model: Banmo, monkeypatch: pytest.MonkeyPatch
) -> None:
    repeat(model, 12)
    known = as_masks(model)
    known.frame_weight[FRAMES:] = 0
    partner = recurrence.recurring(model, known, most=999, seed=0)
    assert (partner[FRAMES:] < 0).all() and (partner < FRAMES).all()
    known.frame_weight[:] = 0
    assert (recurrence.recurring(model, known, most=999, seed=0) < 0).all()
    known.frame_weight[:] = 1
    rates = [(slice(0, FRAMES), 20.0), (slice(FRAMES, 2 * FRAMES), 15.0)]
    monkeypatch.setattr(recurrence, "clips", lambda _: rates)
    partner = recurrence.recurring(model, known, most=999, seed=0)
    assert (partner[:FRAMES] < FRAMES).all() and ((partner[FRAMES:] < 0) | (partner[FRAMES:] >= FRAMES)).all()


def test_parts_of_a_path_keep_to_one_clip_and_one_pace() -> None:
    stretch, video = torch.arange(10, 30), torch.tensor([0] * 40 + [1] * 40)
    path = torch.cat([torch.arange(50, 58), torch.arange(20, 25), torch.tensor([70] * 7)])
    path[3] += 2  # a little ahead
    parts = recurrence.at_one_pace(stretch, path, video, slack=2.0)
    assert torch.equal(torch.cat([part for part, _ in parts]), stretch)
    assert parts[0][0].tolist() == list(range(10, 18)) and parts[0][1] == 40
    assert parts[1][0].tolist() == list(range(18, 23)) and parts[1][1] == 2
    assert len(parts) == 4  # standing still is no motion at that pace


def test_long_motions_come_first_each_frame_once_and_none_with_itself(
    model: Banmo, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pair(start: int, stop: int, delay: int) -> Pair:
        return Pair(torch.arange(start, stop), torch.arange(start, stop) + delay)

    found = [pair(0, 14, 45), pair(0, 30, 42), pair(20, 38, 5), pair(30, 40, 36), pair(60, 65, 10)]
    monkeypatch.setattr(recurrence, "candidates", lambda *_: found)
    every = recurrence.recurring(model, observations(2 * FRAMES), most=999, seed=0)
    assert torch.equal(every[:30], torch.arange(42, 72))
    assert every[42:72].tolist() == list(range(30))
    assert (every[[*range(30, 42), *range(72, 80)]] < 0).all()
    few = recurrence.recurring(model, observations(2 * FRAMES), most=30, seed=0)
    assert torch.nonzero(few >= 0)[:, 0].tolist() == [*range(15), *range(42, 57)]  # as much of it as there is room for
    assert (recurrence.recurring(model, observations(2 * FRAMES), most=8, seed=0) < 0).all()


def test_what_is_furthest_apart_comes_first(model: Banmo, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [Pair(torch.arange(0, 20), torch.arange(40, 60)), Pair(torch.arange(20, 36), torch.arange(62, 78))]
    monkeypatch.setattr(recurrence, "candidates", lambda *_: found)
    was = codes(model)
    change = torch.zeros(FRAMES, was.shape[1])
    change[:20] = was[:20] - was[40:60]
    model.body.code.steer(1, model.time[FRAMES:], change, ridge=1e-4)
    partner = recurrence.recurring(model, observations(2 * FRAMES), most=32, seed=0)
    assert torch.equal(partner[20:36], torch.arange(62, 78)) and (partner[:20] < 0).all()


def test_partners_meet_half_way_and_others_stay(model: Banmo) -> None:
    before, partner = codes(model), partners([(range(5, 25), 45)])
    first, second = slice(7, 23), slice(52, 68)

    def length(change: torch.Tensor) -> float:
        return float(change.norm(dim=1).mean())

    recurrence.meet(model, partner)
    after = codes(model)
    assert length(after[first] - after[second]) < 0.25 * length(before[first] - before[second])
    assert length(after[first] - (before[first] + before[second]) / 2) < 0.2 * length(before)
    assert length((after - before)[30:40]) < 0.1 * length(before)
    share = (partner >= 0).float()
    share[50:70] = 0  # one goes all the way
    recurrence.meet(model, partner, share)
    assert length(codes(model)[second] - after[second]) < 0.1 * length(before)


def test_both_start_from_the_pose_that_suits_both(model: Banmo) -> None:
    repeat(model, 12)
    known, partner = as_masks(model), partners([(range(12, 36), FRAMES - 12)])
    model.body.code.steer(0, model.time[:FRAMES], torch.randn(1, codes(model).shape[1]).expand(FRAMES, -1), 1e-3)
    worse = recurrence.suits_both(model, known, partner)
    assert worse[12:36].float().mean() > 0.7 and worse[FRAMES : FRAMES + 24].float().mean() < 0.3
    assert not worse[:12].any() and not (worse & (partner < 0)).any()


def test_a_pair_is_judged_as_a_whole(model: Banmo) -> None:
    partner = partners([(range(0, 15), 40), (range(20, 36), 40)])
    gain = torch.full((2 * FRAMES,), -0.05)
    gain[20:36] = -0.3
    gain[0:5] = -0.3  # made up for by the rest
    found = recurrence.tolerable(gain, partner, model)
    assert found[:15].all() and found[40:55].all() and found.sum() == 30
    assert not recurrence.tolerable(torch.full_like(gain, torch.nan), partner, model).any()


@pytest.mark.parametrize("loss", [0.0, 1.0])
def test_one_motion_is_taken_up_where_it_explains_both(
    model: Banmo, monkeypatch: pytest.MonkeyPatch, loss: float
) -> None:
    partner = partners([(range(5, 25), 45)])
    monkeypatch.setattr(recurrence, "recurring", lambda *_: partner)
    before, were, practised = codes(model), posed(model, model.surface), []

    def figures_of(some: Banmo, focus: Observations) -> FrameFigures:
        moved = (codes(some) - before).norm(dim=1) > 0.1 * float(before.norm(dim=1).mean())
        error = torch.where(moved, 0.1 * (1 + loss), 0.1)
        error[focus.frame_weight == 0] = torch.nan
        return FrameFigures(1 - error, error, torch.full_like(error, torch.nan), error)

    def practise(some: Banmo, focus: Observations, between: object) -> None:
        assert some is not model and torch.equal(focus.frame_weight > 0, partner >= 0)
        for step in range(1, 21):
            between(some, step)  # type: ignore[operator]
        practised.append(some)

    told = recurrence.share_motion(model, as_masks(model), figures_of, practise, most=99, seed=0)
    assert told.paired == 40 and len(practised) == 2
    now = posed(model, model.surface)
    if loss:
        assert told.taken == 0 and torch.equal(now, were)
        return
    assert told.taken == 40
    gap = (now[8:22] - now[53:67]).norm(dim=-1).mean() / (were[8:22] - were[53:67]).norm(dim=-1).mean()
    assert float(gap) < 0.35
    assert float((now - were)[30:40].norm(dim=-1).mean()) < 0.2 * float((now - were)[8:22].norm(dim=-1).mean()) + 0.01


def test_a_phase_shares_motion_at_its_times_and_resumes_exactly(seen: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    partner = torch.tensor([*range(6, 12), *range(6)])
    monkeypatch.setattr(recurrence, "recurring", lambda *_: partner)
    monkeypatch.setattr(recurrence, "_TOLERATED", 1e9)
    monkeypatch.setattr(recurrence, "_EVERY", 1)
    done = resumes_exactly(seen, "recurred", recur_at=(0.5,))
    assert done.recurred is not None and done.recurred.taken == 12 and done.shared.tolist() == [12, 12]


def test_what_diverges_leaves_the_model_as_it_was(seen: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def diverges(*_: object) -> None:
        raise trainer.Diverged(1, "colour")

    monkeypatch.setattr(trainer, "share_motion", diverges)
    model = model_of(seen, solid)
    stir(model, 1.0)
    one = Trainer(model, seen.observations, tiny_settings(iterations=6, recur_at=(0.5,)))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    one._share_motion()
    assert one.shared.tolist() == [0, 0]
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
