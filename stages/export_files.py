"""Meshes, cameras, bones and videos of the ``export`` folder; the rig's own formats are in ``export_rig``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from pipeline import Run
from stages import formats
from stages.meshing import pictures, ply
from stages.meshing.atlas import Atlas
from stages.meshing.coarse import Coarse
from stages.meshing.rig import Animatable, PosedClip, Rig
from stages.video_io import write_video

_TURNTABLE_FPS = 24


@dataclass(frozen=True)
class ExportedVideo:
    """One video as the stages before left it. root_confidence: (T,) of kept frames."""

    name: str
    clip: formats.Clip
    masks: Path
    facts: formats.MaskFacts
    root_confidence: np.ndarray

    def mask(self, frame_idx: int, width_px: int, height_px: int) -> np.ndarray:
        """(H, W) bool of a kept frame, at another size."""
        grey = formats.read_grey(self.masks / self.clip.names[frame_idx])
        return np.asarray(cv2.resize(grey, (width_px, height_px), interpolation=cv2.INTER_AREA)) > 127


@dataclass(frozen=True)
class Texture:
    """The surface's colour as a picture (S, S, 3) uint8 sRGB; from_frames: share of it that the frames coloured."""

    atlas: Atlas
    picture: np.ndarray
    from_frames: float


def write_rest(out: Path, rig: Rig, shown: np.ndarray, colour: np.ndarray, views: np.ndarray) -> None:
    """``rest.ply``: the pose shown (V, 3), colour (V, 3) in 0..1, views (V,) frames that saw each vertex.

    Property ``filled`` is 1 where the vertex closes a hole of the surface.
    """
    filled = np.arange(len(views)) >= len(views) - rig.facts.holes_closed
    extra = {"views": views.astype(np.float32), "filled": filled.astype(np.float32)}
    writer = ply.PlyWriter(rig.mesh.faces, ply.to_bytes(colour), extra)
    (out / "rest.ply").write_bytes(writer.encode(shown))


def write_cameras(out: Path, video: ExportedVideo, posed: PosedClip) -> None:
    """``cameras/<video>.json``: K and object_to_camera of every source frame."""
    (out / "cameras").mkdir(exist_ok=True)
    formats.write_json(
        out / "cameras" / f"{video.name}.json",
        {
            "K": posed.intrinsics.tolist(),
            "width": video.clip.width,
            "height": video.clip.height,
            "source_idx": list(range(len(posed.vertices))),
            "time_s": video.clip.source_time_s.tolist(),
            "object_to_camera": posed.camera_from_object.tolist(),
        },
    )


def write_meshes(out: Path, video: ExportedVideo, coarse: Coarse, posed: PosedClip, colour: np.ndarray) -> None:
    """``meshes/<video>/00000.ply``: the surface at every source frame, object space, on some of its vertices."""
    folder = out / "meshes" / video.name
    folder.mkdir(parents=True)
    writer = ply.PlyWriter(coarse.faces, ply.to_bytes(colour[coarse.vertex]), {})
    for i, vertices in enumerate(posed.vertices):
        (folder / f"{i:05d}.ply").write_bytes(writer.encode(vertices[coarse.vertex]))


def _look(rig: Rig, colour: np.ndarray, texture: Texture | None = None) -> pictures.Look:
    skin = rig.weights[:, rig.skeleton.bone] @ pictures.joint_palette(len(rig.skeleton))
    look = pictures.Look(rig.mesh.faces, colour, skin, rig.skeleton.parent)
    return look if texture is None else replace(look, texture=texture.picture, corner_uv=texture.atlas.corner_uv)


def write_turntable(
    out: Path,
    rig: Rig,
    shown: np.ndarray,
    joints: np.ndarray,
    colour: np.ndarray,
    texture: Texture | None,
    side_px: int,
    frames: int,
    run: Run,
) -> None:
    """``turntable.mp4``: the pose shown, vertices (V, 3) and joints (B, 4, 4), textured and by skin weights."""
    look = _look(rig, colour, texture)
    sticks = rig.skeleton.sticks(joints)
    images = pictures.turntable(look, shown, sticks, frames, max(2, side_px // 2 * 2))
    watched = run.progress(images, frames, "turntable")
    write_video(out / "turntable.mp4", watched, np.arange(frames) / _TURNTABLE_FPS)


def write_overlay(
    out: Path, video: ExportedVideo, rig: Rig, posed: PosedClip, colour: np.ndarray, side_px: int, run: Run
) -> None:
    """``overlay-<video>.mp4``: every source frame, the posed mesh over it, its bones; at the source's own times."""
    clip, look = video.clip, _look(rig, colour)
    width, height, _ = pictures.scaled_size(clip.width, clip.height, side_px)
    intrinsics = pictures.scaled_intrinsics(posed.intrinsics, clip.width, clip.height, width, height)
    # A source frame that was not kept is shown as the kept one before it.
    shown = np.maximum(np.searchsorted(clip.source_idx, np.arange(len(posed.vertices)), side="right") - 1, 0)

    def draw() -> Iterator[np.ndarray]:
        held = -1
        frame: np.ndarray = np.zeros((height, width, 3), np.uint8)
        for i, pose in enumerate(posed.camera_from_object):
            if shown[i] != held:
                held = int(shown[i])
                frame = np.asarray(cv2.resize(clip.image(held), (width, height), interpolation=cv2.INTER_AREA))
            points = posed.vertices[i] @ pose[:3, :3].T + pose[:3, 3]
            sticks = rig.skeleton.sticks(posed.joints[i]) @ pose[:3, :3].T + pose[:3, 3]
            yield pictures.overlay(look, points, sticks, intrinsics, frame)

    images = run.progress(draw(), len(posed.vertices), f"overlay {video.name}")
    write_video(out / f"overlay-{video.name}.mp4", images, clip.source_time_s)


def write_bones(out: Path, model: Animatable, rig: Rig) -> None:
    """``bones.json``: the tree of joints at rest and the Gaussian of each."""
    skeleton, scales = rig.skeleton, model.bone_scales.cpu().numpy()
    orientations = model.bone_orientations.cpu().numpy().astype(np.float64)
    share = rig.weights.mean(axis=0)
    record = {
        "space": "canonical: y up, z front",
        "meaning": "a joint is where the bone holds its parent; columns of orientation are the Gaussian's axes",
        "bones": [
            {
                "name": skeleton.names[j],
                "parent": skeleton.names[p] if p >= 0 else None,
                "model_bone": int(b),
                "joint": skeleton.rest[j, :3, 3].tolist(),
                "centre": skeleton.centre[j].tolist(),
                "orientation": orientations[b].tolist(),
                "scale": [float(v) for v in scales[b]],
                "surface_share": round(float(share[b]), 6),
            }
            for j, (b, p) in enumerate(zip(skeleton.bone, skeleton.parent, strict=True))
        ],
    }
    formats.write_json(out / "bones.json", record)
