"""poses: given poses checked and used, providers asked in order, honest words, one frame of reference."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import BadInput, Folder, Given, Run
from stages import poses as stage_module
from stages.formats import (
    Clip,
    flow_path,
    read_clip,
    read_json,
    read_poses,
    write_clip_info,
    write_flow,
    write_image,
    write_json,
)
from stages.poses import GIVEN, PosesSettings, _check, _sheet, poses
from stages.registration.answer import Answer, Subject, Tell
from stages.registration.placing import default_intrinsics, transforms, view_rotation
from stages.registration.search import Effort, search
from tests.numerics.turning_scene import cast

SIDE = 72


def write_clip(
    root: Path, name: str, azimuth: np.ndarray, keep: np.ndarray | None = None, distance: float = 3.0
) -> np.ndarray:
    """Frames, true masks and exact flow of a turning beast under `root`; returns the poses of *all* source frames."""
    intrinsics = default_intrinsics(SIDE, SIDE, 1.2 * SIDE)
    rotation = view_rotation(azimuth, np.full(len(azimuth), 0.3))
    truth = transforms(rotation, np.tile([0.1, -0.05, distance], (len(azimuth), 1)))
    kept = np.arange(len(azimuth)) if keep is None else keep
    folders = {kind: root / kind / name for kind in ("frames", "masks", "flow", "features")}
    for folder in folders.values():
        folder.mkdir(parents=True)
    (folders["flow"] / "fw-01").mkdir()
    write_json(folders["features"] / "features.json", {"network": "builtin-appearance", "frames": []})
    clip = Clip(folders["frames"], SIDE, SIDE, kept, np.arange(len(azimuth)) / 20)
    write_clip_info(clip, clip.root, {"source_width": 2 * SIDE, "source_height": 2 * SIDE})
    here = np.stack(np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5), -1)
    for position, index in enumerate(kept):
        picture, mask, points = cast(truth[index], intrinsics, SIDE)
        frame = np.where(mask[..., None], picture, 0.3)
        write_image(clip.root / clip.names[position], np.round(frame * 255).astype(np.uint8))
        write_image(folders["masks"] / clip.names[position], mask.astype(np.uint8) * 255)
        if position + 1 < len(kept):
            following = truth[kept[position + 1]]
            seen = (points @ following[:3, :3].T + following[:3, 3]) @ intrinsics.T
            motion = np.where(mask[..., None], seen[..., :2] / np.maximum(seen[..., 2:], 1e-6) - here, 0.0)
            write_flow(flow_path(folders["flow"], 1, int(index)), motion.astype(np.float32), mask.astype(np.float32))
    return truth


def run_poses(root: Path, given: dict[str, Path] | None = None, **settings: Any) -> tuple[Path, Run]:
    names = sorted(p.name for p in (root / "frames").iterdir())
    inputs = {kind: {n: Folder(root / kind / n) for n in names} for kind in ("frames", "masks", "flow", "features")}
    beside = {n: Given({GIVEN: given[n]} if given and n in given else {}) for n in names}
    out, run = root / "out", Run(videos=tuple(names))
    out.mkdir()
    poses(**inputs, given=beside, settings=PosesSettings(**settings), out=out, run=run)
    _check(out=out, frames=inputs["frames"])
    return out, run


def document(truth: np.ndarray) -> dict[str, Any]:
    """Given poses as users write them: pixels of the source video, which is twice as large as the kept frames."""
    intrinsics = default_intrinsics(2 * SIDE, 2 * SIDE, 1.2 * 2 * SIDE)
    return {"K": intrinsics.tolist(), "object_to_camera": truth.tolist(), "note": "others are ignored"}


@pytest.fixture
def clips(tmp_path: Path) -> dict[str, np.ndarray]:
    keep = np.array([0, 1, 3, 4, 7])
    return {
        "a": write_clip(tmp_path, "a", np.linspace(-0.4, 0.4, 8), keep),
        "b": write_clip(tmp_path, "b", np.linspace(2.0, 1.0, 6)),
    }


def save(folder: Path, name: str, value: Any) -> Path:
    path = folder / f"{name}{GIVEN}"
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


def test_given_poses_are_used_as_they_are(tmp_path: Path, clips: dict[str, np.ndarray], monkeypatch: Any) -> None:
    monkeypatch.setattr(stage_module, "PROVIDERS", {})  # whoever asks a provider fails
    given = {name: save(tmp_path, name, document(truth)) for name, truth in clips.items()}
    out, run = run_poses(tmp_path, given)
    track = read_poses(out / "a.json")
    assert track.object_to_camera == pytest.approx(clips["a"][[0, 1, 3, 4, 7]])
    assert track.intrinsics == pytest.approx(default_intrinsics(SIDE, SIDE, 1.2 * SIDE))
    assert track.confidence.tolist() == [1.0] * 5 and track.provider == ["given"] * 5
    summary = read_json(out / "poses.json")
    assert summary["trust"] == 1.0 and summary["won"] == {"a": "given", "b": "given"}
    assert summary["videos"]["b"]["fixed"] is True
    assert run.warnings == [] and summary["advice"] == ""


def test_given_poses_that_may_move_lose_their_jitter(tmp_path: Path) -> None:
    truth = write_clip(tmp_path, "a", np.linspace(0, 1.5, 24))
    rng = np.random.default_rng(0)
    wrong = truth.copy()
    wrong[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec(0.2 * rng.normal(size=(24, 3))).as_matrix()
    given = {"a": save(tmp_path, "a", document(wrong))}

    def error(found: np.ndarray) -> float:
        rest = truth[:, :3, :3].transpose(0, 2, 1) @ found[:, :3, :3]
        return float(Rotation.from_matrix(rest).magnitude().mean())

    for moves in (False, True):
        out, run = run_poses(tmp_path, given, refine=moves)
        found = read_poses(out / "a.json").object_to_camera
        if moves:
            assert error(found) < 0.5 * error(wrong) and run.metrics["jitter_degrees"] > 0
            wave = read_poses(out / "a.json").wave_rad
            assert wave is not None and all(0.01 < w < 0.2 for w in wave)
        else:
            assert np.allclose(found, wrong, atol=1e-6) and "jitter_degrees" not in run.metrics
        out.rename(tmp_path / f"moves-{moves}")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d["object_to_camera"].pop(), "has 7 poses, but the video has 8 frames"),
        (lambda d: d["object_to_camera"][2][0].__setitem__(0, float("nan")), "frame 2 is not finite"),
        (lambda d: d["object_to_camera"][5][1].__setitem__(1, 3.0), "frame 5 is not a rigid transform"),
        (lambda d: d.pop("K"), "neither K nor intrinsics"),
        (lambda d: d.pop("object_to_camera"), "no object_to_camera"),
    ],
)
def test_bad_given_poses_are_one_sentence(tmp_path: Path, clips: dict[str, np.ndarray], change: Any, says: str) -> None:
    value = document(clips["a"])
    change(value)
    with pytest.raises(BadInput, match=says) as caught:
        run_poses(tmp_path, {"a": save(tmp_path, "a", value)})
    assert str(caught.value).startswith("a.poses.json ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{not json", "[1, 2]", "\x00\x01"])
def test_a_pose_file_that_is_none(tmp_path: Path, clips: dict[str, np.ndarray], text: str) -> None:
    with pytest.raises(BadInput, match=r"a\.poses\.json"):
        run_poses(tmp_path, {"a": save(tmp_path, "a", text)})


def test_settings_are_checked(tmp_path: Path, clips: dict[str, np.ndarray]) -> None:
    with pytest.raises(BadInput, match="serch"):
        run_poses(tmp_path, provider="serch")


def test_only_given_poses_will_do(tmp_path: Path, clips: dict[str, np.ndarray]) -> None:
    with pytest.raises(BadInput, match="no root poses beside b"):
        run_poses(tmp_path, {"a": save(tmp_path, "a", document(clips["a"]))}, provider="given")


def test_upright_is_always_an_answer_and_never_boasts(tmp_path: Path, clips: dict[str, np.ndarray]) -> None:
    out, run = run_poses(tmp_path, provider="upright", focal_px=1.2 * SIDE)
    for name in clips:
        track = read_poses(out / f"{name}.json")
        assert track.provider == ["upright"] * len(track.provider)
        assert track.confidence.max() < 0.2
        assert (track.object_to_camera[:, 1, 1] < -0.9).all()  # up in the object is up in the picture
        pixels = track.object_to_camera[:, :3, 3] @ track.intrinsics.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        # the origin is where the object is, and about as far as its size says
        assert np.abs(pixels - (SIDE / 2 + 1.2 * SIDE * np.array([0.1, -0.05]) / 3)).max() < 0.12 * SIDE
        assert track.object_to_camera[:, 2, 3].min() > 2.0 and track.object_to_camera[:, 2, 3].max() < 6.5
    assert len(run.warnings) == 1
    assert "root poses are a guess for a (trust 5 %), b (trust 5 %)" in run.warnings[0]
    assert "a.poses.json" in run.warnings[0]
    summary = read_json(out / "poses.json")
    assert summary["trust"] == pytest.approx(0.05) and "a, b" in summary["advice"]


def test_a_clip_with_given_poses_brings_its_pictures_along_and_no_view(
    tmp_path: Path, clips: dict[str, np.ndarray], monkeypatch: Any
) -> None:
    seen: dict[str, Subject] = {}

    def provider(subjects: list[Subject], seed: int, tell: Tell) -> dict[str, Answer]:
        seen.update({s.name: s for s in subjects})
        return {}

    monkeypatch.setitem(stage_module.PROVIDERS, "search", provider)
    run_poses(tmp_path, {"a": save(tmp_path, "a", document(clips["a"]))}, provider="search")
    assert seen["a"].rotation is not None and seen["b"].rotation is None
    for subject in seen.values():
        assert subject.view is None and subject.frame is not None
        assert subject.frame(0)[0].shape[2] == 3


def test_the_most_trusted_provider_wins_and_others_fill_in(
    tmp_path: Path, clips: dict[str, np.ndarray], monkeypatch: Any
) -> None:
    front = np.diag([1.0, -1.0, -1.0])
    quarter = view_rotation(np.array(np.pi / 2), np.array(0.0)).T @ front

    def say(name: str, trusts: dict[str, float], frame: np.ndarray) -> Any:
        def provider(subjects: list[Subject], seed: int, tell: Tell) -> dict[str, Answer]:
            tell(1, 1, name)
            answers = {}
            for s in subjects:
                if s.name in trusts:
                    turn = np.tile(front @ frame, (len(s.cues), 1, 1))
                    sure = np.full(len(s.cues), trusts[s.name])
                    answers[s.name] = Answer(
                        name, turn, np.full(len(s.cues), 2.0), s.cues.centre_px, sure, sure[0], wave_rad=(0.1, 0.2, 0.1)
                    )
            return answers

        return provider

    # "one" is trusted most but knows only a; "two" knows both, in an object frame turned by a quarter
    providers = {"one": say("one", {"a": 0.9}, np.eye(3)), "two": say("two", {"a": 0.3, "b": 0.5}, quarter)}
    monkeypatch.setattr(stage_module, "PROVIDERS", {**providers, "upright": stage_module.PROVIDERS["upright"]})
    out, run = run_poses(tmp_path)
    summary = read_json(out / "poses.json")
    assert summary["won"] == {"a": "one", "b": "two"}
    # no clip is left in doubt, so nobody else is asked
    assert [p["provider"] for p in summary["providers_tried"]] == ["one", "two"]
    first, second = (read_poses(out / f"{n}.json").object_to_camera[0, :3, :3] for n in "ab")
    assert np.abs(first - second).max() < 0.15  # in one frame (up to where each object is in the picture)
    assert summary["trust"] == 0.5 and run.warnings == []
    assert [read_poses(out / f"{n}.json").wave_rad for n in "ab"] == [(0.1, 0.2, 0.1), None]
    out.rename(tmp_path / "sure")
    monkeypatch.setattr(stage_module, "PROVIDERS", {"one": say("one", {"a": 0.4, "b": 0.6}, np.eye(3))})
    out, _ = run_poses(tmp_path)  # in doubt, nobody knows how far it is off
    assert [read_poses(out / f"{n}.json").wave_rad for n in "ab"] == [None, (0.1, 0.2, 0.1)]


def test_an_empty_mask_is_said(tmp_path: Path) -> None:
    write_clip(tmp_path, "a", np.linspace(0, 0.3, 3))
    for path in (tmp_path / "masks" / "a").glob("*.png"):
        write_image(path, np.zeros((SIDE, SIDE), np.uint8))
    with pytest.raises(BadInput, match="no object was found in a"):
        run_poses(tmp_path)


def test_raw_clips_are_searched_and_shown(tmp_path: Path, monkeypatch: Any) -> None:
    truth = {
        "a": write_clip(tmp_path, "a", np.linspace(-0.9, 1.2, 16)),
        "b": write_clip(tmp_path, "b", np.linspace(3.6, 1.0, 16), distance=3.6),
    }
    little = Effort(starts=3, rounds=10, fine_rounds=2, frames=28, coarse_px=16, fine_px=18)
    monkeypatch.setitem(stage_module.PROVIDERS, "search", partial(search, effort=little))
    out, run = run_poses(tmp_path, provider="search")
    tracks = {name: read_poses(out / f"{name}.json") for name in truth}
    relative = [
        [m[-1, :3, :3].T @ m[0, :3, :3] for m in (track, truth[name])]
        for name, track in ((n, t.object_to_camera) for n, t in tracks.items())
    ]
    for found, true in relative:  # each clip turns the right way by about the right amount
        cosine = (np.trace(found.T @ true) - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 35
    ratio = np.median(tracks["b"].object_to_camera[:, 2, 3]) / np.median(tracks["a"].object_to_camera[:, 2, 3])
    assert ratio == pytest.approx(3.6 / 3.0, rel=0.12)  # one scale for both clips
    assert "trust" in run.metrics
    picture = tmp_path / "sheet.png"
    _sheet(out=out, frames={n: Folder(tmp_path / "frames" / n) for n in truth}, picture=picture)
    assert picture.stat().st_size > 2000
    assert len(read_clip(tmp_path / "frames" / "a")) == 16


def test_a_wish_to_stop_is_heard_during_the_search(
    tmp_path: Path, clips: dict[str, np.ndarray], monkeypatch: Any
) -> None:
    from pipeline import Interrupted

    names = sorted(clips)
    inputs = {kind: {n: Folder(tmp_path / kind / n) for n in names} for kind in ("frames", "masks", "flow", "features")}
    run = Run()

    def provider(subjects: list[Subject], seed: int, tell: Tell) -> dict[str, Answer]:
        run.request_stop()
        tell(1, 2, "searching")
        raise AssertionError("went on after the wish to stop")

    monkeypatch.setattr(stage_module, "PROVIDERS", {"search": provider})
    (tmp_path / "out").mkdir()
    with pytest.raises(Interrupted):
        poses(**inputs, given={n: Given() for n in names}, settings=PosesSettings(), out=tmp_path / "out", run=run)
