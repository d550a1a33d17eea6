"""The export stage on a closed-form stand-in: files, figures, the GLB's own kinematics, determinism, honesty."""

import dataclasses
import json
import os
import shutil
import subprocess
from pathlib import Path

import av
import numpy as np
import pytest
import torch
import trimesh

from pipeline import BadInput, Folder, Run
from stages import export as stage_module
from stages import formats
from stages.export import ExportSettings, export
from tests.stages.articulated_chain import Chain, write_inputs
from tests.stages.glb_reader import Glb

SETTINGS = ExportSettings(resolution=48, faces=900, texture_px=128, video_side_px=96, turntable_frames=6)
NAMES = ["b 2", "chat-été 🐈"]
FRAMES = 6


class Result:
    """One export and what went into it."""

    def __init__(self, model: Chain, root: Path, settings: ExportSettings = SETTINGS) -> None:
        self.model, self.root, self.settings = model, root, settings
        folders = write_inputs(model, root / "in", FRAMES)
        self.frames = {n: Folder(p) for n, p in folders["frames"].items()}
        self.masks = {n: Folder(p) for n, p in folders["masks"].items()}
        self.features = {n: Folder(p) for n, p in folders["features"].items()}

    def run(self, out: Path) -> tuple[Path, Run]:
        out.mkdir()
        run = Run()
        folder = self.root / "in"
        inputs = Folder(folder / "refine"), self.frames, self.masks, self.features, Folder(folder / "poses")
        export(*inputs, self.settings, out, run)
        stage_module._check(out, self.frames, self.settings)
        return out, run


@pytest.fixture(autouse=True)
def stand_in(monkeypatch: pytest.MonkeyPatch) -> dict[str, Chain]:
    """Let the stage restore the stand-in that a test puts here."""
    slot: dict[str, Chain] = {}
    monkeypatch.setattr(formats, "read_model", lambda folder: ({}, {}))
    monkeypatch.setattr(stage_module.Banmo, "restore", staticmethod(lambda tensors, description: slot["model"]))
    return slot


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path, Run]:
    """One export of two videos, shared."""
    root = tmp_path_factory.mktemp("export")
    made = Result(Chain(NAMES, bones=5), root)
    patch = pytest.MonkeyPatch()
    patch.setattr(formats, "read_model", lambda folder: ({}, {}))
    patch.setattr(stage_module.Banmo, "restore", staticmethod(lambda tensors, description: made.model))
    out, run = made.run(root / "out")
    patch.undo()
    return made, out, run


def export_of(stand_in: dict[str, Chain], model: Chain, root: Path) -> tuple[Result, Path, Run]:
    stand_in["model"] = model
    made = Result(model, root)
    out, run = made.run(root / "out")
    return made, out, run


# --------------------------------------------------------------------------------------------- the GLB


def test_the_glb_is_sound(result: tuple[Result, Path, Run]) -> None:
    glb = Glb((result[1] / "model.glb").read_bytes())
    document = glb.document
    for index in range(len(document["accessors"])):
        assert np.isfinite(glb.accessor(index).astype(float)).all()
    joints = document["skins"][0]["joints"]
    weights = [glb.attribute(f"WEIGHTS_{p}") for p in range(2)]
    np.testing.assert_allclose(sum(w.astype(float).sum(axis=1) for w in weights), 1, atol=1e-6)
    for part in range(2):
        assert glb.attribute(f"JOINTS_{part}").max() < len(joints) == 5
    assert glb.faces().max() == len(glb.attribute("POSITION")) - 1
    np.testing.assert_allclose(np.linalg.norm(glb.attribute("NORMAL"), axis=1), 1, atol=1e-5)
    material = document["materials"][0]["pbrMetallicRoughness"]
    assert material["metallicFactor"] == 0 and material["roughnessFactor"] == 1
    views = document["bufferViews"]
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        assert views[document["accessors"][index]["bufferView"]]["target"] == 34962, name


