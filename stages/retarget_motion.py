"""motion: what a user holds after retargeting: the known model's GLB with the driven motion as one more animation.

The folder::

    model.glb               the model's own file, and an animation named like the driving clip
    overlay-<clip>.mp4      the driving clip beside the model in its place and pose
    cameras/<clip>.json     K and object_to_camera of every source frame
    motion.json             facts: frames, seconds, how far the driven silhouette agrees with the clip's masks
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from pipeline import Folder, Resources, Run, Scene, stage
from stages import formats
from stages.animating.adding import NewMotion, add_motion
from stages.animating.glb import Animation, Glb, GlbError, read_glb
from stages.animating.playing import CV_FROM_GL, ROOT_MOTION, Player
from stages.animating.transfer import local_of, skeleton_of
from stages.geometry.raster import rasterise
from stages.meshing import pictures
from stages.meshing.skeleton import nearest_rigid
from stages.model.banmo import Banmo
from stages.rendering.film import surface_of
from stages.video_io import read_pictures, write_video

_IOU_FRAMES = 40


@dataclass(frozen=True)
class MotionSettings:
    """What is written."""

    video_side_px: int = 384
    """Longer side of one picture of the overlay."""


@stage(per=Scene, version=1, needs=Resources(cpus=1))
def motion(
    known: Folder,
    track: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    settings: MotionSettings,
    out: Path,
    run: Run,
) -> None:
    """The model's GLB with the driven motion added, an overlay to look at, cameras."""
    driven = Banmo.restore(*formats.read_model(track.path))
    name = driven.video_names[0]
    clip = formats.read_clip(frames[name].path)
    times = clip.source_time_s
    seconds = torch.from_numpy(times)
    bones = nearest_rigid(driven.bone_transforms(0, seconds).numpy())
    cameras = nearest_rigid(driven.root_poses(0, seconds).numpy())
    called = driven_name(read_glb((known / "model.glb").read_bytes()), name)
    data = add_motion((known / "model.glb").read_bytes(), _motion(known, called, times, bones, cameras))
    (out / "model.glb").write_bytes(data)
    intrinsics = driven.intrinsics(0).double().numpy()
    _write_cameras(out, clip, name, intrinsics, cameras)
    glb = read_glb(data)
    played = glb.animation(called)
    iou = _agreement(Player.of(glb), played, clip, masks[name], intrinsics, run)
    _write_overlay(out, name, Player.of(glb), played, clip, intrinsics, settings.video_side_px, run)
    facts = {
        "clip": name,
        "animation": called,
        "frames": len(times),
        "seconds": round(float(times[-1] - times[0]), 4),
        "iou_mean": None if not len(iou) else round(float(np.mean(iou)), 4),
    }
    formats.write_json(out / "motion.json", facts)
    if len(iou):
        run.metric("iou_mean", facts["iou_mean"])


@motion.check
def _check(out: Path, frames: dict[str, Folder]) -> None:
    """The GLB is whole and holds the clip."""
    glb = read_glb((out / "model.glb").read_bytes())
    called = formats.read_json(out / "motion.json")["animation"]
    for name in frames:
        if len(glb.animation(called).time_s) != len(formats.read_clip(frames[name].path).source_time_s):
            raise formats.FormatError(f"model.glb: animation {called} has not as many keys as the clip has frames")


@motion.sheet
def _sheet(out: Path, picture: Path) -> None:
    """Frames of the overlay, one below the other."""
    rows = [p for path in sorted(out.glob("overlay-*.mp4")) for p in read_pictures(path, 8)]
    formats.write_image(picture, np.concatenate(rows))


# --------------------------------------------------------------------------------------------- parts


def _motion(known: Folder, name: str, times: np.ndarray, bones: np.ndarray, cameras: np.ndarray) -> NewMotion:
    """The driven bones (T, B, 4, 4), canonical to object space, as local motion of the file's nodes."""
    glb = read_glb((known / "model.glb").read_bytes())
    rows = {row["name"]: row for row in formats.read_json(known / "bones.json")["bones"]}
    nodes, parent, _ = skeleton_of(glb)
    posed = np.zeros((len(times), len(nodes), 4, 4))
    for j, node in enumerate(nodes):
        row = rows.get(glb.names[node])
        if row is None:
            raise GlbError(f"model.glb has a joint {glb.names[node]!r} that bones.json does not name")
        rest = np.eye(4)
        rest[:3, 3] = row["joint"]
        posed[:, j] = bones[:, int(row["model_bone"])] @ rest
    local = local_of(posed, parent)
    moving = {node: local[:, j] for j, node in enumerate(nodes)}
    if ROOT_MOTION in glb.names:
        moving[glb.names.index(ROOT_MOTION)] = CV_FROM_GL @ cameras
    clock = key_times(times)
    return NewMotion(name, clock, moving, {"start_time_s": float(times[0]), "frames": len(times), "driven": True})


