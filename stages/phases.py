"""One phase of the optimisation as a stage runs it: checkpoints, stops, setbacks, several processes, its folder."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pipeline import BadInput, Run
from stages import formats
from stages.checkpoint import Checkpoints
from stages.collect import Collection
from stages.fitting.budget import affordable_steps
from stages.fitting.curve import loss_curve
from stages.fitting.diagnose import misfits
from stages.fitting.gauge import settle
from stages.fitting.preview import preview_sheet
from stages.fitting.schedule import PhaseSettings
from stages.fitting.team import Team, joined
from stages.fitting.trainer import Diverged, Trainer
from stages.model.banmo import Banmo

_CHECKPOINT_STEPS = 50
_METRIC_STEPS = 10


def run_phase(
    model: Banmo,
    collection: Collection,
    settings: PhaseSettings,
    checkpoints: Checkpoints,
    out: Path,
    run: Run,
    label: str,
    settle_root: bool = False,
    diagnose: bool = False,
) -> None:
    """Train from the last checkpoint to the end, and write the phase's folder.

    Under torchrun's variables (``RANK``, ``WORLD_SIZE``, ``MASTER_ADDR``, ``MASTER_PORT``) the processes share every
    step; all read the same checkpoint folder, and the first alone writes. `settle_root` moves to the root what all
    bones share, unless root poses were given; `diagnose` writes ``diagnosis.json``.
    """
    if run.world_size > settings.frames_per_step:
        raise BadInput(
            f"{run.world_size} processes for {settings.frames_per_step} frames a step",
            hint="ask for fewer ranks, or raise frames_per_step",
        )
    device = _device(run)
    with joined(run.rank, run.world_size, device) as team:
        trainer, history = _train(model.to(device), collection, settings, checkpoints, run, team, label)
    if not team.leads:
        return
    model = trainer.model
    if settings.recur_at:
        for name, count in zip(("frames_paired", "frames_shared"), trainer.shared.tolist(), strict=True):
            run.metric(name, count)
    if settings.rethink_at:
        for name, count in zip(("frames_doubted", "frames_reread"), trainer.reread.tolist(), strict=True):
            run.metric(name, count)
    if diagnose:
        _diagnose(trainer, collection, out, run)
    if settle_root and model.dense is None:
        run.metric("root_settled_deg", round(math.degrees(settle(model)), 3))
    _write_folder(model.to("cpu"), collection, history, out)
    for name, value in history[-1].items() if history else ():
        if name != "step":
            run.metric(f"loss_{name}", value)


def _device(run: Run) -> str:
    """Where this process computes: of several GPUs on a machine, each process takes its own."""
    if run.device == "cuda" and run.world_size > 1:
        return f"cuda:{int(os.environ.get('LOCAL_RANK', '0')) % torch.cuda.device_count()}"
    return run.device


def _train(
    model: Banmo,
    collection: Collection,
    settings: PhaseSettings,
    checkpoints: Checkpoints,
    run: Run,
    team: Team,
    label: str,
) -> tuple[Trainer, list[dict[str, float]]]:
    """Train from the last checkpoint to the end; the leader of the team writes, all read. Returns metrics, too."""
    trainer = Trainer(model, collection.observations, settings, team)
    device = trainer.device
    history: list[dict[str, float]] = []
    saved = checkpoints.latest()
    if saved is not None:
        trainer.restore(saved.tensors)
        history = saved.history
        settings = replace(settings, iterations=int(saved.tensors["counters"][2]))
        trainer.settings = settings
    elif settings.minutes > 0:
        steps = team.agree(torch.tensor([affordable_steps(trainer, settings.minutes)], device=device))
        settings = replace(settings, iterations=int(steps))
        trainer.settings = settings
        run.metric("steps", settings.iterations)
    team.wait()  # until all have read the same checkpoint
    setbacks = 0

    def save() -> None:
        if team.leads:
            checkpoints.save(trainer.state(), model.describe(), trainer.step_idx, history)

    def pause(doing: str) -> None:
        """Second thoughts take a while: nothing is lost but them and the steps since the last checkpoint."""
        if team.any(run.stop_requested, device):
            run.interrupt()
        run.tick(trainer.step_idx, settings.iterations, doing)

    if saved is None:
        save()
    trainer.pause = pause
    while not trainer.done:
        if team.any(run.stop_requested, device):
            save()
            run.interrupt()
        try:
            values = trainer.step()
        except Diverged as error:
            setbacks += 1
            team.wait()  # until the leader's last checkpoint is in place
            saved = checkpoints.latest()
            if setbacks > 3 or saved is None:
                raise
            run.warn(f"{error}; continued from step {saved.step} with half the step size")
            scale = trainer.rate_scale / 2
            model = Banmo.restore(saved.model_tensors(), saved.description).to(device)
            trainer = Trainer(model, collection.observations, settings, team)
            trainer.restore(saved.tensors)
            trainer.rate_scale, history, trainer.pause = scale, saved.history, pause
            team.wait()
            continue
        if trainer.renewal_error is not None:
            run.log.info("new bones follow the old motion to %.4f units (rms)", trainer.renewal_error)
            run.metric("renewed_bones_rms", round(trainer.renewal_error, 5))
            trainer.renewal_error = None
        if trainer.recurred is not None:
            run.log.info("shared motion: %d frames paired, %d taken, %.4f units off (rms)", *trainer.recurred)
            trainer.recurred = None
        if trainer.rethought is not None:
            run.log.info("second thoughts: %d frames looked at, %d read anew, %.4f units off (rms)", *trainer.rethought)
            trainer.rethought = None
        if trainer.step_idx % _METRIC_STEPS == 0 or trainer.done:
            history.append({"step": trainer.step_idx, **{k: round(v, 7) for k, v in values.items()}})
        run.tick(trainer.step_idx, settings.iterations, label, loss=values["total"])
        if trainer.step_idx % _CHECKPOINT_STEPS == 0 and not trainer.done:
            save()
            if team.leads and run.device == "cpu":
                _write_preview(model, collection, checkpoints.root / "preview.png")
                (checkpoints.root / "loss.svg").write_text(loss_curve(history), encoding="utf-8")
    return trainer, history


def _diagnose(trainer: Trainer, collection: Collection, out: Path, run: Run) -> None:
    """``diagnosis.json``: how well each frame is explained; a warning names those far worse than their clip."""
    figures = trainer.figures()
    bad = misfits(figures.overlap, collection.observations.video_idx)
    videos: dict[str, dict[str, list[float | None] | list[str] | list[bool]]] = {}
    start = 0
    for i, (name, clip) in enumerate(collection.clips.items()):
        mine = slice(start, start + len(clip))
        start += len(clip)
        values = {key: _plain(getattr(figures, key)[mine]) for key in ("overlap", "flow_px", "feature")}
        confidence = _plain(torch.as_tensor(collection.confidence[i]))
        videos[name] = {"frames": clip.names, **values, "root_confidence": confidence, "misfit": bad[mine].tolist()}
        known = figures.overlap[mine][~figures.overlap[mine].isnan()]
        if len(known):
            run.metric(f"overlap_{name}", round(float(known.median()), 4))
        worst = [n for n, b in zip(clip.names, bad[mine].tolist(), strict=True) if b]
        if worst:
            some = ", ".join(worst[:4]) + (", ..." if len(worst) > 4 else "")
            run.warn(f"{name}: {len(worst)} of {len(clip)} frames fit far worse than the rest of the clip ({some})")
    formats.write_json(out / "diagnosis.json", {"videos": videos})


def _plain(values: torch.Tensor) -> list[float | None]:
    """Rounded for people; NaN, where there was nothing to compare with, becomes null."""
    return [None if math.isnan(v) else round(v, 4) for v in values.double().tolist()]


def _write_folder(model: Banmo, collection: Collection, history: list[dict[str, float]], out: Path) -> None:
    formats.write_model(out, model.state_dict(), model.describe())
    (out / "poses").mkdir()
    with torch.no_grad():
        for i, (name, clip) in enumerate(collection.clips.items()):
            poses = model.root_poses(i, torch.from_numpy(clip.time_s)).double().numpy()
            # float32 rotations are re-projected, so that the track stays rigid to the last digit.
            u, _, vt = np.linalg.svd(poses[:, :3, :3])
            poses[:, :3, :3] = u @ vt
            moved = "refined" if float(model.root_free[i]) > 0 else "given"
            track = formats.PoseTrack(
                model.intrinsics(i).double().numpy(), poses, collection.confidence[i], [moved] * len(clip)
            )
            formats.write_poses(out / "poses" / f"{name}.json", track, clip)
    lines = "".join(json.dumps(row) + "\n" for row in history)
    (out / "metrics.jsonl").write_text(lines, encoding="utf-8")
    (out / "previews").mkdir()
    _write_preview(model, collection, out / "previews" / "overlay.png")


def _write_preview(model: Banmo, collection: Collection, path: Path) -> None:
    images = []
    for i, clip in enumerate(collection.clips.values()):
        for frame in (len(clip) // 5, (4 * len(clip)) // 5):
            images.append((i, frame, clip.image(frame)))
    formats.write_image(path, preview_sheet(model, images[:12]))
