"""The loop of a phase: exact resume, renewal that keeps the motion, divergence that updates nothing."""

from __future__ import annotations

import json
from dataclasses import fields

import pytest
import torch

from stages.fitting.initialise import place_bones
from stages.fitting.renew import change_bones, renew_bounds
from stages.fitting.schedule import PhaseSettings
from stages.fitting.surface import surface_points
from stages.fitting.trainer import Diverged, Trainer
from stages.model.banmo import Banmo
from tests.numerics.analytic_scene import Scene, model_of, scene, sphere, stir, tiny_settings

pytestmark = pytest.mark.usefixtures("one_thread")

STEPS = 9
RENEW = 5
SETTINGS = tiny_settings(
    iterations=STEPS, renew_at=RENEW / STEPS, delta_from=0.3, edge_share=0.25, active_share=0.25, active_from=0.3
)


def ball(points: torch.Tensor) -> torch.Tensor:
    return points.norm(dim=-1) - 0.45


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(sphere(0.5), frames=4)


def first_model(seen: Scene) -> Banmo:
    model = model_of(seen, ball)
    stir(model, 0.1)
    return model


Saved = tuple[dict[str, torch.Tensor], dict]


@pytest.fixture(scope="module")
def straight(seen: Scene) -> tuple[dict[int, Saved], list[dict[str, float]]]:
    """State before every step and at the end, and the values of every step, of an undisturbed run."""
    trainer = Trainer(first_model(seen), seen.observations, SETTINGS)
    saved, values = {}, []
    while not trainer.done:
        assert (trainer.renewal_error is not None) == (trainer.step_idx > RENEW)
        saved[trainer.step_idx] = trainer.state(), json.loads(json.dumps(trainer.model.describe()))
        values.append(trainer.step())
    saved[STEPS] = trainer.state(), trainer.model.describe()
    return saved, values


def test_a_run_learns_and_renews(straight: tuple[dict[int, Saved], list[dict[str, float]]]) -> None:
    saved, values = straight
    assert len(values) == STEPS
    first, last = saved[0], saved[STEPS]
    for part in ("field.sdf_grids.0", "field.colour_grids.0", "body.head.out.weight", "root.head.out.weight"):
        assert not torch.equal(first[0][f"model.{part}"].flatten()[:50], last[0][f"model.{part}"].flatten()[:50]), part
    assert saved[RENEW][1]["bounds"] != saved[RENEW + 1][1]["bounds"]  # the box was fitted to the shape
    moved = saved[RENEW + 1][0]["model.bones.centres"] - saved[RENEW][0]["model.bones.centres"]
    assert float(moved.norm(dim=1).max()) > 0.02
    assert last[1]["use_delta"] and not first[1]["use_delta"]
    for row in values:
        parts = sum(v for k, v in row.items() if k != "total")
        assert row["total"] == pytest.approx(parts, rel=1e-4)


@pytest.mark.parametrize("at", [2, RENEW, RENEW + 1, STEPS - 1])
def test_resuming_is_exact(seen: Scene, straight: tuple[dict[int, Saved], list[dict[str, float]]], at: int) -> None:
    """Before, at and after the renewal that changes the model's sizes; a fresh process knows only what was saved."""
    saved, values = straight
    state, description = saved[at]
    tensors = {k.removeprefix("model."): v.clone() for k, v in state.items() if k.startswith("model.")}
    model = Banmo.restore(tensors, description)
    torch.manual_seed(at)  # nothing may depend on the global generator
    trainer = Trainer(model, seen.observations, SETTINGS)
    trainer.restore(state)
    assert trainer.step_idx == at
    for name, value in trainer.state().items():
        assert torch.equal(value, state[name]), name
    end = STEPS if at >= RENEW else at + 2
    for step in range(at, end):
        assert trainer.step() == values[step]
    expected = saved[end][0]
    found = trainer.state()
    assert found.keys() == expected.keys()
    for name, value in found.items():
        assert torch.equal(value, expected[name]), name


def test_state_is_a_copy(seen: Scene) -> None:
    trainer = Trainer(first_model(seen), seen.observations, SETTINGS)
    before = trainer.state()
    kept = {k: v.clone() for k, v in before.items()}
    trainer.step()
    assert all(torch.equal(before[k], kept[k]) for k in kept)


def test_divergence_is_raised_before_anything_is_updated(seen: Scene) -> None:
    broken = scene(sphere(0.5), frames=4)
    for step in broken.observations.flow:
        broken.observations.flow[step][:] = torch.nan
    trainer = Trainer(first_model(broken), broken.observations, SETTINGS)
    before = trainer.state()
    with pytest.raises(Diverged, match="'flow' is not finite at step 0") as caught:
        trainer.step()
    assert caught.value.term == "flow" and caught.value.step == 0
    after = trainer.state()
    assert after.keys() == before.keys() and all(torch.equal(before[k], after[k]) for k in before)
    assert all(torch.isfinite(p).all() for p in trainer.model.parameters())