def driven_name(glb: Glb, name: str) -> str:
    """What the new animation is called: like the clip, unless the model has a clip of its own of that name."""
    own = {a.name for a in glb.animations if not a.extras.get("driven")}
    return name if name not in own else f"{name} (driven)"


def key_times(time_s: np.ndarray) -> np.ndarray:
    """Times (T,) float32 from zero that strictly increase, as glTF demands."""
    times = (np.asarray(time_s, np.float64) - time_s[0]).astype(np.float32)
    for i in range(1, len(times)):
        if times[i] <= times[i - 1]:
            times[i] = np.nextafter(times[i - 1], np.float32(np.inf))
    return times


def _write_cameras(out: Path, clip: formats.Clip, name: str, intrinsics: np.ndarray, cameras: np.ndarray) -> None:
    (out / "cameras").mkdir()
    formats.write_json(
        out / "cameras" / f"{name}.json",
        {
            "K": intrinsics.tolist(),
            "width": clip.width,
            "height": clip.height,
            "source_idx": list(range(len(cameras))),
            "time_s": clip.source_time_s.tolist(),
            "object_to_camera": cameras.tolist(),
        },
    )


def _before_camera(player: Player, played: Animation, key: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and joints (B, 3) before the clip's camera (OpenCV) at one key of the animation."""
    scene = player.scene(played, played.time_s[key : key + 1])
    points, _ = player.bones(scene)
    turn = CV_FROM_GL[:3, :3]
    return player.surface(scene)[0] @ turn, points[0] @ turn


def _agreement(
    player: Player, played: Animation, clip: formats.Clip, masks: Folder, intrinsics: np.ndarray, run: Run
) -> np.ndarray:
    """Intersection over union of the driven silhouette with the masks, at some kept frames."""
    found = []
    chosen = np.unique(np.linspace(0, len(clip) - 1, min(len(clip), _IOU_FRAMES)).round().astype(int))
    for i in run.progress(chosen.tolist(), label="comparing silhouettes"):
        mask = formats.read_grey(masks / clip.names[i]) > 127
        points, _ = _before_camera(player, played, int(clip.source_idx[i]))
        if not mask.any() or (points[:, 2] < 1e-3).any():
            continue
        drawn = rasterise(points, player.faces, intrinsics, clip.height, clip.width).covered
        found.append((drawn & mask).sum() / max(1, (drawn | mask).sum()))
    return np.array(found)


def _write_overlay(
    out: Path,
    name: str,
    player: Player,
    played: Animation,
    clip: formats.Clip,
    intrinsics: np.ndarray,
    side_px: int,
    run: Run,
) -> None:
    """``overlay-<clip>.mp4``: each source frame, the model over it, its joints."""
    width, height, _ = pictures.scaled_size(clip.width, clip.height, side_px)
    k = pictures.scaled_intrinsics(intrinsics, clip.width, clip.height, width, height)
    _, parent = player.bones(player.scene(None, np.zeros(1)))
    skin = player.skin_colour(pictures.joint_palette(len(parent)))
    drawn = surface_of(player)
    corner_uv = None if drawn.uv is None else drawn.uv[player.faces]
    look = pictures.Look(player.faces, player.colour, skin, parent, drawn.texture, corner_uv)
    shown = np.maximum(np.searchsorted(clip.source_idx, np.arange(len(clip.source_time_s)), side="right") - 1, 0)

    def draw() -> Iterator[np.ndarray]:
        for key in range(len(clip.source_time_s)):
            image = clip.image(int(shown[key]))
            frame = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
            points, joints = _before_camera(player, played, key)
            yield pictures.overlay(look, points, np.stack([joints, joints], axis=1), k, frame)

    pictured = run.progress(draw(), len(clip.source_time_s), f"overlay {name}")
    write_video(out / f"overlay-{name}.mp4", pictured, clip.source_time_s)
