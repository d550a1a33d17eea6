"""posture: how the subject of the driving clip holds its limbs, as far as a category of ours knows such bodies.

A puppet of the category (stages.retargeting.puppet) is fitted to the clip: where its embedding says which point of
the body a pixel shows. The folder::

    posture.json      category, whether there is a posture and if not why, how well it fits
    posture.npz       the puppet in every kept frame (stages.retarget_files), if there is one
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from pipeline import BadInput, Folder, Resources, Run, Scene, stage
from stages import formats
from stages.geometry.cameras import project
from stages.own_networks import CATEGORIES
from stages.own_skeletons import own_puppet
from stages.retarget_files import read_posture, write_posture
from stages.retargeting.fitting import Effort, Seen, fit_clip, start_rotations, weak_misfit
from stages.retargeting.puppet import Puppet
from stages.retargeting.seeing import look

_SHEET_FRAMES, _SHEET_PX = 8, 256


@dataclass(frozen=True)
class PostureSettings:
    """How the driving subject's limbs are found."""

    rounds: int = 12
    """How often pixels look for their points on the body anew."""
    steps: int = 20
    """Steps of descent in between."""
    smooth: float = 0.3
    """Price of sudden motion."""
    seed: int = 0
    """Seed of the choice of pixels."""


@stage(per=Scene, version=1, needs=Resources(cpus="all"))
def posture(
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    features: dict[str, Folder],
    poses: Folder,
    settings: PostureSettings,
    out: Path,
    run: Run,
) -> None:
    """Limbs of the clip's subject in every kept frame, for subjects that a network of ours knows."""
    torch.set_num_threads(max(1, run.threads))
    if len(frames) != 1:
        raise BadInput("one clip drives a model at a time", hint="name a single video")
    name = next(iter(frames))
    clip = formats.read_clip(frames[name].path)
    info = formats.read_json(features[name] / "features.json")
    category = next((c for c in CATEGORIES if info["network"] == f"posenet-{c}.onnx"), "")
    if not category:
        why = f"the clip's embeddings are {info['network']}'s, and no canonical surface of ours goes with them"
        formats.write_json(out / "posture.json", {"found": False, "category": "", "why": why})
        run.log.info(why)
        return
    puppet = own_puppet(category)
    track = formats.read_poses(poses / f"{name}.json")
    seen = _seen(puppet, clip, masks[name], features[name], track, settings)
    said = formats.read_json(poses / "poses.json")["videos"][name]
    root, held = _start(puppet, seen, track, str(said["provider"]) == "given", run)
    effort = Effort(rounds=settings.rounds, steps=settings.steps, smooth=settings.smooth, hold_root=held)
    found = fit_clip(puppet, seen, root, effort, _ticking(run))
    write_posture(out, found)
    misfit = float(found.misfit[seen.weight.sum(1) > 0].mean())
    formats.write_json(
        out / "posture.json", {"found": True, "category": category, "why": "", "misfit": round(misfit, 4)}
    )
    run.metric("limbs", category)
    run.metric("misfit", round(misfit, 4))


@posture.check
def _check(out: Path, frames: dict[str, Folder]) -> None:
    if not formats.read_json(out / "posture.json")["found"]:
        return
    for folder in frames.values():
        found = read_posture(out, len(formats.read_clip(folder.path)))
        if not all(bool(torch.isfinite(v).all()) for v in (found.shape, found.orientations, found.shift)):
            raise formats.FormatError("posture.npz is not finite")