def test_each_video_is_a_clip_with_its_own_times(result: tuple[Result, Path, Run]) -> None:
    made, out, _ = result
    glb = Glb((out / "model.glb").read_bytes())
    animations = glb.document["animations"]
    assert [a["name"] for a in animations] == NAMES
    assert [c["name"] for c in glb.document["cameras"]] == [f"camera_{n}" for n in NAMES]
    for name, animation in zip(NAMES, animations, strict=True):
        time_s = formats.read_clip(made.frames[name].path).source_time_s
        for sampler in animation["samplers"]:
            times = glb.accessor(sampler["input"])[:, 0]
            assert (np.diff(times) > 0).all()
            np.testing.assert_allclose(times, time_s - time_s[0], atol=1e-6)
            assert len(glb.accessor(sampler["output"])) == FRAMES
        assert animation["extras"]["start_time_s"] == time_s[0]
        targets = [(c["target"]["node"], c["target"]["path"]) for c in animation["channels"]]
        assert len(set(targets)) == len(targets) == 2 * (1 + 5)


def test_the_files_kinematics_are_the_models(result: tuple[Result, Path, Run]) -> None:
    """Forward kinematics and skinning by the specification give the model's own warp, with and without root motion."""
    made, out, _ = result
    glb = Glb((out / "model.glb").read_bytes())
    rest = glb.attribute("POSITION")
    np.testing.assert_allclose(glb.skinned(None, 0), rest, atol=1e-5)
    root = next(i for i, n in enumerate(glb.document["nodes"]) if n["name"] == "root_motion")
    flip = np.diag([1.0, -1.0, -1.0])
    for k, name in enumerate(NAMES):
        time_s = torch.from_numpy(formats.read_clip(made.frames[name].path).source_time_s)
        posed = made.model.forward_warp(torch.from_numpy(rest.copy()), k, time_s).double().numpy()
        poses = made.model.root_poses(k, time_s).double().numpy()
        for key in range(FRAMES):
            np.testing.assert_allclose(glb.skinned(k, key, leave_out=(root,)), posed[key], atol=2e-4)
            camera = posed[key] @ poses[key, :3, :3].T + poses[key, :3, 3]
            np.testing.assert_allclose(glb.skinned(k, key), camera @ flip, atol=2e-4)


def test_the_camera_sees_what_the_video_saw(result: tuple[Result, Path, Run]) -> None:
    """The GLB's camera, by glTF's own projection, puts the vertices on the pixels that our camera gives."""
    made, out, _ = result
    glb = Glb((out / "model.glb").read_bytes())
    size = made.model.size_px
    for k in range(len(NAMES)):
        lens = glb.document["cameras"][k]["perspective"]
        points = glb.skinned(k, 3)
        assert (points[:, 2] < 0).all()  # before a glTF camera
        scale = 1 / np.tan(lens["yfov"] / 2)
        ndc = np.stack([scale / lens["aspectRatio"] * points[:, 0], scale * points[:, 1]], axis=1) / -points[:, 2:]
        pixel = (ndc * [1, -1] + 1) / 2 * size
        intrinsics = made.model.intrinsics(k).double().numpy()
        expected = (points * [1, -1, -1]) @ intrinsics.T
        np.testing.assert_allclose(pixel, expected[:, :2] / expected[:, 2:], atol=1e-3)


def khronos_issues(glb: Path) -> dict[str, object]:
    """What the Khronos validator says; skips the test where it is not installed."""
    modules = Path(os.environ.get("NODE_PATH", Path(__file__).parents[2] / "node_modules"))
    if shutil.which("node") is None or not (modules / "gltf-validator").is_dir():
        pytest.skip("needs node and `npm install gltf-validator` (in the repository or where NODE_PATH points)")
    script = (
        "const v = require(process.argv[1]), fs = require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])))"
        ".then(r => console.log(JSON.stringify(r.issues)));"
    )
    command = ["node", "-e", script, str(modules / "gltf-validator"), str(glb)]
    return json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)


def test_the_khronos_validator_finds_no_error(result: tuple[Result, Path, Run]) -> None:
    issues = khronos_issues(result[1] / "model.glb")
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


