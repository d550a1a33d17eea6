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

from pipeline import BadInput, Folder, Given, InputFile, Resources, Run, Scene, stage
from stages import formats
from stages.checkpoint import Checkpoints
from stages.collect import Collection, collect
from stages.model.banmo import Banmo
from stages.model.motion import octaves_for
from stages.networks import NO_FILE
from stages.registration.given import PoseDocumentError, parse_intrinsics, parse_transforms, scale_intrinsics
from stages.registration.placing import default_intrinsics
from stages.retargeting.articulation import first_articulation, known_shapes, spread
from stages.retargeting.driven import ClipSettings, ClipTrainer, driven_model, known_codes, start_codes

GIVEN = ".poses.json"
_KEPT = ("model.safetensors", "model.json")
_RIG = ("model.glb", "bones.json", "rest.ply")
_CHECKPOINT_STEPS = 50


@dataclass(frozen=True)
class KnownSettings:
    """Which model is driven. ``banmo retarget`` fills these in."""

    model: InputFile = NO_FILE
    """Folder with the fitted model: the result of a workspace's last optimisation phase."""
    rig: InputFile = NO_FILE
    """Folder with its exported files: model.glb, bones.json, rest.ply."""


@dataclass(frozen=True)
class OntoSettings:
    """Root poses of the driving clip."""

    provider: str = "auto"
    """auto (given, else searched) or given (refuse to guess)."""
    focal_px: float = 0.0
    """Focal length in pixels of the kept frames; 0 takes the file's own hint, or else the longer side."""
    shapes: int = 10
    """Articulations of the known model that are tried in each direction."""
    refine: bool = False
    """Let root poses that were given move; searched ones always do."""


@dataclass(frozen=True)
class TrackSettings(ClipSettings):
    """The driving clip's codes; the model itself is frozen."""

    iterations: int = 300
    """Steps of gradient descent."""
    motion_period_s: float = 0.25
    """Fastest motion that the pose codes can follow."""
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
    """Step size of its root pose correction; given poses are held whatever it is (see onto.refine)."""
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


@stage(per=Scene, version=1, given=(GIVEN,), needs=Resources(cpus="all"))
def onto(
    known: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    given: dict[str, Given],
    settings: OntoSettings,
    out: Path,
    run: Run,
) -> None:
    """Root poses of the clip on the known model: given beside it, or searched for by its silhouettes."""
    if settings.provider not in ("auto", "given"):
        raise BadInput(f"onto.provider is {settings.provider!r}", hint="known: auto, given")
    torch.set_num_threads(max(1, run.threads))
    videos: dict[str, dict[str, Any]] = {}
    for name, folder in frames.items():
        clip = formats.read_clip(folder.path)
        path = given[name].get(GIVEN)
        if path is None and settings.provider == "given":
            raise BadInput(f"there are no root poses beside {name}", hint=f"add {name}{GIVEN}, or set onto.provider")
        track = _given(path, clip) if path else _searched(known, clip, masks[name], settings, run)
        trust = float(track.confidence.mean())
        fixed = path is not None and not settings.refine
        videos[name] = {"provider": track.provider[0], "score": trust, "trust": round(trust, 4), "fixed": fixed}
        formats.write_poses(out / f"{name}.json", track, clip)
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


def _given(path: Path, clip: formats.Clip) -> formats.PoseTrack:
    """The user's own poses at the kept frames, in pixels of those frames."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise PoseDocumentError("is not a JSON object with K and object_to_camera")
        matrices = parse_transforms(document, len(clip.source_time_s))
        intrinsics = parse_intrinsics(document)
    except (OSError, ValueError, RecursionError) as error:
        what = str(error) if isinstance(error, PoseDocumentError) else f"cannot be read as JSON ({error})"
        raise BadInput(
            f"{path.name} {what}", hint="give K and one rigid 4x4 object_to_camera a source frame"
        ) from error
    info = formats.read_json(clip.root / "frames.json")
    scale_x = clip.width / float(info.get("source_width", clip.width))
    scale_y = clip.height / float(info.get("source_height", clip.height))
    kept = matrices[clip.source_idx]
    return formats.PoseTrack(
        scale_intrinsics(intrinsics, scale_x, scale_y), kept, np.ones(len(kept)), ["given"] * len(kept)
    )


def _searched(known: Folder, clip: formats.Clip, masks: Folder, settings: OntoSettings, run: Run) -> formats.PoseTrack:
    """Root poses by comparing the model's known shapes with the masks, from everywhere."""
    from stages.fitting.observations import ObservationBuilder
    from stages.retargeting.placing import register

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
    k = default_intrinsics(clip.width, clip.height, settings.focal_px or clip.focal_hint_px)
    found = register(shapes, torch.from_numpy(k).float(), observations, facts.box)
    poses = found.poses.double().numpy()
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = u @ vt
    return formats.PoseTrack(k, poses, found.confidence.numpy().astype(np.float64), ["silhouettes"] * len(clip))


def _weights(settings: TrackSettings) -> TrackSettings:
    """Colours of another subject say nothing."""
    return settings if settings.same_subject else replace(settings, weight_rgb=0.0, lr_environment=0.0)


def _first(model: Banmo, collection: Collection, settings: TrackSettings, run: Run) -> Banmo:
    """The driven model with each frame in the known articulation that fits its mask best."""
    video = collection.videos[0]
    octaves = octaves_for(video.time_s[-1] - video.time_s[0], settings.motion_period_s)
    driven = driven_model(model, video, collection.camera_from_object, octaves, settings.seed)
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
