"""The refiner's training: rough masks that are rough, a run that goes on where it stopped, an ONNX file that agrees."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from synthetic.backgrounds import backgrounds
from synthetic.bank import main as write_bank
from training.corruption import corrupted
from training.dressing import _hidden, dress
from training.export import posenet_model, refiner_model, shared_of, trunk_model
from training.network import CATEGORIES, Network
from training.quantise import main as quantise
from training.refine import (
    Refiner,
    averaged_refiner,
    examples,
    lost_weight,
    overlap,
    refiner_input,
    refining_loss,
    train,
)
from training.revive import calibrate, revive
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


def test_pieces_that_the_rough_mask_lacks_can_weigh_more() -> None:
    mask, rough = torch.zeros(2, 1, 32, 32)
    mask[:, 8:28, 8:24] = 1
    rough[:, 8:18, 8:24] = 1  # ends three pixels and more before ...
    heavy = lost_weight(mask, rough, 8.0)
    assert (heavy[:, 21:28, 8:24] == 8).all()  # ... this piece
    assert heavy.sum() == 7 * 16 * 8 + (32 * 32 - 7 * 16)
    without = 8 * (2 * rough - 1)
    assert refining_loss(without, mask, heavy) > 1.5 * refining_loss(without, mask)
    assert refining_loss(without, mask, lost_weight(mask, rough, 1.0)) == refining_loss(without, mask)


def test_a_run_goes_on_where_it_stopped_and_exports(banks: list[Bank], photos: torch.Tensor, tmp_path: Path) -> None:
    torch.manual_seed(0)
    begun = Network()
    keep(tmp_path / "state.safetensors", begun, torch.nn.ModuleList())
    for _ in range(2):
        train(
            banks[:2],
            banks[2],
            photos,
            tmp_path / "out",
            tmp_path / "state.safetensors",
            2,
            0,
            batch=2,
            total=4,
            hide=0.5,
        )
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


def test_an_end_that_looks_like_its_background_is_hard_to_see_and_mostly_lost(
    banks: list[Bank], photos: torch.Tensor
) -> None:
    plain, hiding = (dress(banks[:2], banks[2], photos, 24, Random(2), 0.7, hide) for hide in (0.0, 1.0))
    assert all(not b.hidden.any() for b in plain)
    for batch in hiding:
        there = batch.hidden[batch.present].amax((1, 2, 3))
        assert there.mean() > 0.8  # some ends are too short to count a pixel, or behind something
    mask = torch.cat([b.mask for b in hiding])
    image = torch.cat([b.image for b in hiding])
    hidden = torch.cat([b.hidden for b in hiding]) * mask
    told, untold = (corrupted(mask, image, Random(7), h)[hidden > 0.5].mean() for h in (hidden, None))
    assert told < 0.6 * untold


def _contrast(batch_colour: torch.Tensor, back: torch.Tensor, where: torch.Tensor) -> float:
    return float(((batch_colour - back).abs().mean(1, keepdim=True) * where).sum() / where.sum())


def test_what_is_hidden_takes_the_colour_behind_it_and_keeps_its_coverage() -> None:
    colour, alpha = torch.zeros(4, 3, 64, 64), torch.zeros(4, 1, 64, 64)
    alpha[:, :, 8:56, 24:40] = 1
    colour[:, 0, 8:56, 24:40] = 0.9
    back = torch.full((4, 3, 64, 64), 0.3)
    changed, hidden = _hidden(colour, alpha, back, 1.0, Random(0))
    assert hidden.sum() > 0
    assert _contrast(changed, back, hidden) < 0.5 * _contrast(colour, back, hidden)
    assert torch.equal(changed * (1 - hidden), colour * (1 - hidden))
    assert not (changed * (1 - alpha)).any()


def test_an_exported_refiner_can_be_trained_on(banks: list[Bank], photos: torch.Tensor, tmp_path: Path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        made = Refiner()
    image, _, rough = examples(banks[:2], banks[2], photos, 8, Random(1))
    x = refiner_input(image, rough)
    made.train()
    for _ in range(40):
        made(x)  # normalisation that means something
    made.eval()
    path = tmp_path / "refine.onnx"
    path.write_bytes(refiner_model(made, {"made_by": "a test"}).SerializeToString())
    again = Refiner()
    revive(again.trunk, again.head, path)
    with torch.no_grad():
        wanted = made(x)
        np.testing.assert_allclose(again.eval()(x), wanted, atol=0.02)
        calibrate(again, [x])
        np.testing.assert_allclose(again(x), wanted, atol=0.02)
        np.testing.assert_allclose(again.train()(x), wanted, atol=0.05)  # the batch it was calibrated on
    with pytest.raises(ValueError, match="holds 0 weights"):
        path.write_bytes(onnx.ModelProto().SerializeToString())
        revive(again.trunk, again.head, path)


def test_the_trunk_cut_from_an_exported_network_sees_what_the_network_saw(tmp_path: Path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(4)
        network = Network().eval()
    whole = tmp_path / "posenet-human.onnx"
    whole.write_bytes(posenet_model(network, 1, {"made_by": "a test"}).SerializeToString())
    assert set(shared_of(whole, tmp_path)) == {"trunk.onnx", "finder.onnx"}
    name = "trunk.onnx"
    seen: list[torch.Tensor] = []
    handle = network.join8.register_forward_hook(lambda _module, _inputs, output: seen.append(output))
    image = torch.rand(2, 3, 48, 80)
    with torch.no_grad():
        network.features(torch.cat([image, torch.zeros(2, 1, 48, 80)], 1))
    handle.remove()
    cut = onnxruntime.InferenceSession(tmp_path / name)
    (features,) = cut.run(["features"], {"image": image.numpy()})
    assert features.shape == (2, 64, 6, 10)
    np.testing.assert_allclose(features, seen[0].numpy(), atol=0.01 * float(seen[0].abs().max()))
    assert onnx.load(tmp_path / name).metadata_props[0].value == "a test"
    with pytest.raises(ValueError, match="does not begin with"):
        whole.write_bytes(onnx.ModelProto().SerializeToString())
        shared_of(whole, tmp_path)


def test_networks_in_integers_say_what_they_did(tmp_path: Path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(4)
        network, refiner = Network().eval(), Refiner().eval()
    (tmp_path / "trunk.onnx").write_bytes(trunk_model(network, {"made_by": "a test"}).SerializeToString())
    (tmp_path / "refine.onnx").write_bytes(refiner_model(refiner, {"made_by": "a test"}).SerializeToString())
    quantise(tmp_path)
    assert {p.name for p in tmp_path.glob("*int8*")} == {"trunk-int8.onnx", "refine-int8.onnx"}
    for name, channels in (("trunk", 3), ("refine", 4)):
        whole, eight = tmp_path / f"{name}.onnx", tmp_path / f"{name}-int8.onnx"
        assert eight.stat().st_size < 0.6 * whole.stat().st_size
        said = {p.key: p.value for p in onnx.load(eight).metadata_props}
        assert said == {"made_by": "a test", "quantised_by": "python -m training.quantise"}
        sessions = [onnxruntime.InferenceSession(path) for path in (whole, eight)]
        given = {sessions[0].get_inputs()[0].name: torch.rand(1, channels, 64, 80).numpy()}
        exact, found = (s.run(None, given)[0].ravel() for s in sessions)
        assert np.corrcoef(exact, found)[0, 1] > 0.99
