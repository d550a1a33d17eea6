"""The networks that are shipped: whole, small, and good on generated animals and people they have not seen."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest

import training
from stages import own_networks
from stages.own_networks import (
    CATEGORIES,
    WEIGHTS,
    OwnFinder,
    OwnNetwork,
    OwnRefiner,
    OwnTrunk,
    WeightsDamaged,
    canonical_surface,
)
from stages.perception.category import choose_category
from stages.perception.prior import object_priors
from stages.perception.refining import refine
from stages.perception.viewpoint import AZIMUTH_DEG, angle_log_probabilities, normalised
from stages.registration.placing import ray_rotation, view_angles
from synthetic.clips import Film, film, make_subject
from tests.stages.perception_clips import moving_clip, overlap
from training.export import shared_of

MASTERS = Path(training.__file__).parent / "masters"
SEEN_AS = {"dog": "quadruped", "person": "human"}


@pytest.fixture(scope="module", params=sorted(SEEN_AS))
def clip(request: pytest.FixtureRequest) -> Film:
    return film(make_subject(31, request.param), clip=1, clips=3, frames=8, size=128, seed=7, fps=4)


@pytest.mark.parametrize("category", CATEGORIES)
def test_files_are_small_and_as_described(category: str) -> None:
    for kind in ("cse", "posenet"):
        assert (WEIGHTS / f"{kind}-{category}.onnx").stat().st_size <= 8_000_000
    session = onnxruntime.InferenceSession((WEIGHTS / f"cse-{category}.onnx").read_bytes())
    for count, height, width in ((1, 96, 96), (2, 64, 128)):
        (dense,) = session.run(None, {"image": np.zeros((count, 3, height, width), np.float32)})
        assert dense.shape == (count, 17, height // 2, width // 2)
        np.testing.assert_allclose(np.linalg.norm(dense[:, 1:], axis=1), 1, atol=1e-3)
    assert session.get_modelmeta().custom_metadata_map["trained_on"].startswith("renderings of generated bodies")
    answer = OwnNetwork(category)(np.zeros((3, 4, 96, 96), np.float32))
    assert {k: v.shape for k, v in answer.items()} == {"view": (3, 60), "dense": (3, 17, 48, 48), "category": (3, 3)}


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_finder_sees_what_each_category_s_network_does(category: str) -> None:
    crops = np.random.default_rng(0).normal(size=(2, 4, 96, 96)).astype(np.float32)
    crops[:, 3] = 0
    dense = OwnNetwork(category)(crops)["dense"][:, 0]
    found = OwnFinder()(crops[:, :3])[:, CATEGORIES.index(category)]
    assert np.corrcoef(found.ravel(), dense.ravel())[0, 1] > 0.97  # of noise, which no network was made for
    assert OwnFinder()(np.zeros((1, 3, 64, 128), np.float32)).shape == (1, len(CATEGORIES), 32, 64)


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_vertex_is_nearest_to_itself(category: str) -> None:
    surface = canonical_surface(category)
    vertices, embedding = surface["vertices"], surface["embedding"].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(embedding, axis=1), 1, atol=1e-4)
    nearest = (embedding @ embedding.T).argmax(1)
    assert (nearest == np.arange(len(nearest))).mean() > 0.999
    # Left and right of the surface can be told apart: a vertex is not like its mirror image.
    mirrored = vertices * np.array([-1, 1, 1])
    image = ((vertices**2).sum(1)[None] - 2 * mirrored @ vertices.T).argmin(1)
    aside = np.abs(vertices[:, 0]) > 0.12
    alike = (embedding * embedding[image]).sum(1)[aside]
    neighbour = (embedding[surface["faces"][:, 0]] * embedding[surface["faces"][:, 1]]).sum(1)
    assert alike.mean() < 0.9 * neighbour.mean()


def test_networks_in_integers_say_what_the_exact_ones_do(clip: Film, tmp_path: Path) -> None:
    shared_of(WEIGHTS / "posenet-human.onnx", tmp_path)
    pictures = np.stack([normalised(x) for x in clip.images[:3]])
    rough = cv2.GaussianBlur(clip.masks[0].astype(np.float32), (0, 0), 3.0)
    masked = np.concatenate([pictures[:1], rough[None, None]], 1)
    for network, folder, given in (
        (OwnFinder(), tmp_path, pictures), (OwnTrunk(), tmp_path, pictures), (OwnRefiner(), MASTERS, masked),
    ):  # fmt: skip
        assert (WEIGHTS / network.name).stat().st_size <= 4_000_000
        session = onnxruntime.InferenceSession((folder / network.name.replace("-int8", "")).read_bytes())
        (exact,) = session.run(None, {session.get_inputs()[0].name: given})
        found = network(given).reshape(exact.shape)
        assert np.corrcoef(found.ravel(), exact.ravel())[0, 1] > 0.998
        if network.name.startswith("refine"):
            assert ((found > 0) == (exact > 0)).mean() > 0.995


def test_the_refiner_mends_what_a_rough_mask_lost(clip: Film) -> None:
    truth = clip.masks > 0.5
    rough = clip.masks.astype(np.float32).copy()
    for t, mask in enumerate(truth):
        rows = np.nonzero(mask.any(1))[0]
        rough[t, rows[-1] - (rows[-1] - rows[0]) // 8 :] = 0  # feet gone
        rough[t] = cv2.GaussianBlur(rough[t], (0, 0), 2.0)  # outline vague
    found = refine(clip.images, rough, OwnRefiner())
    assert overlap(found > 0.5, truth) > overlap(rough > 0.5, truth) + 0.03


def test_damaged_weights_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_networks, "WEIGHTS", tmp_path)
    with pytest.raises(WeightsDamaged, match="cannot be read"):
        OwnNetwork("human")
    data = bytearray((WEIGHTS / "posenet-human.onnx").read_bytes())
    data[5000] ^= 1
    (tmp_path / "posenet-human.onnx").write_bytes(data)
    with pytest.raises(WeightsDamaged, match="not the file"):
        OwnNetwork("human")


def test_views_of_an_unseen_body(clip: Film) -> None:
    """Most frames within 45 degrees, and the clip's vote within 20."""
    network = OwnNetwork(SEEN_AS[clip.name.split("-")[0]])
    masks = clip.masks.astype(np.uint8) * 255
    centre = np.array([[np.nonzero(m)[1].mean(), np.nonzero(m)[0].mean()] for m in clip.masks])
    seen = ray_rotation(centre, clip.intrinsics).transpose(0, 2, 1) @ clip.camera_from_object[:, :3, :3]
    truth = -np.rad2deg(view_angles(seen)[0])
    found = angle_log_probabilities(clip.images, masks, network)[0]
    error = (AZIMUTH_DEG[found.argmax(1)] - truth + 180) % 360 - 180
    assert (np.abs(error) < 45).mean() >= 0.6
    votes = sum(np.interp(AZIMUTH_DEG + t, AZIMUTH_DEG, row, period=360) for t, row in zip(truth, found, strict=True))
    assert abs(AZIMUTH_DEG[int(np.argmax(votes))]) <= 20


def test_a_block_is_neither() -> None:
    frames, truth, _ = moving_clip(6, 128)
    networks = {name: OwnNetwork(name) for name in CATEGORIES}
    verdict = choose_category(frames, truth.astype(np.uint8) * 255, networks)
    assert verdict.category == "other" and max(verdict.named.values()) < 0.5


def test_category_and_prior_mask_of_an_unseen_body(clip: Film) -> None:
    category = SEEN_AS[clip.name.split("-")[0]]
    masks = clip.masks.astype(np.uint8) * 255
    networks = {name: OwnNetwork(name) for name in CATEGORIES}
    assert choose_category(clip.images, masks, networks).category == category
    priors = object_priors(clip.images, OwnFinder(), {name: k for k, name in enumerate(CATEGORIES)})
    found = priors[category] > 127
    overlap = (found & clip.masks).sum((1, 2)) / (found | clip.masks).sum((1, 2))
    assert overlap.mean() > 0.6
