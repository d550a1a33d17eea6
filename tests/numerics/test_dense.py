"""Deformation without bones: what a network says at a point, each way; models with it are whole and learn."""

from __future__ import annotations

import pytest
import torch

from stages.fitting.trainer import Trainer
from stages.model.banmo import Architecture, Banmo
from stages.model.dense import DenseWarp
from tests.numerics.analytic_scene import TINY, Scene, model_of, scene, sphere, tiny_settings


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(sphere(0.5), frames=4)


def dense(kind: str) -> Architecture:
    return Architecture(**{**TINY.__dict__, "deformation": kind})


def test_a_warp_is_what_its_last_layer_says() -> None:
    points = torch.tensor([[[1.0, 0, 0], [0, 2.0, 0]]])
    code = torch.zeros(1, 8)
    for turns in (True, False):
        warp = DenseWarp(8, turns, torch.Generator().manual_seed(0))
        assert (warp(points, code) - points).abs().max() < 0.05  # nearly still at the start
        with torch.no_grad():
            warp.out.weight.zero_()
            quarter = [0, 0, torch.pi / 2] if turns else []
            warp.out.bias.copy_(torch.tensor([*quarter, 0.5, 0.0, -1.0]))
        expected = [[0.5, 1, -1], [-1.5, 0, -1]] if turns else [[1.5, 0, -1], [0.5, 2, -1]]
        assert torch.allclose(warp(points, code)[0], torch.tensor(expected), atol=1e-6)


@pytest.mark.parametrize("kind", ["se3", "translation"])
def test_a_model_without_bones_learns_and_comes_back(seen: Scene, kind: str) -> None:
    model = model_of(seen, lambda x: x.norm(dim=-1) - 0.45, architecture=dense(kind))
    assert model.dense is not None
    trainer = Trainer(model, seen.observations, tiny_settings(iterations=4))
    before = {k: v.clone() for k, v in trainer.state().items()}
    values = [trainer.step() for _ in range(3)]
    assert all(v["cycle_3d"] > 0 for v in values)
    after = trainer.state()
    for way in (0, 1):
        assert not torch.equal(before[f"model.dense.{way}.out.weight"], after[f"model.dense.{way}.out.weight"])
    again = Banmo.restore(dict(model.state_dict()), model.describe())
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(1)) * 0.3
    time = torch.tensor([0.1, 0.25], dtype=torch.float64)
    assert torch.equal(again.forward_warp(points, 0, time), model.forward_warp(points, 0, time))


def test_dual_quaternions_drive_a_whole_model(seen: Scene) -> None:
    architecture = Architecture(**{**TINY.__dict__, "blending": "dual_quaternion"})
    model = model_of(seen, lambda x: x.norm(dim=-1) - 0.45, architecture=architecture)
    trainer = Trainer(model, seen.observations, tiny_settings(iterations=4))
    first = trainer.step()
    assert all(torch.isfinite(torch.tensor(list(first.values()))))
    head = model.body.head.out.weight
    assert float(head.detach().abs().max()) > 0 and torch.isfinite(head).all()
