"""GLB and BVH as motion: read back what was written, carry it to another skeleton, refuse what is damaged."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.animating.adding import NewMotion, add_motion, pack_glb
from stages.animating.bvh import BvhError, read_bvh
from stages.animating.glb import GlbError, read_glb, split_glb
from stages.animating.playing import Player
from stages.animating.transfer import (
    NoPartners,
    local_of,
    motion_of_bvh,
    motion_of_glb,
    partners,
    plain_name,
    skeleton_of,
    transfer,
)
from stages.meshing import gltf, textfiles
from stages.meshing.skeleton import Skeleton

NAMES = ["spine_1", "neck", "leg_front_left_1", "leg_front_left_2"]
PARENT = np.array([-1, 0, 0, 2])
PLACES = np.array([[0.0, 0.5, 0.0], [0.0, 0.7, 0.6], [0.2, 0.4, 0.4], [0.2, 0.1, 0.4]])
TIMES = np.arange(6) / 10


def skeleton(scale: float = 1.0) -> Skeleton:
    rest = np.repeat(np.eye(4)[None], 4, axis=0)
    rest[:, :3, 3] = PLACES * scale
    return Skeleton(list(NAMES), np.arange(4), PARENT, rest, (PLACES + np.array([0, 0.05, 0])) * scale)


def wiggle(bones: Skeleton, seed: int = 0, slip: float = 0.02) -> np.ndarray:
    """object_from_joint (T, B, 4, 4): smooth turns of every joint, and a little slipping."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=(4, 3))
    phase = np.linspace(0, 1, len(TIMES))
    local = np.repeat(bones.local(bones.rest)[None], len(TIMES), axis=0)
    for j in range(4):
        turn = Rotation.from_rotvec(0.8 * np.sin(2 * np.pi * phase[:, None] + j) * axis[j]).as_matrix()
        local[:, j, :3, :3] = turn
        local[:, j, :3, 3] += slip * np.sin(5 * phase[:, None] + axis[j])
    posed = local.copy()
    for j, p in enumerate(PARENT):
        if p >= 0:
            posed[:, j] = posed[:, p] @ local[:, j]
    return posed


def cameras() -> np.ndarray:
    poses = np.repeat(np.eye(4)[None], len(TIMES), axis=0)
    poses[:, :3, :3] = Rotation.from_euler("y", np.linspace(0, 90, len(TIMES))[:, None], degrees=True).as_matrix()
    poses[:, :3, 3] = [0.1, -0.2, 3.0]
    return poses


def glb_bytes(joints: np.ndarray | None = None) -> bytes:
    vertices = np.concatenate([PLACES, PLACES + np.array([0.05, 0, 0]), PLACES + np.array([0, 0, 0.05])])
    faces = np.array([[i, i + 4, i + 8] for i in range(4)])
    weight = np.tile([[0.75, 0.25]], (12, 1))
    joint = np.stack([np.tile(np.arange(4), 3), np.maximum(np.tile(PARENT, 3), 0)], axis=1)
    mesh = gltf.RiggedMesh("m", vertices, np.tile([[0, 1.0, 0]], (12, 1)), faces, np.full((12, 3), 0.5), joint, weight)
    k = np.array([[80.0, 0, 32], [0, 80, 24], [0, 0, 1]])
    clip = gltf.ClipMotion("walk", TIMES + 5, wiggle(skeleton()) if joints is None else joints, cameras(), k, 64, 48)
    return gltf.write_glb(mesh, skeleton(), [clip], {})


def test_a_glb_plays_what_was_written() -> None:
    glb = read_glb(glb_bytes())
    walk = glb.animation("walk")
    np.testing.assert_allclose(walk.time_s, TIMES, atol=1e-6)
    player = Player.of(glb)
    places, parent = player.bones(player.scene(walk, walk.time_s, root_motion=False))
    np.testing.assert_allclose(places, wiggle(skeleton())[:, :, :3, 3], atol=1e-5)
    assert parent.tolist() == PARENT.tolist()
    # With the root motion, the same places stand before the clip's camera, in glTF's axes.
    moved, _ = player.bones(player.scene(walk, walk.time_s))
    camera = np.einsum("tij,tbj->tbi", cameras()[:, :3, :3], places) + cameras()[:, None, :3, 3]
    np.testing.assert_allclose(moved, camera * [1, -1, -1], atol=1e-5)


