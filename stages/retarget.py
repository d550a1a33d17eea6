"""retarget: a known model is driven by a new clip. The stages of ``banmo retarget`` that the main pipeline lacks.

``known`` holds what is driven, ``onto`` finds root poses on it, ``track`` finds the clip's codes with everything
shared frozen, ``motion`` writes the files: the model's GLB with one more animation, and an overlay.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline import BadInput, Folder, InputFile, Resources, Run, Scene, stage
from stages import formats
from stages.checkpoint import Checkpoints
from stages.collect import Collection, collect
from stages.fitting.observations import ObservationBuilder
from stages.model.banmo import Banmo
from stages.model.motion import octaves_for, splines_for
from stages.retargeting.articulation import first_articulation, known_shapes, spread
from stages.retargeting.driven import ClipSettings, ClipTrainer, driven_model, known_codes, start_codes
from stages.retargeting.placing import Placed, register, turn_onto

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
class OntoSettings:
    """How root poses of the driving clip are brought onto the known model."""

    shapes: int = 10
    """Articulations of the known model that are tried in each direction."""
    search: str = "auto"
    """auto, turn (keep the estimated rotations, turn them as a whole onto the model) or silhouettes (look anew)."""


@dataclass(frozen=True)
class TrackSettings(ClipSettings):
    """The driving clip's codes; the model itself is frozen."""

    iterations: int = 300
    """Steps of gradient descent."""
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


@stage(per=Scene, version=1, needs=Resources(cpus="all"))
def onto(
    known: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    poses: Folder,
    settings: OntoSettings,
    out: Path,
    run: Run,
) -> None:
    """Root poses of the clip in the known model's frame and scale; poses that were given are taken as they are."""
    if settings.search not in ("auto", "turn", "silhouettes"):
        raise BadInput(f"onto.search is {settings.search!r}", hint="known: auto, turn, silhouettes")
    torch.set_num_threads(max(1, run.threads))
    said = formats.read_json(poses / "poses.json")["videos"]
    videos: dict[str, dict[str, Any]] = {}
    for name, folder in frames.items():
        clip = formats.read_clip(folder.path)
        track = formats.read_poses(poses / f"{name}.json")
        provider = said[name]["provider"]
        misfit = 0.0
        if provider != "given":
            track, misfit = _onto_model(known, clip, masks[name], track, float(said[name]["trust"]), settings, run)
        trust = float(track.confidence.mean())
        videos[name] = {
            "provider": track.provider[0],
            "score": round(trust, 4),
            "trust": round(trust, 4),
            "misfit": round(misfit, 4),
            "fixed": bool(said[name]["fixed"]) and provider == "given",
        }
        formats.write_poses(out / f"{name}.json", track, clip)
        run.metric(f"misfit_{name}", round(misfit, 4))
        if trust < 0.5:
            run.warn(f"root poses of {name} on the model are a guess (trust {100 * trust:.0f} %); look at the overlay")
    formats.write_json(out / "poses.json", {"videos": videos, "trust": min(v["trust"] for v in videos.values())})


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
    """The known model driven by the clip: its body, root and light codes found, everything else frozen."""
    torch.set_num_threads(max(1, run.threads))
    collection = collect(frames, masks, flow, features, onto, settings.flow_steps, run)
    if len(collection.videos) != 1:
        raise BadInput("one clip drives a model at a time", hint="name a single video")
    checkpoints = Checkpoints(run.checkpoint_dir)
    saved = checkpoints.latest()
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
    driven.to("cpu")
    formats.write_model(out, driven.state_dict(), driven.describe())
    lines = "".join(json.dumps(row) + "\n" for row in history)
    (out / "metrics.jsonl").write_text(lines, encoding="utf-8")
    for name, value in history[-1].items() if history else ():
        if name != "step":
            run.metric(f"loss_{name}", value)


@track.check
def _check_track(out: Path) -> None:
    tensors, _ = formats.read_model(out)
    broken = [name for name, value in tensors.items() if value.is_floating_point() and not torch.isfinite(value).all()]
    if broken:
        raise formats.FormatError(f"model.safetensors: {broken[0]} is not finite")


# --------------------------------------------------------------------------------------------- parts


def _onto_model(
    known: Folder,
    clip: formats.Clip,
    masks: Folder,
    track: formats.PoseTrack,
    trust: float,
    settings: OntoSettings,
    run: Run,
) -> tuple[formats.PoseTrack, float]:
    """An estimated track turned onto the model, or one found anew by silhouettes; with its misfit."""
    model = Banmo.restore(*formats.read_model(known.path))
    surface = model.surface[spread(len(model.surface), 120)]
    shapes = known_shapes(model, spread(len(model.time), settings.shapes), surface)
    facts = formats.read_mask_facts(masks.path)
    builder = ObservationBuilder(steps=())
    images = formats.read_masks(masks.path, clip)
    for i in run.progress(range(len(clip)), label="reading masks"):
        weight = 0.0 if "missing" in facts.flags[i] else float(facts.confidence[i])
        builder.add(0, clip.image(i), images[i], {}, weight)
    observations = builder.finish()
    if not (observations.frame_weight > 0).any():
        raise BadInput("no frame of the clip shows the object", hint="give masks or a hints file beside it")
    k = torch.from_numpy(track.intrinsics).float()
    rotations = torch.from_numpy(track.object_to_camera[:, :3, :3]).float()
    found: list[tuple[float, str, Placed]] = []
    if settings.search in ("auto", "turn"):
        placed = turn_onto(shapes, rotations, k, observations, facts.box)
        # A track that knows near from far is worth more than outlines, which do not: it wins unless it fits far worse.
        found.append((placed.misfit * (0.6 if trust >= 0.5 else 0.9), "turned onto the model", placed))
    if settings.search in ("auto", "silhouettes"):
        placed = register(shapes, k, observations, facts.box)
        found.append((placed.misfit, "silhouettes", placed))
    _, provider, best = min(found, key=lambda row: row[0])
    run.log.info("root poses: %s", ", ".join(f"{name} misfit {p.misfit:.4f}" for _, name, p in found))
    poses = best.poses.double().numpy()
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = u @ vt
    confidence = best.confidence.numpy().astype(np.float64)
    if provider != "silhouettes":
        confidence = np.minimum(confidence, np.maximum(track.confidence, 0.3))
    return formats.PoseTrack(track.intrinsics, poses, confidence, [provider] * len(clip)), best.misfit


def _weights(settings: TrackSettings) -> TrackSettings:
    """Colours of another subject say nothing."""
    return settings if settings.same_subject else replace(settings, weight_rgb=0.0, lr_environment=0.0)


def _first(model: Banmo, collection: Collection, settings: TrackSettings, run: Run) -> Banmo:
    """The driven model with each frame in the known articulation that fits its mask best."""
    video = collection.videos[0]
    length = video.time_s[-1] - video.time_s[0]
    octaves = octaves_for(length, settings.motion_period_s)
    splines = splines_for(length, settings.motion_spacing_s)
    driven = driven_model(model, video, collection.camera_from_object, octaves, settings.seed, splines)
    driven.root_free.copy_(1 - collection.root_fixed)
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
