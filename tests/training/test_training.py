"""Training: banks and pictures that repeat, losses with known answers, ONNX files that say what torch says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from synthetic.backgrounds import backgrounds
from synthetic.bank import NOTHING, PARTS, SIDE_PX, Shard, random_body, render_views, view_rotation
from synthetic.bank import main as write_bank
from synthetic.canonical import Carrier, canonical_body
from training.dressing import dress
from training.export import export, shared_of
from training.losses import (
    Surface,
    imperfect,
    mask_loss,
    network_input,
    view_blocks,
    view_loss,
    view_targets,
)
from training.network import AZIMUTH_DEG, CATEGORIES, ELEVATION_DEG, INPUT_PX, ROLL_DEG, Network
from training.train import load_bank, read_state, train
from training.wardrobe import Bank, Random


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bank")
    for category in (*CATEGORIES, "thing"):
        write_bank(out, category, bodies=1, views=6, seed=3)
    return out


@pytest.fixture(scope="module")
def banks(folder: Path) -> list[Bank]:
    return [load_bank(folder, name) for name in (*CATEGORIES, "thing")]


@pytest.fixture(scope="module")
def photos() -> torch.Tensor:
    return torch.from_numpy(backgrounds(np.random.default_rng(1), 6)).permute(0, 3, 1, 2)


def test_a_bank_repeats(folder: Path, tmp_path: Path) -> None:
    write_bank(tmp_path, "human", bodies=1, views=6, seed=3)
    first, again = (Shard.load(f / "human-0000.npz") for f in (folder, tmp_path))
    assert all((vars(first)[name] == vars(again)[name]).all() for name in vars(first))
    write_bank(tmp_path, "human", bodies=1, views=6, seed=4)
    assert (Shard.load(tmp_path / "human-0000.npz").vertex != first.vertex).any()


def test_renderings_agree_with_their_labels() -> None:
    """A pixel's canonical vertex and part belong together; the object fills the picture and stands the right way."""
    rng = np.random.default_rng(2)
    body, canonical = random_body(rng, "quadruped"), canonical_body("quadruped")
    shard = render_views(body, "quadruped", Carrier.of(canonical).labels(body), 8, rng)
    on = shard.vertex != NOTHING
    for picture in on:
        rows, columns = np.nonzero(picture)
        longest = max(np.ptp(rows), np.ptp(columns)) + 1
        assert 0.85 * SIDE_PX < longest <= SIDE_PX
    names = PARTS["quadruped"]
    tail = on & np.isin(shard.part, [names.index("tail"), names.index("tail_tip")])
    muzzle = on & (shard.part == names.index("muzzle"))
    assert canonical.vertices[shard.vertex[tail], 2].max() < 0 < canonical.vertices[shard.vertex[muzzle], 2].min()
    assert (shard.normal[..., 2][on] < 20).mean() > 0.98, "what is seen faces the camera"
    for rotation, angles in zip(shard.rotation, shard.view, strict=True):
        np.testing.assert_allclose(view_rotation(*(float(a) for a in angles)), rotation, atol=1e-5)


def test_dressing_repeats_and_mirrors(banks: list[Bank], photos: torch.Tensor) -> None:
    first, again, other = (dress(banks[:2], banks[2], photos, 12, Random(seed)) for seed in (5, 5, 6))
    for a, b, c in zip(first, again, other, strict=True):
        assert (a.image == b.image).all() and (a.label == b.label).all() and (a.image != c.image).any()
        assert a.image.shape == (12, 3, INPUT_PX, INPUT_PX) and a.image.min() >= 0 and a.image.max() <= 1
        assert not a.mask[~a.present].any() or (a.mask[~a.present].mean((1, 2, 3)) < 0.02).all()
        labelled = torch.nn.functional.interpolate(a.mask, a.label.shape[1:], mode="area")[:, 0]
        assert (labelled[a.label >= 0] > 0.2).float().mean() > 0.95, "labels lie on the object"
    # Seen from its own left the animal shows left vertices, in a mirrored picture too.
    draw = Random(0)
    sides = []
    for _ in range(6):
        batch = dress(banks[:1], banks[2], photos, 16, draw)[0]
        for label, view, ok in zip(batch.label, batch.view, batch.present, strict=True):
            if ok and (label >= 0).sum() > 20 and float(view[0].sin().abs()) > 0.9:
                side = banks[0].rest[label[label >= 0], 0].mean()
                sides.append(float(side * -view[0].sign()))
    assert len(sides) > 5 and np.mean(np.array(sides) > 0) > 0.9


def test_view_targets_peak_at_their_bins() -> None:
    view = torch.deg2rad(torch.tensor([[179.0, 32.0, -4.0], [-95.0, -60.0, 80.0]]))
    azimuth, elevation, roll = view_blocks(view_targets(view))
    for block in (azimuth, elevation, roll):
        torch.testing.assert_close(block.sum(1), torch.ones(2))
    assert AZIMUTH_DEG[int(azimuth[0].argmax())] == 175 and azimuth[0, 0] > 0.2, "it goes round"
    assert AZIMUTH_DEG[int(azimuth[1].argmax())] == -95
    assert [ELEVATION_DEG[int(i)] for i in elevation.argmax(1)] == [35, -25]
    assert [ROLL_DEG[int(i)] for i in roll.argmax(1)] == [-3.75, 41.25]
    right, wrong = (view_targets(v).clamp_min(1e-6).log() for v in (view, view + 1.0))
    present = torch.tensor([True, True])
    assert view_loss(right, view, present) < view_loss(wrong, view, present) - 1
    assert view_loss(right, view, ~present) == 0