@pytest.mark.parametrize(("bones", "influences", "texture_px"), [(1, 8, 64), (3, 4, 0), (20, 12, 64)])
def test_the_khronos_validator_accepts_every_kind(
    bones: int, influences: int, texture_px: int, stand_in: dict[str, Chain], tmp_path: Path
) -> None:
    settings = dataclasses.replace(SETTINGS, influences=influences, texture_px=texture_px)
    stand_in["model"] = Chain(["only one"], bones=bones)
    out, _ = Result(stand_in["model"], tmp_path, settings).run(tmp_path / "out")
    issues = khronos_issues(out / "model.glb")
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_trimesh_loads_it(result: tuple[Result, Path, Run]) -> None:
    mesh = trimesh.load(result[1] / "model.glb").to_geometry()
    assert mesh.visual.kind == "texture"
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert len(mesh.faces) <= SETTINGS.faces


@pytest.mark.parametrize(("bones", "names"), [(1, ["only"]), (2, ['q"uote', "back\\slash", "<b>&"]), (12, ["x"])])
def test_any_number_of_bones_and_videos(
    bones: int, names: list[str], stand_in: dict[str, Chain], tmp_path: Path
) -> None:
    made, out, _ = export_of(stand_in, Chain(names, bones=bones), tmp_path)
    glb = Glb((out / "model.glb").read_bytes())
    assert [a["name"] for a in glb.document["animations"]] == names
    assert len(glb.document["skins"][0]["joints"]) == bones
    attributes = glb.document["meshes"][0]["primitives"][0]["attributes"]
    assert ("JOINTS_1" in attributes) == (bones > 4)
    rest = torch.from_numpy(glb.attribute("POSITION").copy())
    time_s = torch.from_numpy(formats.read_clip(made.frames[names[-1]].path).source_time_s)
    posed = made.model.forward_warp(rest, len(names) - 1, time_s)[4].numpy()
    np.testing.assert_allclose(glb.skinned(len(names) - 1, 4, leave_out=(1,)), posed, atol=1e-3)


# --------------------------------------------------------------------------------------------- beside it


def test_every_source_frame_has_a_mesh_in_object_space(result: tuple[Result, Path, Run]) -> None:
    made, out, _ = result
    rest = trimesh.load(out / "rest.ply", process=False)
    for k, name in enumerate(NAMES):
        files = sorted((out / "meshes" / name).iterdir())
        assert [f.name for f in files] == [f"{i:05d}.ply" for i in range(FRAMES)]
        time_s = torch.from_numpy(formats.read_clip(made.frames[name].path).source_time_s)
        posed = made.model.forward_warp(torch.from_numpy(np.array(rest.vertices)).float(), k, time_s).numpy()
        for i in (0, 2, 5):  # frame 2 was dropped by the frames stage, its mesh is there all the same
            mesh = trimesh.load(files[i], process=False)
            # The meshes are the rig's, which follows the model as closely as a few influences a vertex can.
            np.testing.assert_allclose(mesh.vertices, posed[i], atol=1e-3 * float(np.ptp(posed[i], axis=0).max()))
            np.testing.assert_array_equal(mesh.faces, rest.faces)
            expected = made.model.colour(torch.from_numpy(np.array(rest.vertices)).float(), k).numpy()
            assert np.abs(mesh.visual.vertex_colors[:, :3] / 255 - expected).max() < 0.01


def test_cameras_can_be_given_back(result: tuple[Result, Path, Run]) -> None:
    made, out, _ = result
    for k, name in enumerate(NAMES):
        track = formats.read_poses(out / "cameras" / f"{name}.json")  # checks that they are rigid
        time_s = formats.read_clip(made.frames[name].path).source_time_s
        expected = made.model.root_poses(k, torch.from_numpy(time_s)).numpy()
        np.testing.assert_allclose(track.object_to_camera, expected, atol=1e-6)
        np.testing.assert_allclose(track.intrinsics, made.model.intrinsics(k).numpy())
        assert formats.read_json(out / "cameras" / f"{name}.json")["time_s"] == time_s.tolist()


