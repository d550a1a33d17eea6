"""Options of the export: what is shown at rest, who moves, names, formats, sizes; and what Blender makes of the GLB."""

import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.blender import TOLERANCE, compare
from pipeline import BadInput, Folder, Run
from stages import export as stage_module
from stages import formats
from stages.export import ExportSettings, export
from tests.stages.articulated_chain import Chain, write_inputs
from tests.stages.glb_reader import Glb

SETTINGS = ExportSettings(resolution=48, faces=900, texture_px=64, video_side_px=32, turntable_frames=2, formats=())
NAMES = ["a", "b 2"]
FRAMES = 6


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Chain, Path, dict[str, dict[str, Folder]]]:
    """A chain of four bones in two videos, as the stages before leave it."""
    model, root = Chain(NAMES, bones=4), tmp_path_factory.mktemp("inputs")
    made = write_inputs(model, root, FRAMES)
    return model, root, {kind: {n: Folder(p) for n, p in paths.items()} for kind, paths in made.items()}


class Exporter:
    """Exports the chain with some settings changed."""

    def __init__(self, inputs: tuple[Chain, Path, dict[str, dict[str, Folder]]], tmp_path: Path) -> None:
        self.model, self.root, self.folders = inputs
        self.tmp_path, self.count = tmp_path, 0

    def __call__(self, **changes: object) -> Path:
        self.count += 1
        out = self.tmp_path / f"out-{self.count}"
        out.mkdir()
        folders = self.folders["frames"], self.folders["masks"], self.folders["features"]
        settings = dataclasses.replace(SETTINGS, **changes)  # type: ignore[arg-type]
        export(Folder(self.root / "refine"), *folders, Folder(self.root / "poses"), settings, out, Run())
        stage_module._check(out, self.folders["frames"], settings)
        return out