@posture.sheet
def _sheet(out: Path, frames: dict[str, Folder], poses: Folder, picture: Path) -> None:
    """The bones over some frames: warm is the subject's left, cold its right."""
    said = formats.read_json(out / "posture.json")
    rows = []
    for name, folder in frames.items():
        clip = formats.read_clip(folder.path)
        shown = np.unique(np.linspace(0, len(clip) - 1, min(len(clip), _SHEET_FRAMES)).round().astype(int))
        joints = np.zeros((0, 0, 2))
        puppet = own_puppet(said["category"]) if said["found"] else None
        if puppet is not None:
            found = read_posture(out, len(clip))
            k = torch.from_numpy(formats.read_poses(poses / f"{name}.json").intrinsics).float()
            joints = project(k, _ends(puppet, found.transforms(puppet))).numpy()
        for i in shown.tolist():
            image = clip.image(i)
            scale = _SHEET_PX / max(image.shape[:2])
            frame = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            if puppet is not None:
                _draw(frame, joints[i] * scale, puppet)
            canvas = np.zeros((_SHEET_PX, _SHEET_PX, 3), np.uint8)
            canvas[: frame.shape[0], : frame.shape[1]] = frame[:_SHEET_PX, :_SHEET_PX]
            rows.append(canvas)
    rows += [np.zeros_like(rows[0])] * (-len(rows) % 4)
    lines = [np.concatenate(rows[i : i + 4], axis=1) for i in range(0, len(rows), 4)]
    formats.write_image(picture, np.concatenate(lines))


# --------------------------------------------------------------------------------------------- parts


def _seen(
    puppet: Puppet,
    clip: formats.Clip,
    masks: Folder,
    features: Folder,
    track: formats.PoseTrack,
    settings: PostureSettings,
) -> Seen:
    facts = formats.read_mask_facts(masks.path)
    usable = np.array([0.0 if "missing" in facts.flags[i] else float(facts.confidence[i]) for i in range(len(clip))])
    if not (usable > 0).any():
        raise BadInput("no frame of the clip shows the object", hint="give masks or a hints file beside it")
    maps, crops = formats.read_features(features.path)
    rng = np.random.default_rng(settings.seed)
    return look(puppet, maps, crops, usable, track.intrinsics, clip.time_s, rng)


def _start(puppet: Puppet, seen: Seen, track: formats.PoseTrack, given: bool, run: Run) -> tuple[torch.Tensor, bool]:
    """Root rotations (N, 3, 3) of the puppet from those of the clip, and whether they are held.

    Poses that were given may be those of any frame of reference in the object: a constant turn goes to the puppet's.
    Estimated ones are kept unless the embeddings alone say something else altogether.
    """
    rotations = torch.from_numpy(track.object_to_camera[:, :3, :3]).float()
    alone = start_rotations(puppet, seen)
    known = seen.weight.sum(1) > 0
    u, _, vt = torch.linalg.svd((rotations.transpose(-1, -2) @ alone)[known].sum(0))
    turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))])) @ vt
    tried = {"as they are": rotations, "turned as a whole": rotations @ turn, "from the embedding": alone}
    misfits = {name: weak_misfit(puppet, seen, value) for name, value in tried.items()}
    run.log.info("root poses: %s", ", ".join(f"{name} misfit {value:.4f}" for name, value in misfits.items()))
    best = "as they are"
    if misfits["turned as a whole"] < 0.75 * misfits[best]:
        best = "turned as a whole"
    if not given and misfits["from the embedding"] < 0.75 * misfits[best]:
        best = "from the embedding"
    run.metric("root_start", best)
    return tried[best], given


def _ticking(run: Run) -> Callable[[int, int], None]:
    def tick(done: int, total: int) -> None:
        if run.stop_requested:
            run.interrupt()
        run.tick(done, total, "fitting limbs")

    return tick


def _ends(puppet: Puppet, transforms: torch.Tensor) -> torch.Tensor:
    """(N, 2 B, 3) joint and tip of every bone."""
    ends = torch.stack([puppet.joints, puppet.tips], 1)
    moved = (transforms[:, :, None, :, :3] @ ends[..., None]).squeeze(-1) + transforms[:, :, None, :, 3]
    return moved.flatten(1, 2)


def _draw(frame: np.ndarray, ends: np.ndarray, puppet: Puppet) -> None:
    for bone, name in enumerate(puppet.names):
        colour = (255, 120, 40) if name.endswith("_left") else (60, 150, 255) if name.endswith("_right") else (240,) * 3
        a, b = (tuple(int(v) for v in np.clip(ends[2 * bone + k], -4096, 4096).round()) for k in (0, 1))
        cv2.line(frame, a, b, colour, 2, cv2.LINE_AA)
        cv2.circle(frame, a, 3, colour, -1, cv2.LINE_AA)
