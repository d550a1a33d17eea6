"""A category's puppet: rest pose, stretching, fitting to a clip and to a surface, handing a motion on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.geometry.cameras import project, transform
from stages.geometry.rotations import geodesic_angle, so3_exp
from stages.own_networks import DIGESTS, WEIGHTS, WeightsDamaged
from stages.own_skeletons import own_puppet
from stages.retargeting.fitting import (
    Effort,
    Posture,
    Seen,
    Surface,
    fit_clip,
    fit_surface,
    start_rotations,
    weak_misfit,
)
from stages.retargeting.handing import hand_on, hang
from stages.retargeting.matching import ALIKE, likeness
from stages.retargeting.puppet import Puppet, skinned, vertex_turns
from stages.retargeting.seeing import look

pytestmark = pytest.mark.usefixtures("one_thread")

K = torch.tensor([[300.0, 0, 128], [0, 300.0, 128], [0, 0, 1]])
FRAMES = 8


@pytest.fixture(scope="module")
def animal() -> Puppet:
    return own_puppet("quadruped")


def side_view(count: int) -> torch.Tensor:
    """Root rotations of an animal seen from its side, turning a little."""
    upright = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    return upright @ so3_exp(torch.tensor([[0.0, 1.3 + 0.03 * i, 0.0] for i in range(count)]))


def walking(puppet: Puppet, count: int = FRAMES, lengths: float = 0.0) -> Posture:
    """A puppet whose legs swing; longer forelegs if asked."""
    turns = puppet.idle.repeat(count, 1, 1)
    for k, name in enumerate(("arm_left", "arm_right", "thigh_left", "thigh_right")):
        turns[:, puppet.names.index(name), 0] = 0.6 * torch.sin(torch.arange(count) * 0.5 + 1.5 * k)
    log_lengths = torch.zeros(len(puppet.names))
    for name in ("arm_left", "arm_right", "forearm_left", "forearm_right"):
        log_lengths[puppet.names.index(name)] = lengths
    shape = puppet.shape(log_lengths, torch.zeros(len(puppet.names)))
    shift = torch.tensor([[0.0, 0.0, 3.5]]).repeat(count, 1)
    return Posture(shape, puppet.turned(side_view(count), turns), shift, torch.zeros(count))


def seen_of(puppet: Puppet, posture: Posture, points: int = 200, noise: float = 0.0) -> Seen:
    """Vertices of the near side, with their own embeddings."""
    generator = torch.Generator().manual_seed(0)
    count = len(posture.shift)
    moved = skinned(puppet.vertices, puppet.weights, posture.transforms(puppet))
    normals = (vertex_turns(puppet.weights, posture.orientations) @ puppet.normals[..., None]).squeeze(-1)
    front = (normals * moved).sum(-1) < 0
    chosen = torch.stack(
        [torch.nonzero(f)[:, 0][torch.randperm(int(f.sum()), generator=generator)[:points]] for f in front]
    )
    features = puppet.embedding[chosen] + noise * torch.randn(count, points, 16, generator=generator)
    pixels = project(K, torch.gather(moved, 1, chosen[..., None].expand(-1, -1, 3)))
    size = (pixels.amax(1) - pixels.amin(1)).amax(1)
    return Seen(
        pixels=pixels,
        features=torch.nn.functional.normalize(features, dim=-1),
        weight=torch.ones(count, points),
        intrinsics=K,
        size_px=size,
        time_s=torch.arange(count) * 0.05,
        outside=torch.zeros(count, 16, 16),
        boxes=torch.tensor([[0.0, 0, 256, 256]]).repeat(count, 1),
    )


def limb_error_deg(puppet: Puppet, found: Posture, truth: Posture, pairs: tuple[tuple[str, str], ...]) -> float:
    here, there = (puppet.placed(p.shape, p.orientations, p.shift) for p in (found, truth))
    angles = []
    for a, b in pairs:
        i, j = puppet.names.index(a), puppet.names.index(b)
        angles.append(torch.cosine_similarity(here[:, j] - here[:, i], there[:, j] - there[:, i], dim=-1).clamp(-1, 1))
    return float(torch.rad2deg(torch.stack(angles).acos()).mean())


LEGS = (
    ("arm_left", "hand_left"),
    ("arm_right", "hand_right"),
    ("thigh_left", "foot_left"),
    ("thigh_right", "foot_right"),
)


@pytest.mark.parametrize("category", ["quadruped", "human"])
def test_at_rest_the_puppet_is_the_canonical_surface(category: str) -> None:
    puppet = own_puppet(category)
    bones = len(puppet.names)
    shape = puppet.shape(torch.zeros(bones), torch.zeros(bones))
    still = puppet.turned(torch.eye(3)[None], torch.zeros(1, bones, 3))
    transforms = puppet.transforms(shape, still, puppet.joints[:1])
    torch.testing.assert_close(
        skinned(puppet.vertices, puppet.weights, transforms)[0], puppet.vertices, atol=1e-5, rtol=0
    )
    for bone, twin in enumerate(puppet.twins.tolist()):
        mirrored = puppet.joints[bone] * torch.tensor([-1.0, 1, 1])
        torch.testing.assert_close(mirrored, puppet.joints[twin], atol=0.02, rtol=0)


def test_lengthening_one_leg_lengthens_both_and_by_that_much(animal: Puppet) -> None:
    lengths = torch.zeros(len(animal.names))
    lengths[animal.names.index("forearm_left")] = 2 * np.log(1.5)  # left and right are averaged
    shape = animal.shape(lengths, torch.zeros(len(animal.names)))
    still = animal.turned(torch.eye(3)[None], torch.zeros(1, len(animal.names), 3))
    joints = animal.placed(shape, still, animal.joints[:1])[0]
    for side in ("left", "right"):
        a, b = animal.names.index(f"forearm_{side}"), animal.names.index(f"hand_{side}")
        assert float((joints[b] - joints[a]).norm()) == pytest.approx(
            1.5 * float((animal.joints[b] - animal.joints[a]).norm()), rel=2e-3
        )


def test_root_rotations_come_from_the_embedding_alone(animal: Puppet) -> None:
    truth = walking(animal)
    seen = seen_of(animal, truth, noise=0.05)
    found = start_rotations(animal, seen)
    assert float(torch.rad2deg(geodesic_angle(found, truth.orientations[:, 0])).mean()) < 15
    assert weak_misfit(animal, seen, found) < 0.5 * weak_misfit(
        animal, seen, side_view(FRAMES) @ so3_exp(torch.tensor([0.0, 1.6, 0]))
    )


def test_a_walking_animal_of_another_build_is_followed(animal: Puppet) -> None:
    truth = walking(animal, lengths=0.25)
    seen = seen_of(animal, truth, noise=0.05)
    ticks: list[int] = []
    found = fit_clip(
        animal, seen, side_view(FRAMES), Effort(rounds=6, steps=20), lambda done, total: ticks.append(total - done)
    )
    still = walking(animal)
    still = Posture(
        still.shape,
        animal.turned(side_view(FRAMES), torch.zeros(FRAMES, len(animal.names), 3)),
        still.shift,
        still.misfit,
    )
    followed, at_rest = (limb_error_deg(animal, p, truth, LEGS) for p in (found, still))
    assert at_rest > 15 and followed < 0.4 * at_rest
    length = torch.linalg.matrix_norm(found.shape, 2)
    assert length[animal.names.index("arm_left")] > 1.08 * length[animal.names.index("thigh_left")]
    assert ticks[0] == 120 and ticks[-1] == 1


def test_root_poses_that_are_held_stay(animal: Puppet) -> None:
    truth = walking(animal)
    root = side_view(FRAMES)
    found = fit_clip(animal, seen_of(animal, truth), root, Effort(rounds=2, steps=5, hold_root=True))
    torch.testing.assert_close(found.orientations[:, 0], root)


def body_of(puppet: Puppet) -> tuple[Posture, Surface]:
    """Another individual, standing with one foreleg forward, as a model's surface."""
    turns = torch.zeros(1, len(puppet.names), 3)
    turns[:, puppet.names.index("arm_left"), 0] = -0.5
    lengths = torch.zeros(len(puppet.names))
    lengths[puppet.names.index("head")] = 0.5
    rest = Posture(
        puppet.shape(lengths, lengths), puppet.turned(torch.eye(3)[None], turns), puppet.joints[:1], torch.zeros(1)
    )
    points = skinned(puppet.vertices, puppet.weights, rest.transforms(puppet))[0]
    normals = (vertex_turns(puppet.weights, rest.orientations)[0] @ puppet.normals[..., None]).squeeze(-1)
    return rest, Surface(points, torch.nn.functional.normalize(normals, dim=-1), puppet.embedding)


