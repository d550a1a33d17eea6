"""``banmo evaluate`` on a result whose truth is known, and on what is not there."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import BadInput, Folder
from stages import formats
from stages.meshing.ply import PlyWriter
from stages.meshing.surface import clean_surface, extract
from stages.verbs import evaluate

NAMES = ("a", "b")
FRAMES = 3


class Finished:
    """What the verb reads of a workspace."""

    videos = NAMES

    def __init__(self, root: Path) -> None:
        self.root = root

    def folder(self, stage: str, video: str | None = None) -> Folder:
        return Folder(self.root / stage / (video or ""))


@pytest.fixture
def scene(tmp_path: Path) -> tuple[Path, Finished]:
    """A folder of truth and a workspace that found it up to a similarity, but for one mesh and one mask."""

    def field(points):  # type: ignore[no-untyped-def]
        body = (points / points.new_tensor([1.0, 0.5, 0.3])).norm(dim=-1) - 1
        return (body * 0.3).minimum((points - points.new_tensor([0.7, 0.4, 0.0])).norm(dim=-1) - 0.2)

    mesh = clean_surface(extract(field, np.array([[-1.3] * 3, [1.3] * 3]), 32), 600)[0]
    verts = np.stack([mesh.vertices * [1, 1 + 0.05 * k, 1] for k in range(2 * FRAMES)])
    truth, work = tmp_path / "truth", tmp_path / "work"
    (truth / "gt").mkdir(parents=True)
    index = np.arange(2 * FRAMES).reshape(2, FRAMES)
    np.savez(
        truth / "gt" / "meshes.npz",
        faces=mesh.faces,
        rest=verts[0],
        verts=verts.astype(np.float32),
        video_names=np.array(NAMES),
        frame_index=index,
    )
    look = truth / "clean" / "gt"
    look.mkdir(parents=True)
    turn = Rotation.random(random_state=1).as_matrix()
    poses = np.tile(np.eye(4), (2, FRAMES, 1, 1))
    poses[..., :3, :3] = Rotation.random(2 * FRAMES, random_state=2).as_matrix().reshape(2, FRAMES, 3, 3)
    masks = np.zeros((FRAMES, 8, 8), bool)
    masks[:, 2:6, 2:6] = True
    for k, name in enumerate(NAMES):
        (look / f"{name}.json").write_text(json.dumps({"object_to_camera": poses[k].tolist()}))
        np.savez(look / f"{name}-mask.npz", packed=np.packbits(masks), shape=masks.shape)
        flow = np.full((1, 8, 8, 2), 2.0)
        np.savez(look / f"{name}-flow.npz", frames=[0], flow=flow, object=masks[:1], visible=masks[:1])
        meshes, cameras = work / "export" / "meshes" / name, work / "export" / "cameras"
        meshes.mkdir(parents=True)
        cameras.mkdir(exist_ok=True)
        writer = PlyWriter(mesh.faces, np.zeros((len(mesh.vertices), 3), np.uint8), {})
        for i in range(FRAMES):
            (meshes / f"{i:05d}.ply").write_bytes(writer.encode(0.5 * verts[index[k, i]] @ turn.T + 1))
        own = poses[k].copy()
        own[:, :3, :3] = own[:, :3, :3] @ turn.T
        (cameras / f"{name}.json").write_text(json.dumps({"object_to_camera": own.tolist()}))
        clip_root, mask_root = work / "frames" / name, work / "masks" / name
        for folder in (clip_root, mask_root, work / "flow" / name / "fw-01"):
            folder.mkdir(parents=True)
        clip = formats.Clip(clip_root, 8, 8, np.arange(FRAMES), np.arange(FRAMES) / 10)
        formats.write_clip_info(clip, clip_root)
        for file, mask in zip(clip.names, masks, strict=True):
            formats.write_image(mask_root / file, mask.astype(np.uint8) * 255)
        formats.write_flow(formats.flow_path(work / "flow" / name, 1, 0), flow[0] + 0.5, np.ones((8, 8)))
    (work / "export" / "meshes" / "b" / "00001.ply").unlink()
    formats.write_image(work / "masks" / "a" / "00000.png", np.zeros((8, 8), np.uint8))
    return truth, Finished(work)


def call(truth: Path, results: Finished, *flags: str) -> int:
    parser = argparse.ArgumentParser()
    evaluate.arguments(parser)
    args = parser.parse_args(["--truth", str(truth), "--samples", "1500", *flags])
    return evaluate.run(args, results)  # type: ignore[arg-type]


def test_a_perfect_result_but_for_what_is_missing(
    scene: tuple[Path, Finished], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, results = scene
    assert call(truth, results, "--align", "all", "--json", str(tmp_path / "out" / "scores.json")) == 0
    text = capsys.readouterr().out
    assert "sampled anew" in text and "1 without a mesh" in text
    found = json.loads((tmp_path / "out" / "scores.json").read_text())
    a, b = (found["mesh"]["videos"][n] for n in NAMES)
    assert a["cd_cm"] < 0.3 and a["cd_sum_cm"] == pytest.approx(2 * a["cd_cm"]) and a["f2"] > 99.9
    assert b["missing"] == 1 and b["f2"] == pytest.approx(a["f2"] * 2 / 3, abs=0.2)
    assert a["drift_cm"] < 1
    assert found["pose"]["all"]["mean"] < 1e-4
    assert found["mask"]["a"] == pytest.approx(
        {"mean": 2 / 3, "std": 0.4714, "median": 1, "least": 0, "largest": 1}, abs=1e-3
    )
    assert found["flow"]["b"]["visible_px"] == pytest.approx(0.5 * np.sqrt(2), abs=0.02)


@pytest.mark.parametrize("align", ["video", "frame", "none"])
def test_other_alignments(align: str, scene: tuple[Path, Finished], tmp_path: Path) -> None:
    truth, results = scene
    file = tmp_path / "s.json"
    assert call(truth, results, "--only", "mesh", "--align", align, "--every", "3", "--json", str(file)) == 0
    row = json.loads(file.read_text())["mesh"]["all"]
    assert row["frames"] == 2 and (row["cd_cm"] < 0.3) == (align != "none")


def test_points_to_points_has_a_floor(scene: tuple[Path, Finished], tmp_path: Path) -> None:
    truth, results = scene
    file = tmp_path / "s.json"
    meshes = truth / "gt" / "meshes.npz"
    call(meshes, results, "--distance", "points", "--align", "all", "--every", "3", "--json", str(file))
    found = json.loads(file.read_text())["mesh"]
    assert found["sampling_floor_cm"] > 0.3  # surfaces to surfaces it is next to nothing
    assert found["distance"] == "points" and found["all"]["cd_cm"] < found["sampling_floor_cm"]


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (("--look", "casual"), "no look 'casual'"),
        (("--samples", "3"), "at least 100"),
        (("--meshes", "nowhere"), "no meshes of these videos"),
    ],
)
def test_what_is_wrong_is_said(flags: tuple[str, ...], sentence: str, scene: tuple[Path, Finished]) -> None:
    with pytest.raises(BadInput, match=sentence):
        call(*scene, *flags)


def test_damaged_truth_is_refused(scene: tuple[Path, Finished]) -> None:
    truth, results = scene
    (truth / "gt" / "meshes.npz").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(BadInput, match=r"meshes.npz cannot be read"):
        call(truth, results)
    with pytest.raises(BadInput, match="no such folder"):
        call(truth / "x", results)