def test_a_rate_of_zero_holds_its_parameters(seen: Scene) -> None:
    settings = tiny_settings(iterations=4, lr_sdf=0.0, lr_root=0.0, lr_focal=0.0, lr_bones=0.0, delta_from=2.0)
    trainer = Trainer(first_model(seen), seen.observations, settings)
    before = trainer.state()
    for _ in range(3):
        trainer.step()
    after = trainer.state()
    held = ("model.field.sdf_grids", "model.root.", "model.log_focal", "model.bones.", "model.delta.")
    for name in before:
        if name.startswith(held):
            assert torch.equal(before[name], after[name]), name
    assert not torch.equal(before["model.body.head.out.weight"], after["model.body.head.out.weight"])
    assert not torch.equal(before["model.field.colour_grids.0"], after["model.field.colour_grids.0"])


def test_the_shape_is_held_while_it_is_frozen(seen: Scene) -> None:
    settings = tiny_settings(iterations=4, sdf_frozen_until=0.5)
    trainer = Trainer(first_model(seen), seen.observations, settings)
    start = trainer.model.field.sdf_grids[0].detach().clone()
    trainer.step()
    trainer.step()
    assert torch.equal(trainer.model.field.sdf_grids[0], start)
    trainer.step()
    assert not torch.equal(trainer.model.field.sdf_grids[0], start)


def test_given_root_poses_stay_as_they_are(seen: Scene) -> None:
    trainer = Trainer(first_model(seen), seen.observations, tiny_settings(iterations=3))
    trainer.model.root_free[0] = 0.0
    for _ in range(3):
        trainer.step()
    with torch.no_grad():
        poses = trainer.model.frames(torch.arange(8)).camera_from_object
    assert torch.equal(poses[:4], seen.poses[:4])
    assert not torch.allclose(poses[4:], seen.poses[4:], atol=1e-4)


# ---------------------------------------------------------------------------------------------- renewal


def test_new_bones_keep_the_motion(seen: Scene) -> None:
    model = model_of(seen, ball)
    stir(model, 0.4)
    points = surface_points(model, 32)
    frames = torch.arange(8)
    some = points[::20]

    def posed() -> torch.Tensor:
        with torch.no_grad():
            return model.forward_points(model.frames(frames), some[None].expand(8, -1, -1))

    before = posed()
    size = float((before - some).square().sum(-1).mean().sqrt())
    bones = place_bones(points, 3, 4)
    centres = bones.centres.detach().clone()
    difference = change_bones(model, bones, points, seed=0)
    assert torch.equal(model.bones.centres.detach(), centres)
    assert size > 0.05
    assert difference < 0.35 * size
    found = float((posed() - before).square().sum(-1).mean().sqrt())
    assert found == pytest.approx(difference, rel=0.3)
    assert all(p.grad is None for p in model.body.parameters())


def test_new_bounds_hold_the_surface_and_keep_the_shape(seen: Scene) -> None:
    model = model_of(seen, ball, half=1.2)
    model.surface = surface_points(model, 48)
    inside = model.surface[::30] * 0.9
    before = model.sdf(inside)
    assert renew_bounds(model, margin=0.2)
    assert (model.bounds.abs() - 0.65).abs().max() < 0.03
    assert torch.allclose(model.sdf(inside), before, atol=0.02)
    assert not renew_bounds(model, margin=0.2)  # already there


def test_what_sticks_out_beside_the_masks_is_pulled_back(seen: Scene) -> None:
    """The whole shape stands beside the object: no ray of the batch meets it, its surface points bring it back."""
    model = model_of(seen, lambda points: (points - torch.tensor([0.4, 0.0, 0.0])).norm(dim=-1) - 0.3)
    off = {f.name: 0.0 for f in fields(PhaseSettings) if f.name.startswith("weight_")}
    off |= {"lr_sdf": 0.0, "lr_colour": 0.0, "lr_bones": 0.0, "lr_motion": 5e-3}
    settings = tiny_settings(iterations=30, **{**off, "weight_spill": 1.0, "spill_from": 0.0})
    trainer = Trainer(model, seen.observations, settings)
    spilt = []
    while not trainer.done:
        values = trainer.step()
        assert set(values) == {"spill", "total"}
        spilt.append(values["spill"])
    assert sum(spilt[-5:]) < 0.5 * sum(spilt[:5])
