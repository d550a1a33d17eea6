"""optimise: a phase that is stopped, or that diverges once, ends as if nothing had happened; its folder is whole."""

from __future__ import annotations

import json
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline import BadInput, Interrupted, Run
from stages import formats, optimise, phases
from stages.checkpoint import Checkpoints
from stages.collect import Collection
from stages.fitting import trainer as training
from stages.fitting.rethink import Rethought
from stages.model.banmo import Banmo
from tests.numerics.analytic_scene import model_of, scene, sphere, stir, tiny_settings

STEPS = 8
SETTINGS = tiny_settings(iterations=STEPS, pixels_per_frame=12)
FRAMES = 3


class StopsAfter(Run):
    """Is asked to stop once `steps` are done."""

    def __init__(self, steps: int, checkpoint_dir: Path) -> None:
        super().__init__(checkpoint_dir=checkpoint_dir)
        self.steps = steps

    def tick(self, done: float, *rest: Any, **extra: Any) -> None:
        if done >= self.steps:
            self.request_stop()


@pytest.fixture(scope="module")
def collection(tmp_path_factory: pytest.TempPathFactory) -> Collection:
    root = tmp_path_factory.mktemp("frames")
    seen = scene(sphere(0.5), frames=FRAMES)
    clips = {}
    for v, facts in enumerate(seen.videos):
        folder = root / facts.name
        folder.mkdir()
        clips[facts.name] = formats.Clip(folder, facts.width, facts.height, np.arange(FRAMES), np.array(facts.time_s))
        for f, name in enumerate(clips[facts.name].names):
            formats.write_image(folder / name, seen.images[v * FRAMES + f])
    return Collection(
        observations=seen.observations,
        camera_from_object=seen.poses,
        intrinsics=seen.intrinsics,
        videos=seen.videos,
        root_fixed=torch.zeros(2),
        confidence=[np.ones(FRAMES)] * 2,
        clips=clips,
    )


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phases, "_CHECKPOINT_STEPS", 3)
    monkeypatch.setattr(phases, "_METRIC_STEPS", 2)


def first_model() -> Banmo:
    model = model_of(scene(sphere(0.5), frames=FRAMES), lambda x: x.norm(dim=-1) - 0.45)
    stir(model, 0.1)
    return model


