"""Stage: what a user holds at the end. A rigged, animated GLB, a mesh for every frame, cameras, videos, an honest report.

The folder::

    model.glb                   surface, skin, joints in a tree, one animation a video, root motion apart, cameras
    rest.ply                    the surface at rest; property ``views`` counts the frames that saw each vertex
    meshes/<video>/00042.ply    the surface articulated at every frame of the source, object space (root motion off)
    cameras/<video>.json        K and object_to_camera of every frame of the source, usable as a given ``.poses.json``
    bones.json                  joints: names, tree, Gaussians at rest
    turntable.mp4               the rest pose turning
    overlay-<video>.mp4         each source frame beside the posed mesh
    quality.json                how far to trust it, a video, a frame and overall
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import Folder, Resources, Run, Scene, stage
from stages import formats
from stages.geometry.raster import rasterise, vertex_normals
from stages.meshing import gltf, pictures, ply, quality
from stages.meshing.rig import Animatable, PosedClip, Rig, build_rig, pose_clip, surface_colour
from stages.model.banmo import Banmo
from stages.video_io import read_pictures, write_video

_QUALITY_SIDE_PX = 256


@dataclass(frozen=True)
class ExportSettings:
    """What is written, and how fine."""

    resolution: int = 256
    """Cells of the extraction grid along the longest edge of the object."""
    faces: int = 10_000
    """Faces of the exported mesh at most."""
    influences: int = 8
    """Bones that move a vertex at most; many viewers use the first four."""
    frame_meshes: bool = True
    """Write a mesh for every frame of every video."""
    video_side_px: int = 384
    """Longer side of one picture in the turntable and the overlays."""
    turntable_frames: int = 72
    """Pictures of one turn, at 24 a second."""


@dataclass(frozen=True)
class _Inputs:
    """One video as the stages before left it."""

    name: str
    clip: formats.Clip
    masks: Path
    facts: formats.MaskFacts
    root_confidence: np.ndarray

    def mask(self, frame_idx: int, width_px: int, height_px: int) -> np.ndarray:
        """(H, W) bool at another size."""
        grey = formats.read_grey(self.masks / self.clip.names[frame_idx])
        return np.asarray(cv2.resize(grey, (width_px, height_px), interpolation=cv2.INTER_AREA)) > 127


@stage(per=Scene, version=1, needs=Resources(cpus=1))
def export(
    refine: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    poses: Folder,
    settings: ExportSettings,
    out: Path,
    run: Run,
) -> None:
    """A rigged and animated GLB, meshes and cameras of every frame, videos to look at, and how far to trust them."""
    model = Banmo.restore(*formats.read_model(refine.path))
    inputs = []
    for name in model.video_names:
        track = formats.read_poses(refine / "poses" / f"{name}.json")
        clip, facts = formats.read_clip(frames[name].path), formats.read_mask_facts(masks[name].path)
        inputs.append(_Inputs(name, clip, masks[name].path, facts, track.confidence))
    summary = formats.read_json(poses / "poses.json") if (poses / "poses.json").is_file() else {}
    export_model(model, inputs, summary, settings, out, run)


def export_model(
    model: Animatable,
    inputs: list[_Inputs],
    pose_summary: dict[str, Any],
    settings: ExportSettings,
    out: Path,
    run: Run,
) -> None:
    """Write the whole folder for a model whose videos are `inputs`, in the model's order."""
    times = [video.clip.source_time_s for video in inputs]
    kept = max(1, settings.influences)
    rig = build_rig(model, times, settings.resolution, settings.faces, sorted({4, 8, kept}))
    run.log.info("surface: %d faces, %d joints", len(rig.mesh.faces), len(rig.skeleton))
    colours = [surface_colour(model, rig, k) for k in range(len(inputs))]
    colour = np.mean(colours, axis=0)

    views = np.zeros(len(rig.mesh.vertices))
    motions, figures = [], []
    for k, video in enumerate(inputs):
        posed = pose_clip(model, rig, k, video.clip.source_time_s)
        _write_cameras(out, video, posed)
        if settings.frame_meshes:
            _write_meshes(out, video, rig, posed, colours[k])
        figures.append(_measure(video, rig, posed, views, run))
        _write_overlay(out, video, rig, posed, colours[k], settings, run)
        motions.append(
            gltf.ClipMotion(
                video.name,
                video.clip.source_time_s,
                posed.joints,
                posed.camera_from_object,
                posed.intrinsics,
                video.clip.width,
                video.clip.height,
            )
        )

    _write_turntable(out, rig, colour, settings, run)
    writer = ply.PlyWriter(rig.mesh.faces, ply.to_bytes(colour), {"views": views.astype(np.float32)})
    (out / "rest.ply").write_bytes(writer.encode(rig.mesh.vertices))
    formats.write_json(out / "bones.json", _bones(model, rig))
    report = quality.report(rig.mesh, rig.normals, rig.facts, figures, views, pose_summary)
    formats.write_json(out / "quality.json", report)

    joint_idx, weight = rig.joint_skin(kept)
    mesh = gltf.RiggedMesh("model", rig.mesh.vertices, rig.normals, rig.mesh.faces, colour, joint_idx, weight)
    extras = {"length": rig.mesh.length, "trust": report["trust"], "verdict": report["verdict"]}
    (out / "model.glb").write_bytes(gltf.write_glb(mesh, rig.skeleton, motions, extras))

    for name in ("trust", "iou_mean", "unseen_area", "skinning_error", "faces"):
        run.metric(name, report[name])
    if report["verdict"] != "good":
        run.warn(f"The result is {report['verdict']} (trust {report['trust']:.2f} of 1); see quality.json.")
    for sentence in report["advice"]:
        run.warn(sentence)


