"""From two clips to a model, then nothing, then only what a change makes necessary."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.end_to_end.conftest import TINY, Outcome, check_store, contents, copy_program, run_banmo, snapshot, view

STAGES = ("frames", "masks", "flow", "features", "poses", "fit", "correct", "refine", "export", "report")
Finished = tuple[Path, Outcome]


def test_clips_become_a_model(finished: Finished, clips: Path) -> None:
    workspace, outcome = finished
    assert outcome.code == 0, outcome.text
    exports = workspace / "exports"
    scene = trimesh.load(exports / "model.glb")
    assert sum(len(g.faces) for g in scene.geometry.values()) > 50
    for video in ("cat-00", "cat-01"):
        assert len(list((exports / "meshes" / video).glob("*.ply"))) == 8, "a mesh for every source frame"
        camera = json.loads((exports / "cameras" / f"{video}.json").read_text())
        poses = np.array(camera["object_to_camera"])
        assert poses.shape == (8, 4, 4) and np.isfinite(poses).all()
        given = np.array(json.loads((clips / f"{video}.poses.json").read_text())["object_to_camera"])
        turned = np.einsum("tij,tik->tjk", given[:, :3, :3], poses[:, :3, :3])
        spread = np.abs(turned - turned[0]).max()
        assert spread < 1e-3, "given root poses are held fixed, up to one change of the object's frame"
        assert (exports / f"overlay-{video}.mp4").stat().st_size > 500
    assert isinstance(json.loads((exports / "quality.json").read_text()), dict)
    assert (exports / "turntable.mp4").stat().st_size > 500
    assert check_store(workspace) == 4 * 2 + 6
    page = (exports / "report.html").read_text(encoding="utf-8")
    assert "cat-00" in page and '"ran": [{' in page, "what ran is put into the page"


def test_the_skin_is_a_partition_of_unity(finished: Finished) -> None:
    """In the GLB, as a viewer reads it, every vertex's joint weights sum to one and there is a clip a video."""
    data = (finished[0] / "exports" / "model.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    binary = data[20 + length + 8 :]
    assert len(document["skins"]) >= 1
    assert len(document["animations"]) == 2
    dtypes = {5126: np.float32, 5121: np.uint8, 5123: np.uint16}
    total: np.ndarray | float = 0.0
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        if name.startswith("WEIGHTS_"):
            accessor = document["accessors"][index]
            piece = document["bufferViews"][accessor["bufferView"]]
            start = piece.get("byteOffset", 0) + accessor.get("byteOffset", 0)
            kind = dtypes[accessor["componentType"]]
            values = np.frombuffer(binary, kind, accessor["count"] * 4, start).reshape(-1, 4).astype(np.float64)
            total = total + values.sum(1) / (1 if kind is np.float32 else np.iinfo(kind).max)
    np.testing.assert_allclose(total, 1.0, atol=1e-3)


def test_the_view_shows_every_stage(finished: Finished) -> None:
    shown = view(finished[0])
    for video in ("cat-00", "cat-01"):
        assert {f"videos/{video}/{s}" for s in STAGES[:4]} <= set(shown)
    assert set(STAGES[4:]) <= {Path(p).name for p in shown}
    masks = sorted(p.name for p in (finished[0] / "latest" / "videos" / "cat-00" / "masks").glob("*.png"))
    assert masks == [f"{i:05d}.png" for i in range(8)]


def test_the_clips_are_only_read(finished: Finished, clips: Path) -> None:
    assert finished[1].code == 0
    assert {p.name for p in clips.iterdir()} == {
        f"cat-0{k}{s}" for k in (0, 1) for s in (".mp4", ".masks.mp4", ".poses.json")
    }
    assert all(p.stat().st_mode & 0o777 == 0o444 for p in clips.iterdir())


def test_a_second_run_does_nothing_and_says_so(copy_of_finished: Path, clips: Path) -> None:
    run_banmo("run", clips, "--workspace", copy_of_finished, *TINY)
    before = contents(copy_of_finished / "objects") | contents(copy_of_finished / "actions")
    again = run_banmo("run", clips, "--workspace", copy_of_finished, *TINY, python=("-X", "importtime"))
    assert again.code == 0, again.text
    assert "everything is up to date" in again.out
    modules = {line.rsplit("|", 1)[-1].strip() for line in again.err.splitlines() if line.startswith("import time:")}
    assert "pipeline.cli" in modules or "pipeline.settings" in modules
    assert not modules & {"torch", "cv2", "av", "numpy"}, "planning imports no numerics"
    assert again.cpu_s < 4.0
    assert contents(copy_of_finished / "objects") | contents(copy_of_finished / "actions") == before


def test_without_words_it_goes_on_with_the_clips_of_last_time(copy_of_finished: Path) -> None:
    check = run_banmo("status", "--workspace", copy_of_finished)
    assert check.code == 0, check.text
    assert "cat-00" in check.out and "refine" in check.out


def ran(outcome: Outcome) -> set[str]:
    """Stages that a run carried out, from its own lines."""
    found = set()
    for line in outcome.out.splitlines():
        words = line.split()
        for i, word in enumerate(words[:-1]):
            if word.rstrip(":").split("/")[0] in STAGES and words[i + 1].startswith("done"):
                found.add(word.rstrip(":").split("/")[0])
    return found


def test_a_mask_setting_reruns_masks_and_followers_but_not_flow(clips: Path, contracts: Path, tmp_path: Path) -> None:
    videos, workspace = tmp_path / "videos", tmp_path / "workspace"
    videos.mkdir()
    shutil.copytree(contracts, workspace / "cache")
    for k in (0, 1):  # no masks beside these: what the setting governs decides
        shutil.copyfile(clips / f"cat-0{k}.mp4", videos / f"cat-0{k}.mp4")
    quick = "--masks.seed=0"
    first = run_banmo("run", videos, "--workspace", workspace, "--until", "features", quick)
    assert first.code == 0, first.text
    assert ran(first) == {"frames", "masks", "flow", "features"}
    flow_before = {k: v for k, v in view(workspace).items() if k.endswith("flow")}
    assert len(flow_before) == 2

    change = ("--masks.threshold", "0.93", quick)
    why = run_banmo("why", "masks", "cat-00", "--workspace", workspace, *change)
    assert why.code == 0, why.text
    assert "threshold" in why.out and "0.5" in why.out and "0.93" in why.out
    second = run_banmo("run", videos, "--workspace", workspace, "--until", "features", *change)
    assert second.code == 0, second.text
    assert "masks" in ran(second)
    assert "flow" not in ran(second) and "frames" not in ran(second)
    assert {k: v for k, v in view(workspace).items() if k.endswith("flow")} == flow_before
    back = run_banmo("run", videos, "--workspace", workspace, "--until", "features", quick)
    assert back.code == 0 and "up to date" in back.out, "the earlier result is still there"


@pytest.fixture
def code(tmp_path: Path) -> Path:
    """A copy of the program whose source a test may edit."""
    copy_program(snapshot(), tmp_path / "code")
    return tmp_path / "code"


def test_a_comment_reruns_nothing_and_a_statement_is_named(copy_of_finished: Path, clips: Path, code: Path) -> None:
    words = ("run", clips, "--workspace", copy_of_finished, "--check", *TINY)
    moved = run_banmo(*words, code=code)
    assert moved.code == 0, "the same program elsewhere: " + moved.text
    source = code / "stages" / "masks.py"
    text = source.read_text()
    source.write_text("# A remark.\n" + text.replace('"""', '"""In other words: ', 1) + "\n# Another.\n")
    assert run_banmo(*words, code=code).code == 0, "comments and docstrings are not code"
    source.write_text(text + "\n_EXTRA = 1\n")
    pending = run_banmo(*words, code=code)
    assert pending.code == 10, pending.text
    why = run_banmo("why", "masks", "cat-00", "--workspace", copy_of_finished, *TINY, code=code)
    assert "masks.py" in why.out and "code" in why.out, why.text


def test_a_changed_clip_reruns_what_depends_on_it(copy_of_finished: Path, clips: Path, tmp_path: Path) -> None:
    videos = tmp_path / "videos"
    shutil.copytree(clips, videos)
    for path in videos.iterdir():
        path.chmod(0o644)
    poses = json.loads((videos / "cat-01.poses.json").read_text())
    poses["object_to_camera"][0][2][3] += 1e-3
    (videos / "cat-01.poses.json").write_text(json.dumps(poses))
    plan = run_banmo("run", videos, "--workspace", copy_of_finished, "--dry-run", *TINY)
    assert plan.code == 0, plan.text
    listed = {line.split()[0].split("/")[0] for line in plan.out.splitlines() if line.startswith("  ")}
    assert "poses" in listed and "fit" in listed
    assert not listed & {"frames", "masks", "flow", "features"}