def test_mask_loss_is_least_for_the_truth() -> None:
    mask = torch.zeros(2, 1, 32, 32)
    mask[:, :, 8:24, 4:20] = 1
    logits = (torch.nn.functional.avg_pool2d(mask, 2)[:, 0] - 0.5) * 20
    assert mask_loss(logits, mask) < 0.05 < 1.0 < mask_loss(-logits, mask)


def test_prompts_are_imperfect_but_near(banks: list[Bank], photos: torch.Tensor) -> None:
    batch = dress(banks[:1], banks[2], photos, 24, Random(1))[0]
    batch.shown[0] = 0
    rough = imperfect(batch.shown, Random(2))
    large = batch.shown.mean((1, 2, 3)) > 0.1
    shared = (rough * batch.shown).sum((1, 2, 3)) / torch.maximum(rough, batch.shown).sum((1, 2, 3))
    assert (rough != batch.shown).any() and shared[large].median() > 0.7
    inputs = network_input(batch, Random(3), torch.ones(24, dtype=torch.bool))
    shown = batch.shown.amax((1, 2, 3)) > 0
    off = (inputs[:, 3:] == 0).expand(-1, 3, -1, -1)
    assert not inputs[shown][:, :3][off[shown]].any(), "the picture is taken off where the mask is not"
    assert not inputs[~shown, 3].any() and inputs[~shown, :3].any(), "nothing to show, nothing taken off"


def test_surface_learns_to_place() -> None:
    """Gradient steps on the embedding alone lower the loss of pixels that already know their vertex."""
    body = canonical_body("quadruped")
    basis = np.cos(body.vertices @ np.random.default_rng(0).normal(size=(3, 24)) * 2)
    surface = Surface(body.vertices, basis, 0)
    label = torch.randint(len(body.vertices), (2, 6, 6), generator=torch.Generator().manual_seed(0))
    losses = []
    optimiser = torch.optim.Adam(surface.parameters(), 0.02)
    for k in range(12):
        embedded = surface.embedding()[label].permute(0, 3, 1, 2)
        loss = surface.loss(embedded, label, Random(k))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] - 0.05
    assert surface.loss(embedded, torch.full_like(label, -1), Random(0)) == 0


def test_a_short_training_repeats_learns_and_is_written_as_onnx(
    banks: list[Bank], photos: torch.Tensor, tmp_path: Path
) -> None:
    networks = [train(banks[:2], banks[2], photos, tmp_path / n, 1.0, 0, batch=4, steps=3)[0] for n in "ab"]
    for a, b in zip(networks[0].state_dict().values(), networks[1].state_dict().values(), strict=True):
        assert torch.equal(a, b)
    (tmp_path / "a" / "log.jsonl").write_text(json.dumps({"step": 3, "pictures": 24}) + "\n", encoding="utf-8")
    digests = export(tmp_path / "a" / "state.safetensors", tmp_path / "out", {"made_by": "a test"})
    kinds = [f"{kind}-{name}.onnx" for kind in ("cse", "posenet") for name in CATEGORIES]
    assert set(digests) == {*kinds, *(f"{name}.npz" for name in CATEGORIES), "trunk.onnx", "finder.onnx"}
    network = Network().eval()
    network.load_state_dict(read_state(tmp_path / "a" / "state.safetensors")["network"])
    x = torch.randn(2, 4, INPUT_PX, INPUT_PX, generator=torch.Generator().manual_seed(0))
    wide = torch.randn(1, 3, 64, 128, generator=torch.Generator().manual_seed(1))
    finder = onnxruntime.InferenceSession((tmp_path / "out" / "finder.onnx").read_bytes())
    with torch.no_grad():
        out, alone = network(x), network(torch.cat([wide, torch.zeros(1, 1, 64, 128)], 1))
        for k, name in enumerate(CATEGORIES):
            session = onnxruntime.InferenceSession((tmp_path / "out" / f"posenet-{name}.onnx").read_bytes())
            view, dense, category = session.run(["view", "dense", "category"], {"input": x.numpy()})
            near = {"atol": 4e-3, "rtol": 4e-3}  # weights are kept in half precision
            np.testing.assert_allclose(view, network.look(out["coarse"], k), **near)
            np.testing.assert_allclose(dense[:, 0], out["mask"][:, k], **near)
            np.testing.assert_allclose(category, out["category"], **near)
            larger = torch.nn.functional.interpolate(
                network.embed(out["fine"], k), scale_factor=2, mode="bilinear", align_corners=False
            )
            np.testing.assert_allclose(dense[:, 1:], torch.nn.functional.normalize(larger, dim=1), atol=0.02)
            session = onnxruntime.InferenceSession((tmp_path / "out" / f"cse-{name}.onnx").read_bytes())
            np.testing.assert_allclose(session.run(None, {"image": wide.numpy()})[0][:, 0], alone["mask"][:, k], **near)
        np.testing.assert_allclose(finder.run(None, {"image": wide.numpy()})[0], alone["mask"], **near)
    again = shared_of(tmp_path / "out" / "posenet-human.onnx", tmp_path / "shared")
    assert again == {name: digests[name] for name in again} and set(again) == {"trunk.onnx", "finder.onnx"}