@export.check
def _check(out: Path, frames: dict[str, Folder], settings: ExportSettings) -> None:
    """The GLB is whole, every source frame has its mesh and its camera."""
    data = (out / "model.glb").read_bytes()
    magic, version, total = struct.unpack("<4sII", data[:12])
    if magic != b"glTF" or version != 2 or total != len(data):
        raise formats.FormatError("model.glb: not a whole glTF 2.0 file")
    (text_length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + text_length])
    if sorted(a["name"] for a in document.get("animations", [])) != sorted(frames):
        raise formats.FormatError("model.glb: needs one animation a video")
    for name, folder in frames.items():
        count = len(formats.read_clip(folder.path).source_time_s)
        track = formats.read_poses(out / "cameras" / f"{name}.json")
        meshes = len(list((out / "meshes" / name).glob("*.ply"))) if settings.frame_meshes else count
        if len(track.object_to_camera) != count or meshes != count:
            raise formats.FormatError(f"{name}: {count} source frames, {meshes} meshes")
    formats.read_json(out / "quality.json")


@export.sheet
def _sheet(out: Path, picture: Path) -> None:
    """Four views of the turntable above a few overlays of each video."""
    rows = [read_pictures(out / "turntable.mp4", 4)]
    rows += [read_pictures(path, 3) for path in sorted(out.glob("overlay-*.mp4"))]
    width = 1600
    strips = []
    for row in rows:
        strip = np.concatenate(row, axis=1)
        strips.append(cv2.resize(strip, (width, max(1, round(strip.shape[0] * width / strip.shape[1])))))
    formats.write_image(picture, np.concatenate(strips))


# --------------------------------------------------------------------------------------------- files


def _write_cameras(out: Path, video: _Inputs, posed: PosedClip) -> None:
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


def _write_meshes(out: Path, video: _Inputs, rig: Rig, posed: PosedClip, colour: np.ndarray) -> None:
    folder = out / "meshes" / video.name
    folder.mkdir(parents=True)
    writer = ply.PlyWriter(rig.mesh.faces, ply.to_bytes(colour), {})
    for i, vertices in enumerate(posed.vertices):
        (folder / f"{i:05d}.ply").write_bytes(writer.encode(vertices))


def _look(rig: Rig, colour: np.ndarray) -> pictures.Look:
    palette = pictures.joint_palette(len(rig.skeleton))
    return pictures.Look(rig.mesh.faces, colour, rig.weights[:, rig.skeleton.bone] @ palette, rig.skeleton.parent)


def _write_turntable(out: Path, rig: Rig, colour: np.ndarray, settings: ExportSettings, run: Run) -> None:
    side = max(2, settings.video_side_px // 2 * 2)
    sticks = rig.skeleton.sticks(rig.skeleton.rest)
    images = pictures.turntable(_look(rig, colour), rig.mesh.vertices, sticks, settings.turntable_frames, side)
    shown = run.progress(images, settings.turntable_frames, "turntable")
    write_video(out / "turntable.mp4", shown, np.arange(settings.turntable_frames) / 24)


def _write_overlay(
    out: Path, video: _Inputs, rig: Rig, posed: PosedClip, colour: np.ndarray, settings: ExportSettings, run: Run
) -> None:
    clip, look = video.clip, _look(rig, colour)
    width, height, _ = pictures.scaled_size(clip.width, clip.height, settings.video_side_px)
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


def _bones(model: Animatable, rig: Rig) -> dict[str, Any]:
    skeleton, scales = rig.skeleton, model.bone_scales.cpu().numpy()
    orientations = model.bone_orientations.cpu().numpy().astype(np.float64)
    share = rig.weights.mean(axis=0)
    return {
        "space": "canonical: y up, z front; a joint is where the bone holds its parent; columns of orientation are the Gaussian's axes",
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


# --------------------------------------------------------------------------------------------- quality


def _measure(video: _Inputs, rig: Rig, posed: PosedClip, views: np.ndarray, run: Run) -> quality.ClipQuality:
    """Compare the posed mesh with every kept frame's mask; counts in `views` which vertices were seen."""
    clip = video.clip
    side = min(_QUALITY_SIDE_PX, max(clip.width, clip.height))
    width, height, _ = pictures.scaled_size(clip.width, clip.height, side)
    intrinsics = pictures.scaled_intrinsics(posed.intrinsics, clip.width, clip.height, width, height)
    slack = 0.02 * rig.mesh.length
    iou = np.full(len(clip), np.nan)
    for i, source in enumerate(run.progress(clip.source_idx, label=f"quality {video.name}")):
        if "missing" in video.facts.flags[i]:
            continue
        pose = posed.camera_from_object[source]
        points = posed.vertices[source] @ pose[:3, :3].T + pose[:3, 3]
        fragments = rasterise(points, rig.mesh.faces, intrinsics, height, width)
        mask = video.mask(i, width, height)
        if not mask.any():
            continue
        iou[i] = quality.mask_iou(fragments.covered, mask)
        normals = vertex_normals(points, rig.mesh.faces)
        views += quality.visible_vertices(points, normals, intrinsics, fragments, mask, slack)
    return quality.ClipQuality(
        video.name,
        clip.source_idx,
        iou,
        video.root_confidence,
        video.facts.confidence,
        video.facts.flags,
        len(clip.source_time_s),
        posed.skinning_error[8],
        posed.skinning_error[4],
    )