def test_the_puppet_finds_its_way_onto_a_model(animal: Puppet) -> None:
    truth, surface = body_of(animal)
    found = fit_surface(animal, surface, Effort(rounds=8, steps=20, rest=0.0005, learning_rate=0.03))
    assert float(found.misfit) < 0.015
    assert limb_error_deg(animal, found, truth, LEGS) < 4


def test_an_embedding_tells_whether_the_model_is_of_the_category(animal: Puppet) -> None:
    _, surface = body_of(animal)
    assert likeness(animal, surface) > 0.95
    generator = torch.Generator().manual_seed(0)
    mixed = surface.features[torch.randperm(len(surface.features), generator=generator)]
    assert likeness(animal, replace(surface, features=mixed)) < ALIKE
    assert likeness(animal, replace(surface, features=torch.zeros_like(mixed))) == 0, "fitted without features"


def test_a_motion_handed_on_turns_limbs_as_the_subject_does_at_the_models_own_lengths(animal: Puppet) -> None:
    rest, surface = body_of(animal)
    moving = walking(animal, lengths=0.25)
    weights = hang(animal, rest, surface)
    torch.testing.assert_close(weights.sum(1), torch.ones(len(weights)))
    handed = hand_on(animal, rest, moving, surface.points, weights)
    placed = transform(handed.root, handed.points)
    wanted = skinned(
        animal.vertices,
        animal.weights,
        Posture(rest.shape, moving.orientations, moving.shift, moving.misfit).transforms(animal),
    )
    # Not where the subject is, as lengths differ, but posed as the model's own puppet would be.
    gap = (placed - placed.mean(1, keepdim=True)) - (wanted - wanted.mean(1, keepdim=True))
    assert float(gap.norm(dim=-1).mean()) < 0.02
    torch.testing.assert_close(
        handed.root[:, :3, :3], moving.orientations[:, 0] @ rest.orientations[0, 0].T, atol=1e-5, rtol=0
    )


