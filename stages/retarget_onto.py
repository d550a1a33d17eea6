"""onto: where the known model stands in the driving clip, and how it holds its limbs.

Following limbs, both come from the posture of the clip's subject, handed on to the model (stages.retargeting.handing).
Following pixels, root poses of the clip are turned onto the model or found anew by outlines. The folder::

    <clip>.json     root poses in the known model's frame and scale
    poses.json      who found them
    handed.npz      where the model's surface goes, if limbs are followed (stages.retarget_files)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline import BadInput, Folder, Resources, Run, Scene, stage
from stages import formats
from stages.fitting.known_poses import known_shapes, spread
from stages.fitting.observations import ObservationBuilder
from stages.meshing.skeleton import nearest_rigid
from stages.model.banmo import Banmo
from stages.own_skeletons import own_puppet
from stages.retarget_files import read_posture, write_handed
from stages.retargeting.matching import ALIKE, handed, likeness, model_surface
from stages.retargeting.placing import Placed, register, turn_onto


@dataclass(frozen=True)
class OntoSettings:
    """How root poses of the driving clip are brought onto the known model."""

    shapes: int = 10
    """Articulations of the known model that are tried in each direction."""
    follow: str = "auto"
    """limbs (limb by limb, for another individual of a category that a network of ours knows, whatever its build),
    pixels (outlines, flow and colours: the subject itself, or one of its build) or auto (limbs where it can be)."""
    search: str = "auto"
    """Following pixels: auto, turn (keep the estimated rotations, turn them as a whole onto the model) or silhouettes
    (look anew)."""


@stage(per=Scene, version=1, needs=Resources(cpus="all"))
def onto(
    known: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    poses: Folder,
    posture: Folder,
    settings: OntoSettings,
    out: Path,
    run: Run,
) -> None:
    """Root poses of the clip in the known model's frame and scale, and where its limbs go if limbs are followed.

    Following pixels, poses that were given are taken as they are.
    """
    if settings.search not in ("auto", "turn", "silhouettes"):
        raise BadInput(f"onto.search is {settings.search!r}", hint="known: auto, turn, silhouettes")
    if settings.follow not in ("auto", "limbs", "pixels"):
        raise BadInput(f"onto.follow is {settings.follow!r}", hint="known: auto, limbs, pixels")
    torch.set_num_threads(max(1, run.threads))
    if settings.follow != "pixels":
        why = _limbs(known, frames, poses, posture, out, run)
        if not why:
            return
        if settings.follow == "limbs":
            raise BadInput(f"limbs cannot be followed: {why}", hint="leave onto.follow at auto, or set pixels")
        run.log.info("following pixels: %s", why)
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


# --------------------------------------------------------------------------------------------- parts


def _limbs(known: Folder, frames: dict[str, Folder], poses: Folder, posture: Folder, out: Path, run: Run) -> str:
    """Write root poses and the limbs' places of the clip's subject on the model; empty, or why that cannot be."""
    said = formats.read_json(posture / "posture.json")
    if not said["found"]:
        return str(said["why"])
    model = Banmo.restore(*formats.read_model(known.path))
    if model.dense is not None:
        return "the model has no bones"
    puppet, surface = own_puppet(said["category"]), model_surface(model)
    alike = likeness(puppet, surface)
    run.metric("likeness", round(alike, 4))
    if alike < ALIKE:
        share = f"its embedding agrees on {100 * alike:.0f} % of it"
        return f"the model was not fitted with our network for this category ({share})"
    name, folder = next(iter(frames.items()))
    clip = formats.read_clip(folder.path)
    moving = read_posture(posture.path, len(clip))
    found, misfit = handed(puppet, surface, moving)
    write_handed(out, surface.points, found)
    track = formats.read_poses(poses / f"{name}.json")
    confidence = np.exp(-8 * moving.misfit.double().numpy()).clip(0, 1)
    roots = nearest_rigid(found.root.double().numpy())
    formats.write_poses(
        out / f"{name}.json", formats.PoseTrack(track.intrinsics, roots, confidence, ["limbs"] * len(clip)), clip
    )
    trust = round(float(confidence.mean()), 4)
    row = {"provider": "limbs", "score": trust, "trust": trust, "misfit": said["misfit"], "fixed": True}
    formats.write_json(out / "poses.json", {"videos": {name: row}, "trust": trust})
    run.metric("misfit_model", round(misfit, 4))
    return ""


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
