"""poses: root pose and intrinsics of every kept frame, given or estimated."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline import BadInput, Folder, Given, Resources, Run, Scene, stage
from stages import formats
from stages.own_networks import CATEGORIES, OwnNetwork, canonical_surface
from stages.perception.viewpoint import AZIMUTH_DEG, ELEVATION_DEG, ROLL_DEG, angle_log_probabilities
from stages.registration.answer import Answer, Provider, Subject, ViewBelief
from stages.registration.combine import combine
from stages.registration.cues import CROP_MARGIN, Cues, crop_embedding, crop_frame, principal_directions
from stages.registration.given import PoseDocumentError, parse_intrinsics, parse_transforms, scale_intrinsics
from stages.registration.ground import ground_elevations, plane_views
from stages.registration.placing import (
    default_intrinsics,
    depth_from_size,
    mask_boxes,
    place,
    ray_rotation,
    smooth,
    transforms,
)
from stages.registration.search import search
from stages.registration.seen import seen
from stages.registration.sheets import draw_pose, draw_surface, pose_sheet
from stages.registration.steadying import steady
from stages.registration.structure import structure_from_motion
from stages.registration.upright import upright

CROP_PX = 48
EMBEDDING_CHANNELS = 4
OTHER = "other"
APPEARANCE_ONLY = "builtin-appearance"
"""What features.json calls an embedding made of colours and edges, which the search sees anyway."""
LOW_TRUST = 0.5
GIVEN = ".poses.json"
PROVIDERS: dict[str, Provider] = {
    "network": seen,
    "search": search,
    "colmap": structure_from_motion,
    "upright": upright,
}
"""Providers by name, best first. `auto` asks one after the other until no clip is left in doubt, and takes the answers
that are trusted most (see combine)."""


@dataclass(frozen=True)
class PosesSettings:
    """Settings of the `poses` stage."""

    provider: str = "auto"
    """auto, given (refuse to guess), network (a category's own), search (any object), colmap or upright."""
    focal_px: float = 0.0
    """Focal length in pixels of the kept frames; 0 takes the file's own hint, or else the longer side."""
    refine: bool = False
    """Let the optimiser move root poses that were given, after their jitter is taken out; otherwise they are held."""
    seed: int = 0
    """Seed of the search."""


@stage(per=Scene, version=1, given=(GIVEN,), needs=Resources(cpus="all"))
def poses(
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    flow: dict[str, Folder],
    features: dict[str, Folder],
    given: dict[str, Given],
    settings: PosesSettings,
    out: Path,
    run: Run,
) -> None:
    """Root poses `<video>.json` of every clip in one common object space; `poses.json` says who found them."""
    if settings.provider not in ("auto", "given", *PROVIDERS):
        known = ", ".join(("auto", "given", *PROVIDERS))
        raise BadInput(f"poses.provider is {settings.provider!r}", hint=f"known: {known}")
    clips = {name: formats.read_clip(folder.path) for name, folder in frames.items()}
    documents = {name: path for name, g in given.items() if (path := g.get(GIVEN)) is not None}
    tracks = {name: read_given(documents[name], clips[name]) for name in clips if name in documents}
    if settings.refine:
        tracks = _steadied(tracks, clips, run)
    asked = [name for name in clips if name not in tracks]
    if asked and settings.provider == "given":
        raise BadInput(
            f"there are no root poses beside {asked[0]}", hint=f"add {asked[0]}{GIVEN}, or set poses.provider"
        )
    tried: list[dict[str, object]] = []
    answers: dict[str, Answer] = {}
    category = OTHER
    if asked:
        basis = _embedding_basis(features)
        network = _network(features, run)
        category = OTHER if network is None else network.category
        subjects = []
        for n in clips:
            subject = _subject(n, clips[n], masks[n], flow[n], features[n], basis, settings, tracks.get(n), run)
            subjects.append(subject if network is None else replace(subject, view=_view(clips[n], masks[n], network)))
        if network is not None:
            subjects = _on_ground(subjects, clips, settings, run)
        answers, tried = _ask(subjects, asked, settings, run)
        tracks |= {s.name: _track(s, answers[s.name]) for s in subjects if s.name in answers}
    for name, clip in clips.items():
        formats.write_poses(out / f"{name}.json", tracks[name], clip)
    _summarise(clips, tracks, answers, tried, category, settings, out, run)


def read_given(path: Path, clip: formats.Clip) -> formats.PoseTrack:
    """The user's own poses of one clip, checked, at its kept frames, in pixels of those frames.

    Raises:
        BadInput: unreadable, or not what it should be.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise PoseDocumentError("is not a JSON object with K and object_to_camera")
        matrices = parse_transforms(document, len(clip.source_time_s))
        intrinsics = parse_intrinsics(document)
    except (OSError, ValueError, OverflowError, RecursionError) as error:
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


def _steadied(
    tracks: dict[str, formats.PoseTrack], clips: dict[str, formats.Clip], run: Run
) -> dict[str, formats.PoseTrack]:
    """Given poses that the optimiser may move begin without their jitter: it moves them smoothly."""
    if not tracks:
        return tracks
    found = steady([track.object_to_camera for track in tracks.values()], [clips[name].time_s for name in tracks])
    run.metric("jitter_degrees", float(np.degrees(found.jitter_rad)))
    run.metric("jitter_units", found.jitter_units)
    return {
        name: replace(track, object_to_camera=made, wave_rad=wave)
        for (name, track), made, wave in zip(tracks.items(), found.tracks, found.wave_rad, strict=True)
    }


def _embedding_basis(features: dict[str, Folder]) -> np.ndarray | None:
    """Main directions (16, K) of the collection's embeddings; None where they only restate the colours."""
    samples = []
    for folder in features.values():
        if formats.read_json(folder / "features.json").get("network") == APPEARANCE_ONLY:
            return None
        maps, _ = formats.read_features(folder.path)
        some = np.asarray(maps[:: max(1, len(maps) // 10), ::3, ::3], np.float32).reshape(-1, maps.shape[-1])
        samples.append(some[np.abs(some).sum(axis=1) > 0])
    together = np.concatenate(samples)
    return principal_directions(together, EMBEDDING_CHANNELS) if len(together) > 100 else None


def category_of(verdicts: list[dict[str, Any]]) -> str:
    """The category that most clips' features.json name, each weighted by its margin; "other" if none is ours."""
    votes: dict[str, float] = {}
    for verdict in verdicts:
        name = str(verdict.get("category", OTHER))
        votes[name] = votes.get(name, 0.0) + 0.05 + max(float(verdict.get("margin", 0.0)), 0.0)
    best = max(votes, key=lambda name: votes[name])
    return best if best in CATEGORIES else OTHER


def _network(features: dict[str, Folder], run: Run) -> OwnNetwork | None:
    """The view network of the collection's category; None where we have none."""
    category = category_of([formats.read_json(folder / "features.json") for folder in features.values()])
    run.metric("category", category)
    return None if category == OTHER else OwnNetwork(category, device=run.device, threads=run.threads)


def _view(clip: formats.Clip, masks: Folder, network: OwnNetwork, chunk: int = 32) -> ViewBelief:
    """What the network makes of every frame; its azimuth is the object's turn, ours the camera's bearing."""
    probability = formats.read_masks(masks.path, clip)
    parts = []
    for start in range(0, len(clip), chunk):
        images = np.stack([clip.image(i) for i in range(start, min(start + chunk, len(clip)))])
        parts.append(angle_log_probabilities(images, probability[start : start + chunk], network))
    azimuth, elevation, roll = (np.concatenate(p) for p in zip(*parts, strict=True))
    return ViewBelief(
        azimuth, elevation, roll, -np.radians(AZIMUTH_DEG), np.radians(ELEVATION_DEG), np.radians(ROLL_DEG)
    )


def _on_ground(
    subjects: list[Subject], clips: dict[str, formats.Clip], settings: PosesSettings, run: Run
) -> list[Subject]:
    """The subjects; those whose root poses are asked for with the elevation that the ground tells, where it does."""
    views, focals = [], []
    for done, subject in enumerate(subjects):
        run.tick(done, len(subjects), label=f"looking at the ground of {subject.name}")
        if run.stop_requested:
            run.interrupt()
        clip = clips[subject.name]
        frame = subject.frame if subject.rotation is None else None
        views.append([] if frame is None else plane_views(len(clip), frame))
        focals.append((settings.focal_px or clip.focal_hint_px or 0.0) / max(clip.width, clip.height))
    known = float(np.median(focals)) if min(focals) > 0 else None
    elevations, focal = ground_elevations(views, [len(s.cues) for s in subjects], known)
    run.metric("ground_clips", sum(e is not None for e in elevations))
    run.metric("ground_focal", round(focal, 3))
    out = []
    for subject, elevation in zip(subjects, elevations, strict=True):
        if elevation is not None and subject.view is not None:
            clip = clips[subject.name]
            below = (subject.cues.centre_px[:, 1] - clip.height / 2) / (focal * max(clip.width, clip.height))
            subject = replace(subject, view=replace(subject.view, ground_elevation=elevation + np.arctan(below)))
        out.append(subject)
    return out


def _subject(
    name: str,
    clip: formats.Clip,
    masks: Folder,
    flow: Folder,
    features: Folder,
    basis: np.ndarray | None,
    settings: PosesSettings,
    track: formats.PoseTrack | None,
    run: Run,
) -> Subject:
    """Read one clip into small crops; only one full frame is in memory at a time."""
    probability = formats.read_masks(masks.path, clip)
    boxes, known = mask_boxes(probability)
    if not known.any():
        raise BadInput(f"no object was found in {name}", hint="look at its masks, or give a box in its .hints.toml")
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    half = CROP_MARGIN * np.maximum(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]) / 2
    # a pair of frames turns more than one frame does, and still matches well
    step = 2 if (flow / "fw-02").is_dir() else 1
    parts = []
    for i in range(len(clip)):
        run.tick(i, len(clip), label=f"reading {name}")
        path = formats.flow_path(flow.path, step, int(clip.source_idx[i]))
        motion = formats.read_flow(path) if path.exists() else None
        parts.append(crop_frame(clip.image(i), probability[i], motion, centre[i], half[i], CROP_PX))
    mask, colour, flow_px, confidence = (np.stack(part) for part in zip(*parts, strict=True))
    if basis is not None:
        maps, crops = formats.read_features(features.path)
        extra = [crop_embedding(maps[i], crops[i], basis, centre[i], half[i], CROP_PX) for i in range(len(clip))]
        colour = np.concatenate([colour, np.stack(extra) * (mask[..., None] > 0.05)], -1)
    edge = np.array([clip.width, clip.height, clip.width, clip.height]) - boxes
    cut = (boxes[:, :2] <= 1).any(axis=1) | (edge[:, 2:] <= 1).any(axis=1)
    cues = Cues(mask, colour, flow_px, confidence, centre, half, boxes, known, cut, step)

    def frame(i: int) -> tuple[np.ndarray, np.ndarray]:
        return clip.image(i), formats.read_grey(masks / clip.names[i])

    if track is None:
        intrinsics = default_intrinsics(clip.width, clip.height, settings.focal_px or clip.focal_hint_px)
        return Subject(name, cues, intrinsics, frame=frame)
    turned = ray_rotation(centre, track.intrinsics).transpose(0, 2, 1)
    rotation, depth = turned @ track.object_to_camera[:, :3, :3], track.object_to_camera[:, 2, 3]
    return Subject(name, cues, track.intrinsics, rotation, depth, frame=frame)


def _ask(
    subjects: list[Subject], asked: list[str], settings: PosesSettings, run: Run
) -> tuple[dict[str, Answer], list[dict[str, object]]]:
    """Ask the providers in order, and bring their answers together."""
    names = list(PROVIDERS) if settings.provider == "auto" else [settings.provider, "upright"]
    tried: list[dict[str, object]] = []
    answers: list[dict[str, Answer]] = []
    torch.set_num_threads(max(1, run.threads))

    def tell(done: int, total: int, label: str) -> None:
        run.tick(done, total, label=label)
        if run.stop_requested:
            run.interrupt()

    for provider in dict.fromkeys(names):
        answered = [max(a[n].trust for a in answers if n in a) for n in asked if any(n in a for a in answers)]
        if len(answered) >= len(asked) and min(answered) >= LOW_TRUST:
            continue
        found = PROVIDERS[provider](subjects, settings.seed, tell)
        answers.append(found)
        figures = {n: {"trust": round(a.trust, 3), **a.score} for n, a in found.items()}
        tried.append({"provider": provider, "videos": figures})
    return combine(answers, asked), tried


def _track(subject: Subject, answer: Answer) -> formats.PoseTrack:
    """From the crop's rotations to root poses: translation from the mask's box, depth smooth in time."""
    cues = subject.cues
    rotation = ray_rotation(answer.origin_px, subject.intrinsics) @ answer.rotation
    depth = depth_from_size(cues.box_px, subject.intrinsics, answer.extent)
    depth = np.exp(smooth(np.log(depth), 3.0))
    translation = place(answer.origin_px, depth, subject.intrinsics)
    confidence = np.where(cues.known, answer.confidence, 0.0)
    return formats.PoseTrack(
        subject.intrinsics,
        transforms(rotation, translation),
        confidence,
        [answer.provider] * len(cues),
        answer.wave_rad if answer.trust >= LOW_TRUST else None,
    )


def _summarise(
    clips: dict[str, formats.Clip],
    tracks: dict[str, formats.PoseTrack],
    answers: dict[str, Answer],
    tried: list[dict[str, object]],
    category: str,
    settings: PosesSettings,
    out: Path,
    run: Run,
) -> None:
    videos: dict[str, dict[str, Any]] = {}
    for name in clips:
        answer = answers.get(name)
        trust = 1.0 if answer is None else answer.trust
        provider = "given" if answer is None else answer.provider
        score = 1.0 if answer is None else float(np.mean(tracks[name].confidence))
        fixed = answer is None and not settings.refine
        videos[name] = {"provider": provider, "score": round(score, 4), "trust": round(trust, 4), "fixed": fixed}
    doubtful = [n for n in clips if videos[n]["trust"] < LOW_TRUST]
    if doubtful:
        named = ", ".join(f"{name} (trust {100 * videos[name]['trust']:.0f} %)" for name in doubtful)
        run.warn(
            f"root poses are a guess for {named}: give {doubtful[0]}{GIVEN} and the like, or film a slow walk all "
            "the way round the subject; `inspect poses` shows the guess"
        )
    trust = float(np.min([v["trust"] for v in videos.values()]))
    formats.write_json(
        out / "poses.json",
        {
            "providers_tried": tried or [{"provider": "given"}],
            "won": {name: v["provider"] for name, v in videos.items()},
            "videos": videos,
            "category": category,
            "trust": round(trust, 4),
            "advice": "" if not doubtful else f"check {', '.join(doubtful)} with `inspect poses`, or give root poses",
        },
    )
    run.metric("trust", trust)


@poses.check
def _check(out: Path, frames: dict[str, Folder]) -> None:
    """Every clip has a rigid, finite pose in front of the camera for each of its kept frames."""
    for name, folder in frames.items():
        clip = formats.read_clip(folder.path)
        track = formats.read_poses(out / f"{name}.json")
        if len(track.object_to_camera) != len(clip):
            raise formats.FormatError(f"{name}.json: {len(track.object_to_camera)} poses for {len(clip)} frames")
        if (track.object_to_camera[:, 2, 3] <= 0).any():
            raise formats.FormatError(f"{name}.json: an object behind the camera")


@poses.sheet
def _sheet(out: Path, frames: dict[str, Folder], picture: Path) -> None:
    """Each clip's frames with the category's surface, or axes and horizon, drawn in the estimated pose."""
    rows = []
    summary = formats.read_json(out / "poses.json")
    verdict, category = summary["videos"], summary.get("category", OTHER)
    surface = canonical_surface(category) if category in CATEGORIES else None
    for name, folder in frames.items():
        clip, track = formats.read_clip(folder.path), formats.read_poses(out / f"{name}.json")
        pick = np.unique(np.round(np.linspace(0, len(clip) - 1, min(9, len(clip)))).astype(int))
        drawn = []
        for i in pick:
            image, pose = clip.image(i), track.object_to_camera[i]
            # Only the network's answers stand in the frame of the category's surface.
            if surface is not None and verdict[name]["provider"] == "network":
                image = draw_surface(image, track.intrinsics, pose, surface["vertices"], surface["faces"])
            drawn.append(draw_pose(image, track.intrinsics, pose))
        title = f"{name}: {verdict[name]['provider']}, trust {100 * verdict[name]['trust']:.0f} %"
        rows.append((title, drawn, track.confidence[pick]))
    formats.write_image(picture, pose_sheet(rows))