def test_bones_form_a_tree(result: tuple[Result, Path, Run]) -> None:
    bones = formats.read_json(result[1] / "bones.json")["bones"]
    names = [b["name"] for b in bones]
    assert len(set(names)) == 5
    assert [b["parent"] for b in bones].count(None) == 1
    for i, bone in enumerate(bones):
        assert bone["parent"] is None or bone["parent"] in names[:i]
        if bone["parent"] is not None:  # a chain: neighbours in the model are neighbours in the tree
            assert abs(bone["model_bone"] - int(bone["parent"][5:])) == 1
    assert sum(b["surface_share"] for b in bones) == pytest.approx(1, abs=1e-4)


def test_videos_play(result: tuple[Result, Path, Run]) -> None:
    _, out, _ = result
    for path, count in [(out / "turntable.mp4", 6), *((out / f"overlay-{n}.mp4", FRAMES) for n in NAMES)]:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
            pictures = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        assert len(pictures) == count
        assert pictures[0].std() > 5
    overlay = pictures[0].astype(int)
    assert overlay.shape == (96, 3 * 96, 3)
    third = [overlay[:, i * 96 : i * 96 + 96] for i in range(3)]
    object_there = np.abs(third[0] - (90, 120, 90)).sum(axis=-1) > 60
    mesh_there = np.abs(third[2] - 237).sum(axis=-1) > 60
    assert (object_there & mesh_there).sum() / (object_there | mesh_there).sum() > 0.85  # the mesh lies on the object


def test_the_report_measures_what_it_says(result: tuple[Result, Path, Run]) -> None:
    _, out, run = result
    report = formats.read_json(out / "quality.json")
    assert report["iou_mean"] > 0.95
    assert report["skinning_error"] < 1e-3
    assert report["skinning_error_4"] >= report["skinning_error"]
    assert report["verdict"] == "good" and report["trust"] > 0.75
    assert run.metrics["iou_mean"] == report["iou_mean"]
    frames = report["videos"][NAMES[0]]["frames"]
    assert max(f["missing"] for f in frames) < 0.04 and max(f["extra"] for f in frames) < 0.04
    assert [f["source_idx"] for f in frames] == [0, 1, 3, 4, 5]
    assert report["videos"][NAMES[0]]["source_frames"] == FRAMES
    seen = trimesh.load(out / "rest.ply", process=False)
    views = seen.metadata["_ply_raw"]["vertex"]["data"]["views"]
    assert views.max() <= 2 * 5
    assert 0.02 < report["unseen_area"] < 0.6  # two short clips see most sides, not all


def test_the_same_input_gives_the_same_bytes(stand_in: dict[str, Chain], tmp_path: Path) -> None:
    made, first, _ = export_of(stand_in, Chain(["v"], bones=3), tmp_path)
    second, _ = made.run(tmp_path / "again")
    files = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(second) for p in second.rglob("*") if p.is_file())
    for file in files:
        assert (first / file).read_bytes() == (second / file).read_bytes(), file


# --------------------------------------------------------------------------------------------- honesty


class Inflated(Chain):
    """A model twice as fat as what was filmed."""

    def sdf(self, points: torch.Tensor) -> torch.Tensor:
        return super().sdf(points) - 0.3


class Shortened(Chain):
    """A model that lost a limb: the right third of the chain."""

    def sdf(self, points: torch.Tensor) -> torch.Tensor:
        return torch.maximum(super().sdf(points), points[:, 0] - 0.3)


class Nothing(Chain):
    """A model whose optimisation lost the surface."""

    def sdf(self, points: torch.Tensor) -> torch.Tensor:
        return super().sdf(points) + 0.5