def test_the_surface_is_blended_as_the_skin_says() -> None:
    glb = read_glb(glb_bytes())
    player = Player.of(glb)
    scene = player.scene(glb.animation("walk"), np.array([TIMES[3]]), root_motion=False)
    joints, rest = wiggle(skeleton())[3], skeleton().rest
    expected = np.zeros((12, 3))
    for v in range(12):
        for k in range(player.joint.shape[1]):
            bone = joints[player.joint[v, k]] @ np.linalg.inv(rest[player.joint[v, k]])
            expected[v] += player.weight[v, k] * (bone[:3, :3] @ player.vertices[v] + bone[:3, 3])
    np.testing.assert_allclose(player.surface(scene)[0], expected, atol=1e-5)
    np.testing.assert_allclose(player.colour, 0.5, atol=1e-3)


def test_between_keys_rotations_take_the_short_way() -> None:
    glb = read_glb(glb_bytes())
    local = glb.locals_at(glb.animation("walk"), np.array([0.05]))[0]
    turns = local[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (len(turns), 1, 1)), atol=1e-6)
    whole = glb.locals_at(glb.animation("walk"), TIMES[:2])
    node = glb.joints()[2]
    a, b, m = (Rotation.from_matrix(x[node, :3, :3]) for x in (whole[0], whole[1], local))
    assert (a.inv() * m).magnitude() == pytest.approx((a.inv() * b).magnitude() / 2, abs=1e-5)


def test_an_added_motion_stands_beside_the_old_ones() -> None:
    data = glb_bytes()
    nodes, parent, rest = skeleton_of(read_glb(data))
    posed = wiggle(skeleton(), seed=3)
    local = local_of(posed, parent)
    motion = NewMotion("dance", TIMES, {n: local[:, j] for j, n in enumerate(nodes)}, {"a": 1})
    made = read_glb(add_motion(data, motion))
    assert [a.name for a in made.animations] == ["walk", "dance"]
    np.testing.assert_allclose(rest[:, :3, 3], PLACES, atol=1e-6)
    player = Player.of(made)
    np.testing.assert_allclose(
        player.bones(player.scene(made.animation("dance"), TIMES, root_motion=False))[0], posed[..., :3, 3], atol=1e-5
    )
    old, new = read_glb(data).animation("walk"), made.animation("walk")
    for before, after in zip(old.tracks, new.tracks, strict=True):
        np.testing.assert_array_equal(before.values, after.values)
    twice = read_glb(add_motion(add_motion(data, motion), motion))
    assert [a.name for a in twice.animations] == ["walk", "dance"], "one of the same name is replaced"
    with pytest.raises(GlbError, match="increase"):
        add_motion(data, NewMotion("x", TIMES[::-1], {}))


def test_a_bvh_reads_back_as_it_was_written() -> None:
    joints = wiggle(skeleton())
    world = gltf.GL_FROM_CV @ cameras()
    motion = motion_of_bvh(read_bvh(textfiles.write_bvh(skeleton(), joints, world, TIMES)))
    assert motion.root is not None
    order = [motion.names.index(n) for n in NAMES]
    np.testing.assert_allclose(motion.posed[:, order], joints, atol=1e-4)
    np.testing.assert_allclose(motion.rest[order], skeleton().rest, atol=1e-5)
    np.testing.assert_allclose(motion.root, world, atol=1e-4)
    np.testing.assert_allclose(motion.time_s, TIMES, atol=1e-6)


def test_a_motion_carried_to_its_own_skeleton_is_itself() -> None:
    joints = wiggle(skeleton())
    glb = read_glb(glb_bytes(joints))
    source = motion_of_glb(glb, glb.animation("walk"))
    pairs = partners(NAMES, source.names)
    np.testing.assert_allclose(transfer(source, skeleton().rest, PARENT.tolist(), pairs), joints, atol=1e-5)
    np.testing.assert_allclose(source.root, gltf.GL_FROM_CV @ cameras(), atol=1e-5)


