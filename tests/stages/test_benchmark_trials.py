"""What the accuracy benchmarks rest on: wrong poses, scores as printed, rows that exist, a whole reconstruction."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks import ablations, optimiser, tier_a, tier_b, trials
from pipeline import Folder, Run
from stages import optimise, phases
from stages.collect import Collection
from stages.fitting.initialise import usable_frames
from stages.fitting.schedule import PhaseSettings
from stages.fitting.trainer import Trainer
from stages.formats import Clip, read_model
from stages.geometry.cameras import transform
from stages.optimise import CorrectSettings, FitSettings, RefineSettings
from stages.registration.given import parse_transforms
from stages.scoring.metrics import rotation_errors_deg
from tests.numerics.analytic_scene import Scene, orbit, scene, sphere

FEW = {"frames_per_step": 4, "pixels_per_frame": 24, "probe_samples": 16, "fine_samples": 8, "flow_steps": (1,)}
SMALL = (
    FitSettings(iterations=6, bones=3, voxel=0.08, pose_code=8, **FEW),
    CorrectSettings(iterations=2, **FEW),
    RefineSettings(iterations=2, **FEW),
)
PRINTED = """
fox-00       CD   1.234 cm (pred>gt 1.100, gt>pred 1.368)   F@1%  70.10  F@2%  95.20  F@5%  99.30
ALL          CD   1.684 cm (pred>gt 1.610, gt>pred 1.758)   F@1%  71.00  F@2%  92.24  F@5%  98.75
frames 75, missing 0, align video
"""


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(sphere(0.5), frames=4)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 50.0])
def test_shaken_poses_are_turned_by_that_angle_about_the_object(degrees: float) -> None:
    poses = orbit(40, 0.3)
    wrong = trials.shaken(poses, degrees, seed=1)
    centre = torch.zeros(1, 3)
    assert torch.allclose(
        transform(wrong, centre.expand(40, 1, 3)), transform(poses, centre.expand(40, 1, 3)), atol=1e-6
    )
    relative = poses[:, :3, :3].transpose(1, 2) @ wrong[:, :3, :3]
    angle = torch.rad2deg(torch.arccos(((relative.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1)))
    assert torch.allclose(angle, torch.full((40,), degrees), atol=0.1)
    assert torch.equal(wrong, trials.shaken(poses, degrees, seed=1))
    if degrees:
        assert not torch.allclose(wrong, trials.shaken(poses, degrees, seed=2))
        error = rotation_errors_deg(wrong[:, :3, :3].double().numpy(), poses[:, :3, :3].double().numpy())
        assert error.mean() == pytest.approx(degrees, rel=0.1)


def track(seed: int, frames: int = 40) -> list[list[list[float]]]:
    return orbit(frames, 0.3 + seed).double().tolist()


def test_wrong_poses_lie_beside_the_clips_and_the_truth_stays(tmp_path: Path) -> None:
    data, out = tmp_path / "fox", tmp_path / "out"
    for i, name in enumerate(("fox-00", "fox-01")):
        for folder in ("videos", "masks"):
            path = data / "clean" / folder / f"{name}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(folder)
        (data / "clean" / "gt").mkdir(exist_ok=True)
        truth = {"K": [[300, 0, 128], [0, 300, 128], [0, 0, 1]], "look": "clean", "object_to_camera": track(i)}
        (data / "clean" / "gt" / f"{name}.json").write_text(json.dumps(truth))
    tier_a.place(data, "clean", out)  # its links lead into the data set
    placed = tier_b.place_turned(data, "clean", out, 20.0, seed=1)
    assert sorted(p.name for p in placed) == sorted(p.name for p in out.iterdir())
    axes = []
    for i, name in enumerate(("fox-00", "fox-01")):
        assert (out / f"{name}.masks.mp4").read_text() == "masks"
        known = json.loads((data / "clean" / "gt" / f"{name}.json").read_text())
        assert known["object_to_camera"] == track(i)
        wrong = json.loads((out / f"{name}.poses.json").read_text())
        poses = parse_transforms(wrong, 40)
        assert {k: wrong[k] for k in ("K", "look")} == {k: known[k] for k in ("K", "look")}
        assert np.allclose(poses[:, :3, 3], np.array(known["object_to_camera"])[:, :3, 3], atol=1e-6)
        turn = np.array(known["object_to_camera"])[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3]
        axes.append(Rotation.from_matrix(turn).as_rotvec(degrees=True))
        assert np.allclose(np.linalg.norm(axes[-1], axis=1), 20, atol=0.01)
    assert np.abs(axes[0] - axes[1]).max() > 5, "every frame of every clip has an axis of its own"


def test_the_row_of_all_frames_is_read() -> None:
    score = trials.read_score(PRINTED)
    assert score == trials.Score(1.684, 1.61, 1.758, 71.0, 92.24, 98.75)
    with pytest.raises(RuntimeError, match="no row"):
        trials.read_score("Traceback")


def test_every_row_changes_settings_that_exist() -> None:
    preset = trials.presets("preview", scale=0.5, seed=3)
    assert [settings.seed for settings in preset] == [3, 3, 3]
    assert abs(preset[0].iterations - trials.presets("preview")[0].iterations / 2) <= 1
    same = [
        name
        for name, row in ablations.ROWS.items()
        if row.clips == 5 and row.given_roots and ablations.changed(row, preset) == preset
    ]
    assert same == ["full"]
    featureless = ablations.changed(ablations.ROWS["no-features"], preset)
    assert all(s.weight_feature == s.weight_match == s.weight_cycle_2d == 0 < s.weight_cycle_3d for s in featureless)


def test_a_reconstruction_of_a_ball_writes_its_surface(seen: Scene, tmp_path: Path) -> None:
    import trimesh

    known = trials.Seen(seen.observations, seen.poses, seen.intrinsics, seen.videos)
    assert len(usable_frames(seen.observations, 99)) == 8
    fit, correct, refine = SMALL
    model, seconds = trials.reconstruct(known, fit, replace(correct, iterations=0), replace(refine, iterations=0))
    assert seconds > 0
    trials.write_meshes(model, tmp_path, every=2, resolution=32)
    files = sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.ply"))
    assert files == ["clip0/00000.ply", "clip0/00002.ply", "clip1/00000.ply", "clip1/00002.ply"]
    ball = trimesh.load(tmp_path / files[0])
    radius = (ball.vertices**2).sum(1) ** 0.5
    assert 0.9 < radius.mean() < 1.1 and ball.volume > 0  # normalised to half extent 1


@pytest.mark.usefixtures("one_thread")  # as a stage that is given one
def test_the_phases_are_those_of_the_product(seen: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = trials.Seen(seen.observations, seen.poses, seen.intrinsics, seen.videos)
    model, _ = trials.reconstruct(known, *SMALL, hold_roots=False)
    clips = {v.name: Clip(tmp_path, v.width, v.height, np.arange(4), np.array(v.time_s)) for v in seen.videos}
    free, sure = torch.zeros(2), [np.ones(4)] * 2
    collection = Collection(seen.observations, seen.poses, seen.intrinsics, seen.videos, free, sure, clips)
    monkeypatch.setattr(optimise, "collect", lambda *_: collection)
    monkeypatch.setattr(phases, "_write_preview", lambda *_: None)
    nothing, before = ({}, {}, {}, {}, Folder(tmp_path)), []
    for stage, settings in zip((optimise.fit, optimise.correct, optimise.refine), SMALL, strict=True):
        out = tmp_path / stage.name
        out.mkdir()
        stage(*before, *nothing, settings, out, Run())
        before = [Folder(out)]
    tensors, _ = read_model(tmp_path / "refine")
    assert not torch.equal(tensors["gauge"], torch.eye(4).expand(8, 4, 4)), "the root was settled"
    mine = model.state_dict()
    assert set(mine) == set(tensors)
    assert [name for name in mine if not torch.equal(mine[name], tensors[name])] == []


def test_the_synthetic_clip_is_what_its_model_renders() -> None:
    observations, poses, videos = optimiser.synthetic(6, rows=400)
    settings = PhaseSettings(iterations=10, beta_start=0.01)
    trainer = Trainer(optimiser.model_of(poses, videos, "grid", "cpu"), observations, settings)
    assert float(trainer.figures().overlap.min()) > 0.9
    assert optimiser.step_seconds(trainer, 1) > 0
    assert optimiser.step_flops(trainer) > 1e6
