"""Figures of frames against what was put in; misfits are found, trusted less, and placed between their neighbours."""

from __future__ import annotations

import pytest
import torch

from stages.fitting import budget
from stages.fitting.diagnose import frame_figures, misfits, replace_from_neighbours
from stages.fitting.surface import frame_boxes, surface_points
from stages.fitting.trainer import Trainer
from stages.geometry.rotations import rigid, so3_exp, so3_log
from stages.model.banmo import Banmo
from tests.numerics.analytic_scene import Scene, describe_point, model_of, scene, sphere, tiny_settings

RADIUS = 0.5
SETTINGS = tiny_settings(iterations=8, probe_samples=40, fine_samples=20)


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(sphere(RADIUS), frames=6)


def true_model(seen: Scene) -> Banmo:
    model = model_of(seen, lambda x: x.norm(dim=-1) - RADIUS)
    model.surface = surface_points(model, 32)
    with torch.no_grad():
        grid = model.field.embedding_grid
        axes = [
            torch.linspace(float(model.bounds[0, k]), float(model.bounds[1, k]), grid.shape[4 - k]) for k in range(3)
        ]
        z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
        grid.copy_(describe_point(torch.stack([x, y, z], -1)).movedim(-1, 0)[None])
    return model


def test_a_true_model_explains_every_frame_and_a_moved_one_is_seen(seen: Scene) -> None:
    model = true_model(seen)
    good = frame_figures(model, seen.observations, frame_boxes(model), SETTINGS, 0.01)
    assert float(good.overlap.min()) > 0.9
    assert float(good.flow_px.nan_to_num(0).max()) < 0.5
    assert float(good.feature.max()) < 0.15
    model.base_poses[3, 0, 3] += 0.35
    moved = frame_figures(model, seen.observations, frame_boxes(model), SETTINGS, 0.01)
    assert float(moved.overlap[3]) < float(good.overlap[3]) - 0.2
    assert float(moved.flow_px[3]) > 3
    others = [f for f in range(12) if f != 3]
    assert torch.allclose(moved.overlap[others], good.overlap[others], atol=0.03)


def test_frames_without_weight_or_beyond_the_most_have_no_figures(seen: Scene) -> None:
    packed = scene(sphere(RADIUS), frames=6).observations
    packed.frame_weight[4] = 0
    model = true_model(seen)
    figures = frame_figures(model, packed, frame_boxes(model), SETTINGS, 0.01, most=5)
    assert int((~figures.overlap.isnan()).sum()) == 5 and bool(figures.overlap[4].isnan())


def test_misfits_are_far_below_their_own_clip() -> None:
    video = torch.tensor([0] * 10 + [1] * 10 + [2] * 3)
    overlap = torch.cat([torch.linspace(0.90, 0.95, 10), torch.linspace(0.5, 0.6, 10), torch.tensor([0.9, 0.1, 0.9])])
    assert not misfits(overlap, video).any()  # a poor clip is not a misfit, nor is a clip too short to tell
    overlap[2], overlap[7] = 0.5, torch.nan
    assert torch.nonzero(misfits(overlap, video))[:, 0].tolist() == [2]
    overlap[[10, 11, 12, 13]] = 0.05
    assert torch.nonzero(misfits(overlap, video))[:, 0].tolist()[1:] == [10, 11, 12]  # a third of the clip at most


def test_misfits_go_between_their_neighbours_where_poses_are_free(seen: Scene) -> None:
    model = true_model(seen)
    truth = model.base_poses.clone()
    bad = torch.zeros(12, dtype=torch.bool)
    bad[[2, 8]] = True
    model.root_free[1] = 0.0
    spoilt = rigid(so3_exp(torch.tensor([[0.0, 2.0, 0.0]]))[0], torch.tensor([1.0, 1.0, 5.0]))
    model.base_poses[[2, 8]] = spoilt
    assert replace_from_neighbours(model, bad) == 1
    assert torch.equal(model.base_poses[8], spoilt)  # given poses are held
    half = truth[1, :3, :3] @ so3_exp(so3_log(truth[1, :3, :3].T @ truth[3, :3, :3]) / 2)
    assert torch.allclose(model.base_poses[2, :3, :3], half, atol=1e-4)
    assert torch.allclose(model.base_poses[2, :3, 3], (truth[1, :3, 3] + truth[3, :3, 3]) / 2, atol=1e-5)


def test_a_run_rejects_what_does_not_fit_and_remembers_it() -> None:
    seen = scene(sphere(RADIUS), frames=6)
    model = true_model(seen)
    model.base_poses[3, :2, 3] += 0.5
    settings = tiny_settings(iterations=8, reject_at=0.25, lr_root=1e-5, lr_sdf=1e-5, lr_motion=1e-5)
    trainer = Trainer(model, seen.observations, settings)
    for _ in range(3):
        trainer.step()
    assert trainer.trust.tolist() == pytest.approx([1.0] * 3 + [0.1] + [1.0] * 8)
    assert float((trainer.model.base_poses[3, :2, 3] - seen.poses[3, :2, 3]).norm()) < 0.2
    state = trainer.state()
    tensors = {k.removeprefix("model."): v for k, v in state.items() if k.startswith("model.")}
    again = Trainer(Banmo.restore(tensors, trainer.model.describe()), seen.observations, settings)
    again.restore(state)
    assert torch.equal(again.trust, trainer.trust)
    assert again.step() == trainer.step()


def test_steps_follow_the_time_given(seen: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(true_model(seen), seen.observations, SETTINGS)
    before = {k: v.clone() for k, v in trainer.state().items()}
    clock = iter([100.0, 103.0, 200.0, 203.0])
    monkeypatch.setattr(budget.time, "perf_counter", lambda: next(clock))
    assert budget.affordable_steps(trainer, minutes=1) == round(60 * 0.92 / 0.5)
    assert budget.affordable_steps(trainer, minutes=0.001) == 20
    after = trainer.state()
    assert all(torch.equal(before[k], after[k]) for k in before)
