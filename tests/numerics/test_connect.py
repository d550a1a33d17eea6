"""One body: a limb that came loose is tied to it, a speck goes, what hangs together stays as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import label

from stages.fitting.connect import capsule, mend
from stages.fitting.evidence import share_on_masks
from stages.fitting.trainer import Trainer
from tests.numerics.analytic_scene import Scene, model_of, scene, sphere, tiny_settings

BODY, LIMB, SPECK = torch.zeros(3), torch.tensor([0.62, 0.0, 0.0]), torch.tensor([-0.7, 0.6, 0.6])


def ball(points: torch.Tensor, centre: torch.Tensor, radius: float) -> torch.Tensor:
    return (points - centre).norm(dim=-1) - radius


def loose(points: torch.Tensor) -> torch.Tensor:
    """A body, a limb that stands 0.12 away from it, and a speck."""
    parts = [ball(points, BODY, 0.3), ball(points, LIMB, 0.2), ball(points, SPECK, 0.1)]
    return torch.stack(parts).amin(0)


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(sphere(0.5), frames=2)


def parts(model: torch.nn.Module) -> int:
    return label(
        (model.sdf(model.field.node_positions().reshape(-1, 3)) < 0).reshape(model.field.shape).numpy(),
        np.ones((3, 3, 3)),
    )[1]


def test_distance_to_a_tube() -> None:
    start, end = torch.tensor([0.0, 0, 0]), torch.tensor([2.0, 0, 0])
    points = torch.tensor([[1.0, 0.5, 0], [-1.0, 0, 0], [3.0, 0, 1.0], [0.5, 0, 0]])
    assert capsule(points, start, end, 0.1) == pytest.approx([0.4, 0.9, 2**0.5 - 0.1, -0.1])
    assert capsule(points[:1], start, start, 0.1) == pytest.approx([1.25**0.5 - 0.1])


def test_a_loose_limb_is_tied_and_a_speck_removed(seen: Scene) -> None:
    model = model_of(seen, loose)
    assert parts(model) == 3
    before = model.sdf(torch.stack([BODY, LIMB]))
    assert mend(model, least_share=0.1, radius=0.1) == (1, 1)
    assert parts(model) == 1
    across = torch.cartesian_prod(torch.tensor([0.36]), *[torch.linspace(-0.2, 0.2, 9)] * 2)
    assert float(model.sdf(across).min()) < 0 < float(model.sdf(SPECK[None]))
    assert torch.allclose(model.sdf(torch.stack([BODY, LIMB])), before, atol=1e-4)
    assert mend(model) == (0, 0)


def test_a_limb_out_of_reach_is_removed(seen: Scene) -> None:
    model = model_of(seen, loose)
    assert mend(model, least_share=0.01, reach=0.05) == (0, 2)
    assert parts(model) == 1 and float(model.sdf(LIMB[None])) > 0


def test_only_what_lies_on_the_masks_is_tied(seen: Scene) -> None:
    model = model_of(seen, loose)
    asked: list[int] = []

    def on_masks(points: torch.Tensor) -> torch.Tensor:
        asked.append(len(points))
        return (points[:, 0] < 0).float()  # the limb is at positive x, the speck at negative

    assert mend(model, on_masks, least_share=0.001, reach=1.0) == (1, 1)
    assert max(asked) <= 400
    assert float(model.sdf(LIMB[None])) > 0 > float(model.sdf(SPECK[None]))


def test_share_of_frames_in_which_a_place_lies_on_the_mask(seen: Scene) -> None:
    model = model_of(seen, lambda points: ball(points, BODY, 0.5))
    centre, inside, beside = torch.zeros(3), torch.tensor([0.0, 0.3, 0.0]), torch.tensor([0.0, 0.75, 0.0])
    assert share_on_masks(model, seen.observations, torch.stack([centre, inside, beside])) == pytest.approx([1, 1, 0])
    lost = replace(seen.observations, frame_weight=torch.zeros(len(seen.observations)))
    assert share_on_masks(model, lost, beside[None]) == pytest.approx([1])
    assert len(share_on_masks(model, seen.observations, torch.zeros(0, 3))) == 0
    half = seen.observations.silhouettes.clone()
    half[::2] = 0  # every other frame has lost its object, and is trusted all the same
    assert share_on_masks(model, replace(seen.observations, silhouettes=half), centre[None]) == pytest.approx([0.5])


def test_what_the_picture_does_not_show_is_not_held_against_a_place(seen: Scene) -> None:
    model = model_of(seen, lambda points: ball(points, BODY, 0.5))
    assert share_on_masks(model, seen.observations, torch.tensor([[0.0, 40.0, 0.0]])) == pytest.approx([1])


def test_a_run_mends_when_bounds_are_updated_and_at_its_end(seen: Scene) -> None:
    # The limb is true to the model and beside the masks of the scene, which show a ball: all but the body goes.
    settings = {"iterations": 8, "mend_from": 0.3, "update_bounds_every": 3, "lr_sdf": 1e-6}
    for wanted in (True, False):
        trainer = Trainer(model_of(seen, loose), seen.observations, tiny_settings(mend=wanted, **settings))
        counts = []
        for _ in range(5):
            trainer.step()
            counts.append(parts(trainer.model))
        assert counts == ([3, 3, 3, 1, 1] if wanted else [3] * 5)
    short = {**settings, "iterations": 2, "update_bounds_every": 100}
    trainer = Trainer(model_of(seen, loose), seen.observations, tiny_settings(mend=True, **short))
    trainer.step()
    assert parts(trainer.model) == 3
    trainer.step()
    assert trainer.done and parts(trainer.model) == 1