def test_frames_that_show_nothing_weigh_nothing(animal: Puppet) -> None:
    maps = np.zeros((2, 32, 32, 16), np.float16)
    maps[0, 8:24, 8:24] = animal.embedding[5].numpy()
    crops = np.array([[0.0, 0, 64, 64], [0, 0, 64, 64]])
    found = look(animal, maps, crops, np.ones(2), K.numpy(), np.arange(2.0), np.random.default_rng(0), points=32)
    assert float(found.weight[0].min()) > 0.9 and float(found.weight[1].abs().max()) == 0
    assert float(found.pixels[0].min()) >= 16 and float(found.pixels[0].max()) <= 48
    assert float(found.size_px[1]) == pytest.approx(float(found.size_px[0]))


def test_a_damaged_skeleton_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DIGESTS, "human-skeleton.npz", "0" * 64)
    with pytest.raises(WeightsDamaged, match="human-skeleton"):
        own_puppet("human")


def test_the_shipped_skeletons_are_those_of_the_generator() -> None:
    from synthetic.skeletons import skeleton_of

    for category in ("quadruped", "human"):
        with np.load(WEIGHTS / f"{category}-skeleton.npz", allow_pickle=False) as shipped:
            for name, value in skeleton_of(category).items():
                assert (
                    np.array_equal(shipped[name], value)
                    if value.dtype.kind in "Ui"
                    else np.allclose(shipped[name], value, atol=1e-3)
                )
