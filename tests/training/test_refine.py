"""The refiner's training: rough masks that are rough, a run that goes on where it stopped, an ONNX file that agrees."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from synthetic.backgrounds import backgrounds
from synthetic.bank import main as write_bank
from training.corruption import corrupted
from training.export import refiner_model
from training.network import CATEGORIES, Network
from training.refine import Refiner, averaged_refiner, examples, overlap, refining_loss, train
from training.train import keep, load_bank
from training.wardrobe import Bank, Random

SIDE_PX = 64


@pytest.fixture(scope="module")
def banks(tmp_path_factory: pytest.TempPathFactory) -> list[Bank]:
    out = tmp_path_factory.mktemp("bank")
    for category in (*CATEGORIES, "thing"):
        write_bank(out, category, bodies=1, views=4, seed=3, side_px=SIDE_PX)
    return [load_bank(out, name) for name in (*CATEGORIES, "thing")]


@pytest.fixture(scope="module")
def photos() -> torch.Tensor:
    return torch.from_numpy(backgrounds(np.random.default_rng(1), 4, SIDE_PX)).permute(0, 3, 1, 2)


def test_rough_masks_are_rough_but_mean_the_object(banks: list[Bank], photos: torch.Tensor) -> None:
    image, mask, rough = examples(banks[:2], banks[2], photos, 24, Random(0))
    assert image.shape[1:] == (3, SIDE_PX, SIDE_PX) and mask.shape == rough.shape
    assert rough.min() >= 0 and rough.max() <= 1
    assert 0.4 < overlap(rough[:, 0] > 0.5, mask[:, 0] > 0.5) < 0.9
    again = [corrupted(mask, image, Random(5)) for _ in range(2)]
    assert torch.equal(*again)
    assert not torch.equal(again[0], corrupted(mask, image, Random(6)))


def test_the_loss_asks_for_the_outline() -> None:
    mask = torch.zeros(1, 32, 32)
    mask[:, 8:24, 8:24] = 1
    right = 8 * (2 * mask - 1)
    inside, beside = right.clone(), right.clone()
    beside[:, 7, 8:24] = 8.0  # sixteen pixels too many, on the outline
    inside[:, 0, 8:24] = 8.0  # as many far off
    assert refining_loss(right, mask) < 0.02
    assert refining_loss(beside, mask) > 2 * refining_loss(inside, mask)


def test_a_run_goes_on_where_it_stopped_and_exports(banks: list[Bank], photos: torch.Tensor, tmp_path: Path) -> None:
    torch.manual_seed(0)
    begun = Network()
    keep(tmp_path / "state.safetensors", begun, torch.nn.ModuleList())
    for _ in range(2):
        train(banks[:2], banks[2], photos, tmp_path / "out", tmp_path / "state.safetensors", 2, 0, batch=2, total=4)
    refiner = averaged_refiner(tmp_path / "out" / "refine.safetensors")
    assert not torch.equal(refiner.trunk.stem[0].weight, begun.stem[0].weight)
    fresh = train(banks[:2], banks[2], photos, tmp_path / "new", tmp_path / "state.safetensors", 2, 0, batch=2, total=4)
    assert not torch.equal(refiner.head.weight, fresh.head.weight)  # two steps are not four
    refiner = copy.deepcopy(refiner).eval()
    session = onnxruntime.InferenceSession(refiner_model(refiner, {"made_by": "a test"}).SerializeToString())
    x = torch.randn(2, 4, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        np.testing.assert_allclose(session.run(["logit"], {"input": x.numpy()})[0][:, 0], refiner(x), atol=0.02)


def test_it_begins_as_the_mean_of_the_categories_masks() -> None:
    torch.manual_seed(0)
    network = Network().eval()
    refiner = Refiner.from_categories(network.state_dict()).eval()
    with torch.no_grad():
        refiner.head.weight[:, :, [0, 0, 0, 1, 1, 2, 2, 2], [0, 1, 2, 0, 2, 0, 1, 2]] = 0
        refiner.head.weight[:, :, 1, 1] = network.mask.weight.mean(0)[None, :, 0, 0]
        x = torch.randn(1, 4, 32, 48, generator=torch.Generator().manual_seed(1))
        np.testing.assert_allclose(refiner(x)[:, ::2, ::2], network(x)["mask"].mean(1), atol=1e-4)
