"""retarget: a known model is driven by a new clip. The stages of ``banmo retarget`` that the main pipeline lacks.

``known`` holds what is driven, ``posture`` finds the limbs of the clip's subject, ``onto`` puts root poses and limbs on
the model, ``track`` finds the clip's codes with everything shared frozen, ``motion`` writes the files: the model's GLB
with one more animation, and an overlay. Here are the first and the fourth.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from pipeline import BadInput, Folder, InputFile, Resources, Run, Scene, stage
from stages import formats
from stages.checkpoint import Checkpoints
from stages.collect import Collection, collect
from stages.model.banmo import Banmo
from stages.model.motion import octaves_for, splines_for
from stages.retarget_files import HANDED, read_handed
from stages.retargeting.articulation import first_articulation
from stages.retargeting.driven import ClipSettings, ClipTrainer, driven_model, known_codes, start_codes
from stages.retargeting.handing import follow_points

_NO_FOLDER = InputFile("")
_KEPT = ("model.safetensors", "model.json")
_RIG = ("model.glb", "bones.json", "rest.ply")
_CHECKPOINT_STEPS = 50


@dataclass(frozen=True)
class KnownSettings:
    """Which model is driven. ``banmo retarget`` fills these in."""

    model: InputFile = _NO_FOLDER
    """Folder with the fitted model: the result of a workspace's last optimisation phase."""
    rig: InputFile = _NO_FOLDER
    """Folder with its exported files: model.glb, bones.json, rest.ply."""


@dataclass(frozen=True)
class TrackSettings(ClipSettings):
    """The driving clip's codes; the model itself is frozen."""

    iterations: int = 300
    """Steps of gradient descent, following pixels."""
    limb_steps: int = 200
    """Steps of gradient descent, following limbs."""
    motion_period_s: float = 0.25
    """Fastest motion that the pose codes can follow."""
    motion_spacing_s: float = 0.0
    """Spacing of local functions of time that join the pose codes; 0 = none."""
    same_subject: bool = False
    """The clip shows the very subject of the model: its colours count."""
    known_frames: int = 160
    """Frames of the known clips whose articulation may start a frame."""
    flow_steps: tuple[int, ...] = (1, 4)
    """Frame steps of the optical flow that are used, both ways."""
    lr_sdf: float = 0.0
    """Frozen."""
    lr_colour: float = 0.0
    """Frozen."""
    lr_bones: float = 0.0
    """Frozen."""
    lr_delta: float = 0.0
    """Frozen."""
    lr_motion: float = 1e-2
    """Step size of the clip's body pose code."""
    lr_root: float = 2e-3
    """Step size of its root pose correction; given poses are held whatever it is (see poses.refine)."""
    lr_environment: float = 1e-2
    """Step size of its light code, where colours count."""
    warmup_steps: int = 20
    """Steps over which the step sizes rise from zero."""
    beta_start: float = 0.02
    """Width of the Laplace density at the start (object about 2 long)."""
    weight_feature: float = 0.0
    """Rendered embedding against the pixel's features; only where one network spoke for both."""
    feature_pull: float = 1.0
    """Share of that term's pull that the motion gets: the embedding is frozen here."""
    weight_cycle_2d: float = 0.0
    """Matched point projected back onto its pixel (L_2D-cyc), in image sizes."""
    weight_cycle_3d: float = 0.0
    """Backward then forward warp returns (L_3D-cyc); codes alone hardly change it."""
    update_bounds_every: int = 50
    """Steps between updates of each frame's near and far planes."""


@stage(per=Scene, version=1)
def known(settings: KnownSettings, out: Path, run: Run) -> None:
    """The model that is driven, and its exported rig."""
    for setting, names in ((settings.model, _KEPT), (settings.rig, _RIG)):
        if not setting:
            raise BadInput("no model to drive is named", hint="use `banmo retarget --model WORKSPACE --video CLIP`")
        for name in names:
            if not (Path(setting) / name).is_file():
                raise BadInput(f"there is no {name} in the model's folder", where=str(setting))
            shutil.copyfile(Path(setting) / name, out / name)
    run.metric("videos", len(formats.read_json(out / "model.json")["videos"]))