class Twisted(Chain):
    """A model whose warp is not linear blend skinning."""

    def forward_warp(self, points: torch.Tensor, video_idx: int, time_s: torch.Tensor) -> torch.Tensor:
        return super().forward_warp(points, video_idx, time_s) + 0.05 * torch.sin(9 * points)


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        (Inflated, "too fat"),
        (Shortened, "not in the model"),
        (Inflated, "misses the object's outline"),
        (Nothing, "without a surface"),
        (Twisted, "follows the model only to"),
    ],
)
def test_a_bad_result_says_so(model: type[Chain], sentence: str, stand_in: dict[str, Chain], tmp_path: Path) -> None:
    made = Result(Chain(["v"], bones=3), tmp_path)
    stand_in["model"] = model(["v"], bones=3)
    out, run = made.run(tmp_path / "out")
    assert any(sentence in warning for warning in run.warnings)
    report = formats.read_json(out / "quality.json")
    if model is Twisted:
        assert report["skinning_error"] == pytest.approx(0.05 * np.sqrt(3) / 2, rel=0.3)
    elif model is not Shortened:
        assert report["verdict"] == "doubtful"


def test_doubtful_masks_poses_and_missing_objects_are_told(stand_in: dict[str, Chain], tmp_path: Path) -> None:
    made = Result(Chain(["v"], bones=2), tmp_path)
    stand_in["model"] = made.model
    facts = formats.read_json(made.masks["v"] / "masks.json")
    for row in facts["frames"][:3]:
        row["confidence"], row["flags"] = 0.1, ["missing"]
    formats.write_json(made.masks["v"] / "masks.json", facts)
    formats.write_json(tmp_path / "in" / "poses" / "poses.json", {"trust": 0.2, "advice": "film a slow turn"})
    out, run = made.run(tmp_path / "out")
    text = " ".join(run.warnings)
    assert "poor masks" in text and "viewing directions are uncertain" in text and "film a slow turn" in text
    report = formats.read_json(out / "quality.json")
    assert report["verdict"] == "doubtful"
    assert [f["iou"] is None for f in report["videos"]["v"]["frames"]] == [True, True, True, False, False]


@pytest.mark.parametrize(
    "key", ["resolution", "faces", "influences", "texture_px", "video_side_px", "turntable_frames"]
)
def test_senseless_settings_are_refused_in_one_sentence(key: str, tmp_path: Path) -> None:
    settings = dataclasses.replace(SETTINGS, **{key: -1})
    with pytest.raises(BadInput, match=rf"\[export\] {key} = -1 is not between"):
        export(Folder(tmp_path), {}, {}, {}, Folder(tmp_path), settings, tmp_path, Run())


def test_the_check_refuses_a_folder_that_lacks_a_frame(stand_in: dict[str, Chain], tmp_path: Path) -> None:
    made, out, _ = export_of(stand_in, Chain(["v"], bones=2), tmp_path)
    (out / "meshes" / "v" / "00003.ply").unlink()
    with pytest.raises(formats.FormatError, match="6 source frames, 5 meshes"):
        stage_module._check(out, made.frames, SETTINGS)
    (out / "model.glb").write_bytes((out / "model.glb").read_bytes()[:-8])
    with pytest.raises(formats.FormatError, match="not a whole"):
        stage_module._check(out, made.frames, SETTINGS)


def test_the_contact_sheet_is_a_picture(result: tuple[Result, Path, Run], tmp_path: Path) -> None:
    stage_module._sheet(result[1], tmp_path / "sheet.png")
    assert formats.read_image(tmp_path / "sheet.png").std() > 5


def test_without_texture_and_frame_meshes(stand_in: dict[str, Chain], tmp_path: Path) -> None:
    stand_in["model"] = Chain(["v"], bones=2)
    settings = ExportSettings(32, 300, 4, 0, False, video_side_px=64, turntable_frames=2)
    made = Result(stand_in["model"], tmp_path, settings)
    out, _ = made.run(tmp_path / "out")
    assert not (out / "meshes").exists()
    glb = Glb((out / "model.glb").read_bytes())
    assert "textures" not in glb.document
    colour = stand_in["model"].colour(torch.from_numpy(glb.attribute("POSITION").copy())).double().numpy()
    linear = glb.attribute("COLOR_0")[:, :3] / 65535
    np.testing.assert_allclose(
        np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055), colour, atol=1e-3
    )