def test_a_larger_skeleton_takes_over_turns_and_scaled_shifts() -> None:
    joints = wiggle(skeleton())
    glb = read_glb(glb_bytes(joints))
    source = motion_of_glb(glb, glb.animation("walk"))
    large = transfer(source, skeleton(2.0).rest, PARENT.tolist(), partners(NAMES, source.names))
    np.testing.assert_allclose(large[..., :3, :3], joints[..., :3, :3], atol=1e-5)
    np.testing.assert_allclose(large[..., :3, 3], 2 * joints[..., :3, 3], atol=1e-5)


def test_a_joint_without_a_partner_stays_rigid_with_its_parent() -> None:
    joints = wiggle(skeleton(), slip=0.0)
    glb = read_glb(glb_bytes(joints))
    source = motion_of_glb(glb, glb.animation("walk"))
    pairs = {j: k for j, k in partners(NAMES, source.names).items() if NAMES[j] != "leg_front_left_2"}
    local = local_of(transfer(source, skeleton().rest, PARENT.tolist(), pairs), PARENT.tolist())
    np.testing.assert_allclose(local[:, 3], np.repeat(local[:1, 3], len(TIMES), axis=0), atol=1e-6)


def test_names_find_their_partners_whatever_the_spelling() -> None:
    assert plain_name("mixamorig:Left_Leg.01") == "leftleg1" == plain_name("left-leg-1")
    assert partners(["Spine_01"], ["Armature|spine1", "x"]) == {0: 0}
    assert partners(NAMES, ["Hips"], {"spine_1": "Hips"}) == {0: 0}
    for named, word in (({"tail": "Hips"}, "tail"), ({"neck": "Head"}, "Head")):
        with pytest.raises(NoPartners, match=word):
            partners(NAMES, ["Hips"], named)
    with pytest.raises(NoPartners, match="Hips"):
        partners(NAMES, ["Hips"])


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "not a BVH"),
        ("HIERARCHY\nROOT a\n{\nOFFSET 0 0\n}\nMOTION\n", "OFFSET"),
        ("HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 2 Xrotation\n}\nMOTION\n", "CHANNELS"),
        ("HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nMOTION\n", "inside"),
        (
            "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n}\nMOTION\nFrames: 2\nFrame Time: 0.1\n1\n",
            "numbers",
        ),
        (
            "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n}\nMOTION\nFrames: 1\nFrame Time: 0.1\nnan\n",
            "finite",
        ),
        (
            "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n}\nMOTION\nFrames: 1\nFrame Time: 0\n1\n",
            "cannot be",
        ),
        ("HIERARCHY\nBONE a\nMOTION\n", "understood"),
    ],
)
def test_a_wrong_bvh_is_refused_with_a_sentence(text: str, word: str) -> None:
    with pytest.raises(BvhError, match=word):
        read_bvh(text)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_files_raise_their_own_error(data: st.DataObject) -> None:
    good = glb_bytes()
    bad = bytearray(good)
    for _ in range(data.draw(st.integers(1, 6))):
        bad[data.draw(st.integers(0, len(bad) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(0, len(bad)))
    for candidate in (bytes(bad), good[:end]):
        try:
            glb = read_glb(candidate)
            player = Player.of(glb)
            player.surface(player.scene(glb.animations[0] if glb.animations else None, np.array([0.1])))
        except (GlbError, ValueError) as error:
            assert str(error)
    text = textfiles.write_bvh(skeleton(), wiggle(skeleton()), cameras(), TIMES)
    cut = data.draw(st.integers(0, len(text)))
    try:
        read_bvh(text[:cut] + data.draw(st.text(max_size=8)) + text[cut + data.draw(st.integers(0, 20)) :])
    except BvhError as error:
        assert str(error)


def test_hostile_trees_are_refused() -> None:
    document, blob = split_glb(glb_bytes())
    for children, word in (
        (lambda n: n[3].update(children=[2]), "tree|circle"),
        (lambda n: n[2].update(children=[99]), "not there"),
    ):
        copy = json.loads(json.dumps(document))
        children(copy["nodes"])
        with pytest.raises(GlbError, match=word):
            read_glb(pack_glb(copy, blob))
    copy = json.loads(json.dumps(document))
    copy["buffers"][0]["uri"] = "http://example.org/x.bin"
    with pytest.raises(GlbError, match="outside"):
        read_glb(pack_glb(copy, blob))
    with pytest.raises(GlbError, match="cut off"):
        read_glb(struct.pack("<4sIII4s", b"glTF", 2, 2**31, 2**31 - 64, b"JSON"))