def work(collection: Collection, out: Path, run: Run) -> None:
    """What ``fit`` does once its inputs are read."""
    out.mkdir()
    checkpoints = Checkpoints(run.checkpoint_dir)
    saved = checkpoints.latest()
    model = first_model() if saved is None else Banmo.restore(saved.model_tensors(), saved.description)
    phases.run_phase(model, collection, SETTINGS, checkpoints, out, run, "fitting")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def undisturbed(collection: Collection, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    root = tmp_path_factory.mktemp("straight")
    before = phases._METRIC_STEPS
    phases._METRIC_STEPS = 2
    try:
        work(collection, root / "out", Run(checkpoint_dir=root / "points"))
    finally:
        phases._METRIC_STEPS = before
    return contents(root / "out")


def test_a_phase_leaves_a_whole_folder(collection: Collection, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    assert set(undisturbed) == {
        "model.safetensors", "model.json", "metrics.jsonl", "previews/overlay.png",
        "poses/clip0.json", "poses/clip1.json",
    }  # fmt: skip
    for name, data in undisturbed.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    optimise._check(tmp_path, dict.fromkeys(collection.clips))
    with pytest.raises(formats.FormatError, match="videos"):
        optimise._check(tmp_path, {"another": None})
    assert [line.split(",")[0] for line in undisturbed["metrics.jsonl"].decode().splitlines()] == [
        f'{{"step": {s}' for s in (2, 4, 6, 8)
    ]


@pytest.mark.parametrize("stops", [(2,), (3, 5)])
def test_a_stopped_phase_ends_as_an_undisturbed_one(
    collection: Collection, undisturbed: dict[str, bytes], tmp_path: Path, stops: tuple[int, ...]
) -> None:
    for n, steps in enumerate(stops):
        with pytest.raises(Interrupted):
            work(collection, tmp_path / f"out{n}", StopsAfter(steps, tmp_path / "points"))
        latest = Checkpoints(tmp_path / "points").latest()
        assert latest is not None and latest.step == steps
        assert not any((tmp_path / f"out{n}").iterdir())
    work(collection, tmp_path / "out", Run(checkpoint_dir=tmp_path / "points"))
    assert contents(tmp_path / "out") == undisturbed


def test_a_killed_phase_ends_as_an_undisturbed_one(
    collection: Collection, undisturbed: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a chance to save: the steps since the last checkpoint are made again."""
    monkeypatch.setattr(training, "evaluate", failing_at(5, RuntimeError("killed")))
    with pytest.raises(RuntimeError, match="killed"):
        work(collection, tmp_path / "out0", Run(checkpoint_dir=tmp_path / "points"))
    monkeypatch.undo()
    monkeypatch.setattr(phases, "_METRIC_STEPS", 2)
    latest = Checkpoints(tmp_path / "points").latest()
    assert latest is not None and latest.step == 3
    work(collection, tmp_path / "out", Run(checkpoint_dir=tmp_path / "points"))
    assert contents(tmp_path / "out") == undisturbed


def test_second_thoughts_are_left_when_asked_to_stop(
    collection: Collection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are long: what is lost is they and the steps since the last checkpoint, and the end is the same."""

    def thinks_about_everything(model: Banmo, seen: Any, figures: Any, practise: Any, *more: Any) -> Rethought:
        practise(deepcopy(model), seen)
        return Rethought(6, 0, 0.0)

    class StopsThinking(Run):
        def tick(self, done: float, total: float = 0, label: str = "", **extra: Any) -> None:
            if label == "having second thoughts":
                self.request_stop()

    monkeypatch.setattr(training, "second_thoughts", thinks_about_everything)
    settings = replace(SETTINGS, rethink_at=(0.6,), rethink_share=0.8)

    def think(name: str, run: Run) -> dict[str, bytes]:
        (tmp_path / name).mkdir()
        checkpoints = Checkpoints(run.checkpoint_dir)
        saved = checkpoints.latest()
        model = first_model() if saved is None else Banmo.restore(saved.model_tensors(), saved.description)
        phases.run_phase(model, collection, settings, checkpoints, tmp_path / name, run, "fitting")
        return contents(tmp_path / name)

    with pytest.raises(Interrupted):
        think("stopped", StopsThinking(checkpoint_dir=tmp_path / "points"))
    latest = Checkpoints(tmp_path / "points").latest()
    assert latest is not None and latest.step == 3
    run = Run(checkpoint_dir=tmp_path / "points")
    assert think("resumed", run) == think("straight", Run(checkpoint_dir=tmp_path / "others"))
    assert run.metrics["frames_doubted"] == 6 and run.metrics["frames_reread"] == 0


def failing_at(call: int, failure: Exception | None = None, every: bool = False) -> Callable[..., dict]:
    """The objective, but its n-th call raises `failure`, or is not a number (from there on, if `every`)."""
    honest, calls = training.evaluate, [0]

    def evaluate(*arguments: Any, **named: Any) -> dict[str, torch.Tensor]:
        calls[0] += 1
        terms = honest(*arguments, **named)
        if calls[0] == call or (every and calls[0] > call):
            if failure is not None:
                raise failure
            terms["rgb"] = terms["rgb"] * torch.nan
        return terms

    return evaluate


def test_divergence_goes_back_and_on_with_half_the_step(
    collection: Collection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "evaluate", failing_at(6))
    run = Run(checkpoint_dir=tmp_path / "points")
    work(collection, tmp_path / "out", run)
    assert len(run.warnings) == 1
    assert "'rgb'" in run.warnings[0] and "step 5" in run.warnings[0] and "continued from step 3" in run.warnings[0]
    latest = Checkpoints(tmp_path / "points").latest()
    assert latest is not None and latest.step == 6
    assert float(latest.tensors["rate_scale"]) == 0.5
    tensors, _ = formats.read_model(tmp_path / "out")
    assert all(torch.isfinite(v).all() for v in tensors.values() if v.is_floating_point())


def test_divergence_that_stays_is_an_error(
    collection: Collection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "evaluate", failing_at(2, every=True))
    run = Run(checkpoint_dir=tmp_path / "points")
    with pytest.raises(training.Diverged, match="'rgb'"):
        work(collection, tmp_path / "out", run)
    assert 1 <= len(run.warnings) <= 3
    assert not any((tmp_path / "out").iterdir())


def test_a_phase_given_minutes_lays_its_schedule_over_the_steps_they_buy(
    collection: Collection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bought = iter([6, 99])
    monkeypatch.setattr(phases, "affordable_steps", lambda *_: next(bought))
    settings = tiny_settings(iterations=500, pixels_per_frame=12, minutes=2.0)
    checkpoints = Checkpoints(tmp_path / "points")
    run = StopsAfter(3, tmp_path / "points")
    with pytest.raises(Interrupted):
        phases.run_phase(first_model(), collection, settings, checkpoints, tmp_path / "out", run, "fitting")
    saved = checkpoints.latest()
    assert saved is not None and saved.step == 3
    model = Banmo.restore(saved.model_tensors(), saved.description)
    out = tmp_path / "out"
    out.mkdir()
    phases.run_phase(model, collection, settings, checkpoints, out, Run(checkpoint_dir=tmp_path / "points"), "fitting")
    last = json.loads((out / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 6  # what was bought at the start holds after a stop


def test_refinement_tells_how_each_frame_fits(collection: Collection, tmp_path: Path) -> None:
    small = {"frames_per_step": 4, "pixels_per_frame": 12, "probe_samples": 16, "fine_samples": 8}
    settings = optimise.RefineSettings(iterations=1, **small)
    run = Run(checkpoint_dir=tmp_path / "points")
    phases.run_phase(
        first_model(), collection, settings, Checkpoints(tmp_path / "points"), tmp_path, run, "refining", diagnose=True
    )
    told = json.loads((tmp_path / "diagnosis.json").read_text())["videos"]
    assert set(told) == {"clip0", "clip1"}
    for name, figures in told.items():
        assert figures["frames"] == collection.clips[name].names
        assert all(len(v) == FRAMES for v in figures.values())
        assert all(0.5 < v <= 1 for v in figures["overlap"])
        assert run.metrics[f"overlap_{name}"] > 0.5


@pytest.mark.parametrize(("section", "key"), [("fit", "blending"), ("fit", "deformation"), ("refine", "rate")])
def test_a_choice_that_is_none_is_said(section: str, key: str) -> None:
    settings = {"fit": optimise.FitSettings, "refine": optimise.RefineSettings}[section](**{key: "magic"})
    with pytest.raises(BadInput, match=rf"\[{section}\] {key} = 'magic' is none of "):
        optimise._check_choices(settings, section)
    optimise._check_choices(optimise.CorrectSettings(), "correct")