@pytest.fixture
def exported(
    inputs: tuple[Chain, Path, dict[str, dict[str, Folder]]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Exporter:
    monkeypatch.setattr(formats, "read_model", lambda folder: ({}, {}))
    monkeypatch.setattr(stage_module.Banmo, "restore", staticmethod(lambda tensors, description: inputs[0]))
    return Exporter(inputs, tmp_path)


def glb_of(folder: Path) -> Glb:
    return Glb((folder / "model.glb").read_bytes())


def node_named(glb: Glb, name: str) -> int:
    return next(i for i, node in enumerate(glb.document["nodes"]) if node.get("name") == name)


# --------------------------------------------------------------------------------------------- rest pose


def test_a_frame_can_be_the_pose_at_rest(exported: Exporter) -> None:
    """The file shows that frame while nothing plays, and the clips are as exact as ever."""
    out = exported(rest_frame="b 2:3")
    glb = glb_of(out)
    position = torch.from_numpy(glb.attribute("POSITION").copy())
    time_s = torch.from_numpy(formats.read_clip(exported.folders["frames"]["b 2"].path).source_time_s)
    posed = exported.model.forward_warp(position, 1, time_s).double().numpy()
    np.testing.assert_allclose(glb.skinned(None, 0), posed[3], atol=2e-3)
    root = node_named(glb, "root_motion")
    np.testing.assert_allclose(glb.skinned(1, 5, leave_out=(root,)), posed[5], atol=1e-3)
    rest = np.asarray(trimesh.load(out / "rest.ply", process=False).vertices)
    own = np.asarray(trimesh.load(out / "meshes" / "b 2" / "00003.ply", process=False).vertices)
    np.testing.assert_allclose(rest, own, atol=2e-3)


def test_the_mean_pose_lies_between(exported: Exporter) -> None:
    glb = glb_of(exported(rest_frame="mean"))
    local = glb.locals_at(None, 0)
    for joint in glb.document["skins"][0]["joints"]:
        seen = np.stack([glb.locals_at(k, f)[joint] for k in range(2) for f in range(FRAMES)])
        angle = np.arctan2(seen[:, 1, 0], seen[:, 0, 0])  # the chain bends about z alone
        mean = np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
        assert np.arctan2(local[joint, 1, 0], local[joint, 0, 0]) == pytest.approx(mean, abs=1e-3)


@pytest.mark.parametrize("wrong", ["b 2", "c:0", "a:6", "a:-1", "a:x"])
def test_a_rest_frame_that_is_none_is_refused(wrong: str, exported: Exporter) -> None:
    with pytest.raises(BadInput, match="rest_frame"):
        exported(rest_frame=wrong)


# --------------------------------------------------------------------------------------------- root motion


def test_the_root_motion_can_be_the_cameras(exported: Exporter) -> None:
    """The object stays, the camera goes round it; what the camera sees is the same."""
    moved, fixed = glb_of(exported()), glb_of(exported(root_motion="camera"))
    camera, root = node_named(fixed, "camera_a"), node_named(fixed, "root_motion")
    for key in (0, 4):
        scene_from_camera = fixed.globals_of(fixed.locals_at(0, key))[camera]
        points = fixed.skinned(0, key)
        np.testing.assert_allclose(points, moved.skinned(0, key, leave_out=(root,)), atol=1e-5)
        seen = (points - scene_from_camera[:3, 3]) @ scene_from_camera[:3, :3]
        np.testing.assert_allclose(seen, moved.skinned(0, key), atol=1e-4)


def test_the_root_motion_can_be_left_out(exported: Exporter) -> None:
    glb = glb_of(exported(root_motion="none"))
    joints = set(glb.document["skins"][0]["joints"])
    for animation in glb.document["animations"]:
        assert {c["target"]["node"] for c in animation["channels"]} == joints


# --------------------------------------------------------------------------------------------- names, seen, files


def test_what_was_seen_is_in_the_file(exported: Exporter) -> None:
    out = exported()
    seen = glb_of(out).attribute("_SEEN")[:, 0]
    assert seen.min() == 0 and 0.2 < seen.max() <= 1
    report = formats.read_json(out / "quality.json")
    views = np.array(report["views_per_vertex"])
    assert len(views) == report["vertices"]
    assert (seen == 0).any() == (views == 0).any()
    rest = trimesh.load(out / "rest.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(rest["views"].ravel(), views)
    assert rest["filled"].sum() == report["holes_closed"]
    video = report["videos"]["a"]
    assert 0 <= video["unexplained_mask_area"] < 0.05 and 0 <= report["unexplained_mask_area"] < 0.05


def test_joints_are_named_where_the_body_is_known(exported: Exporter) -> None:
    plain = [b["name"] for b in formats.read_json(exported() / "bones.json")["bones"]]
    assert all(name.startswith("bone_") for name in plain)
    out = exported(category="quadruped")
    named = [b["name"] for b in formats.read_json(out / "bones.json")["bones"]]
    assert len(set(named)) == 4 and any(name.startswith("leg_") for name in named)
    glb = glb_of(out)
    assert [glb.document["nodes"][j]["name"] for j in glb.document["skins"][0]["joints"]] == named


def test_the_features_category_names_joints_where_poses_are_trusted(exported: Exporter) -> None:
    folders = {n: exported.tmp_path / str(k) for k, n in enumerate(NAMES)}
    for name, folder in folders.items():
        shutil.copytree(exported.folders["features"][name].path, folder)
        formats.write_json(folder / "features.json", {"category": "quadruped"})
    exported.folders = {**exported.folders, "features": {n: Folder(p) for n, p in folders.items()}}
    names = [b["name"] for b in formats.read_json(exported() / "bones.json")["bones"]]
    assert any(name.startswith("leg_") for name in names)
    assert stage_module._category(exported.folders["features"], 0.2) == "", "axes that mean nothing give no names"
    formats.write_json(folders["a"] / "features.json", {"category": "human"})
    assert stage_module._category(exported.folders["features"], 0.9) == "", "the videos disagree"


def test_frame_meshes_take_the_faces_they_are_given(exported: Exporter) -> None:
    out = exported(frame_mesh_faces=200)
    coarse = trimesh.load(out / "meshes" / "a" / "00002.ply", process=False)
    assert len(coarse.faces) <= 200
    whole = exported()
    fine = trimesh.load(whole / "meshes" / "a" / "00002.ply", process=False)
    apart = np.linalg.norm(np.asarray(fine.vertices)[None] - np.asarray(coarse.vertices)[:, None], axis=-1).min(axis=1)
    assert apart.max() < 1e-6, "its vertices are some of the fine mesh's"


def test_only_the_formats_asked_for_are_written(exported: Exporter) -> None:
    made = {p.name for p in exported().iterdir()}
    assert not made & {"model.usdz", "rest.obj", "motion", "colmap"}
    made = {p.name for p in exported(formats=("obj", "usdz", "bvh", "colmap")).iterdir()}
    assert made >= {"model.usdz", "rest.obj", "rest.mtl", "texture.png", "motion", "colmap"}
    with pytest.raises(BadInput, match="'fbx' is none of obj"):
        exported(formats=("fbx",))


def test_pymeshlab_is_used_where_asked_and_told_where_missing(
    exported: Exporter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(BadInput, match="pymeshlab is not installed"):
        exported(cleaner="pymeshlab")
    monkeypatch.delitem(sys.modules, "pymeshlab")
    pytest.importorskip("pymeshlab")
    assert trimesh.load(exported(cleaner="pymeshlab") / "rest.ply").is_watertight


def test_the_object_file_is_the_surface_at_rest(exported: Exporter) -> None:
    out = exported(formats=("obj",))
    mesh = trimesh.load(out / "rest.obj", process=False, force="mesh")
    rest = trimesh.load(out / "rest.ply", process=False)
    own, known = np.asarray(mesh.vertices), np.asarray(rest.vertices)
    apart = np.linalg.norm(own[:, None] - known[None], axis=-1)
    assert apart.min(axis=1).max() < 1e-5 and apart.min(axis=0).max() < 1e-5
    assert len(mesh.faces) == len(rest.faces)
    assert mesh.visual.kind == "texture" and mesh.visual.material.image.size == (64, 64)


# --------------------------------------------------------------------------------------------- Blender


def python_with_blender() -> Path:
    """An interpreter that can import bpy; skips the test where none is known."""
    named = os.environ.get("BANMO_BLENDER_PYTHON", sys.executable)
    tried = subprocess.run([named, "-c", "import bpy"], capture_output=True)
    if tried.returncode:
        pytest.skip("needs Blender: `pip install bpy` in an environment, its python in BANMO_BLENDER_PYTHON")
    return Path(named)


def test_blender_shows_what_we_mean(exported: Exporter) -> None:
    interpreter = python_with_blender()
    out = exported()
    facts, clips = compare(out, interpreter, moments=FRAMES)
    bones = formats.read_json(out / "bones.json")["bones"]
    assert facts["bones"] == {b["name"]: b["parent"] for b in bones}
    assert facts["cameras"] == [f"camera_{n}" for n in NAMES]
    assert "_SEEN" in facts["attributes"] and facts["images"] == [[64, 64]]
    assert [c.name for c in clips] == NAMES
    for clip in clips:
        assert clip.seconds == pytest.approx(clip.expected_s, abs=2e-3)
        assert clip.error < TOLERANCE