@stage(per=Scene, version=1, needs=Resources(cpus="all", gpus=1))
def track(
    known: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    flow: dict[str, Folder],
    features: dict[str, Folder],
    onto: Folder,
    settings: TrackSettings,
    out: Path,
    run: Run,
) -> None:
    """The known model driven by the clip: its body, root and light codes found, everything else frozen.

    Following limbs, its body motion goes where `onto` hands it; following pixels, codes are found by rendering.
    """
    torch.set_num_threads(max(1, run.threads))
    collection = collect(frames, masks, flow, features, onto, settings.flow_steps, run)
    if len(collection.videos) != 1:
        raise BadInput("one clip drives a model at a time", hint="name a single video")
    checkpoints = Checkpoints(run.checkpoint_dir)
    saved = checkpoints.latest()
    if (onto / HANDED).is_file():
        driven = _unmoved(Banmo.restore(*formats.read_model(known.path)), collection, settings)
        _write_track(out, driven, _along(driven, onto.path, settings, run), run)
        return
    if saved is not None:
        driven = Banmo.restore(saved.model_tensors(), saved.description)
    else:
        driven = _first(Banmo.restore(*formats.read_model(known.path)), collection, settings, run)
    driven.to(run.device)
    trainer = ClipTrainer(driven, collection.observations, _weights(settings))
    history: list[dict[str, float]] = []
    if saved is not None:
        trainer.restore(saved.tensors)
        history = saved.history
    while not trainer.done:
        if run.stop_requested:
            checkpoints.save(trainer.state(), driven.describe(), trainer.step_idx, history)
            run.interrupt()
        values = trainer.step()
        run.tick(trainer.step_idx, settings.iterations, "tracking", loss=values["total"])
        if trainer.step_idx % 10 == 0 or trainer.done:
            history.append({"step": trainer.step_idx, **{k: round(v, 7) for k, v in values.items()}})
        if trainer.step_idx % _CHECKPOINT_STEPS == 0 and not trainer.done:
            checkpoints.save(trainer.state(), driven.describe(), trainer.step_idx, history)
    _write_track(out, driven.to("cpu"), history, run)


@track.check
def _check_track(out: Path) -> None:
    tensors, _ = formats.read_model(out)
    broken = [name for name, value in tensors.items() if value.is_floating_point() and not torch.isfinite(value).all()]
    if broken:
        raise formats.FormatError(f"model.safetensors: {broken[0]} is not finite")


# --------------------------------------------------------------------------------------------- parts


def _along(driven: Banmo, where: Path, settings: TrackSettings, run: Run) -> list[dict[str, float]]:
    """The driven model's motion through the handed places of its surface; the curve of what is left."""
    given = read_handed(where)
    history: list[dict[str, float]] = []

    def tick(done: int, total: int, left: float) -> None:
        if run.stop_requested:
            run.interrupt()
        run.tick(done, total, "following limbs", loss=left)
        if done % 10 == 0 or done == total:
            history.append({"step": done, "total": round(left, 7)})

    left = follow_points(driven, given.surface, given.handed.points, settings.limb_steps, 0.02, tick)
    run.metric("limbs_left", round(float(left.mean()), 4))
    return history


def _write_track(out: Path, driven: Banmo, history: list[dict[str, float]], run: Run) -> None:
    formats.write_model(out, driven.state_dict(), driven.describe())
    lines = "".join(json.dumps(row) + "\n" for row in history)
    (out / "metrics.jsonl").write_text(lines, encoding="utf-8")
    for name, value in history[-1].items() if history else ():
        if name != "step":
            run.metric(f"loss_{name}", value)


def _weights(settings: TrackSettings) -> TrackSettings:
    """Colours of another subject say nothing."""
    return settings if settings.same_subject else replace(settings, weight_rgb=0.0, lr_environment=0.0)


def _unmoved(model: Banmo, collection: Collection, settings: TrackSettings) -> Banmo:
    """The driven model in its mean articulation at the clip's root poses."""
    video = collection.videos[0]
    length = video.time_s[-1] - video.time_s[0]
    octaves = octaves_for(length, settings.motion_period_s)
    splines = splines_for(length, settings.motion_spacing_s)
    driven = driven_model(model, video, collection.camera_from_object, octaves, settings.seed, splines)
    driven.root_free.copy_(1 - collection.root_fixed)
    return driven


def _first(model: Banmo, collection: Collection, settings: TrackSettings, run: Run) -> Banmo:
    """The driven model with each frame in the known articulation that fits its mask best."""
    driven = _unmoved(model, collection, settings)
    start, misfit = first_articulation(
        model,
        collection.camera_from_object,
        collection.intrinsics[0],
        collection.observations,
        most=settings.known_frames,
    )
    start_codes(driven, known_codes(model)[start])
    run.log.info("known frames that start: %s", sorted(set(start.tolist())))
    run.metric("start_misfit", round(float(misfit.mean()), 4))
    return driven
