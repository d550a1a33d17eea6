"""Stage: what a user holds at the end: a rigged, animated GLB, meshes, cameras, videos, an honest report.

The folder::

    model.glb                   surface, texture, skin, joints in a tree, a clip a video, root motion apart, cameras
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import BadInput, Folder, Resources, Run, Scene, stage
from stages import formats
from stages.export_files import (
    ExportedVideo,
    Texture,
    write_bones,
    write_cameras,
    write_meshes,
    write_overlay,
    write_rest,
    write_turntable,
)
from stages.geometry.raster import rasterise, vertex_normals
from stages.meshing import atlas, gltf, pictures, quality
from stages.meshing.rig import Animatable, PosedClip, Rig, build_rig, field_colour, pose_clip, surface_colour
from stages.model.banmo import Banmo
from stages.video_io import read_pictures

_QUALITY_SIDE_PX = 256
_BAKED_FRAMES = 60  # of all videos together


@dataclass(frozen=True)
class ExportSettings:
    """What is written, and how fine."""

    resolution: int = 256
    """Cells of the extraction grid along the longest edge of the object."""
    faces: int = 10_000
    """Faces of the exported mesh at most."""
    influences: int = 8
    """Bones that move a vertex at most; many viewers use the first four."""
    texture_px: int = 1024
    """Side of the texture, coloured from the frames; 0 leaves vertex colours only."""
    frame_meshes: bool = True
    """Write a mesh for every frame of every video."""
    video_side_px: int = 384
    """Longer side of one picture in the turntable and the overlays."""
    turntable_frames: int = 72
    """Pictures of one turn, at 24 a second."""


_RANGES = {
    "resolution": (16, 1024),
    "faces": (20, 2_000_000),
    "influences": (1, 32),
    "texture_px": (0, 8192),
    "video_side_px": (16, 2048),
    "turntable_frames": (1, 2000),
}


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
    for key, (least, most) in _RANGES.items():
        if not least <= getattr(settings, key) <= most:
            raise BadInput(f"[export] {key} = {getattr(settings, key)} is not between {least} and {most}")
    model = Banmo.restore(*formats.read_model(refine.path))
    inputs = []
    for name in model.video_names:
        track = formats.read_poses(refine / "poses" / f"{name}.json")
        clip, facts = formats.read_clip(frames[name].path), formats.read_mask_facts(masks[name].path)
        inputs.append(ExportedVideo(name, clip, masks[name].path, facts, track.confidence))
    summary = formats.read_json(poses / "poses.json") if (poses / "poses.json").is_file() else {}
    export_model(model, inputs, summary, settings, out, run)


def export_model(
    model: Animatable,
    inputs: list[ExportedVideo],
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
    clips = [pose_clip(model, rig, k, times[k]) for k in range(len(inputs))]

    views = np.zeros(len(rig.mesh.vertices))
    figures = [_measure(video, rig, posed, views, run) for video, posed in zip(inputs, clips, strict=True)]
    texture = _bake(model, rig, inputs, clips, settings.texture_px, run) if settings.texture_px > 0 else None
    for k, (video, posed) in enumerate(zip(inputs, clips, strict=True)):
        write_cameras(out, video, posed)
        if settings.frame_meshes:
            write_meshes(out, video, rig, posed, colours[k])
        write_overlay(out, video, rig, posed, colours[k], settings.video_side_px, run)
    write_turntable(out, rig, colour, texture, settings.video_side_px, settings.turntable_frames, run)
    write_rest(out, rig, colour, views)
    write_bones(out, model, rig)
    report = quality.report(rig.mesh, rig.normals, rig.facts, figures, views, pose_summary)
    report["texture_from_frames"] = None if texture is None else round(texture.from_frames, 4)
    formats.write_json(out / "quality.json", report)
    extras = {"length": rig.mesh.length, "trust": report["trust"], "verdict": report["verdict"]}
    (out / "model.glb").write_bytes(_glb(rig, inputs, clips, colour, texture, kept, extras))

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


# --------------------------------------------------------------------------------------------- parts


def _glb(
    rig: Rig,
    inputs: list[ExportedVideo],
    clips: list[PosedClip],
    colour: np.ndarray,
    texture: Texture | None,
    influences: int,
    extras: dict[str, Any],
) -> bytes:
    motions = [
        gltf.ClipMotion(
            video.name,
            video.clip.source_time_s,
            posed.joints,
            posed.camera_from_object,
            posed.intrinsics,
            video.clip.width,
            video.clip.height,
        )
        for video, posed in zip(inputs, clips, strict=True)
    ]
    joint_idx, weight = rig.joint_skin(influences)
    if texture is None:
        mesh = gltf.RiggedMesh("model", rig.mesh.vertices, rig.normals, rig.mesh.faces, colour, joint_idx, weight)
    else:
        cut = texture.atlas.vertex  # a vertex on a seam has several texture coordinates, so it is written several times
        mesh = gltf.RiggedMesh(
            "model",
            rig.mesh.vertices[cut],
            rig.normals[cut],
            texture.atlas.faces,
            colour[cut],
            joint_idx[cut],
            weight[cut],
            texture.atlas.uv,
            _png(texture.picture),
        )
    return gltf.write_glb(mesh, rig.skeleton, motions, extras)


def _png(picture: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not ok:
        raise formats.FormatError(f"cannot encode a texture of shape {picture.shape}")
    return bytes(data)


def _bake(
    model: Animatable, rig: Rig, inputs: list[ExportedVideo], clips: list[PosedClip], size_px: int, run: Run
) -> Texture:
    """Colour the texture from frames spread over all videos."""
    charts = atlas.unwrap(rig.mesh, size_px)
    texels = atlas.texels_of(charts, size_px)
    points = texels.spread(rig.mesh.faces, rig.mesh.vertices)
    baker = atlas.Baker(rig.mesh, texels, field_colour(model, points, len(inputs)))
    per_video = max(1, _BAKED_FRAMES // len(inputs))
    for video, posed in zip(inputs, clips, strict=True):
        chosen = np.unique(np.linspace(0, len(video.clip) - 1, per_video).round().astype(int))
        for i in run.progress([c for c in chosen.tolist() if "missing" not in video.facts.flags[c]], label="texture"):
            pose = posed.camera_from_object[video.clip.source_idx[i]]
            points = posed.vertices[video.clip.source_idx[i]] @ pose[:3, :3].T + pose[:3, 3]
            width, height = video.clip.width, video.clip.height
            fragments = rasterise(points, rig.mesh.faces, posed.intrinsics, height, width)
            mask = video.mask(i, width, height)
            baker.add(points, posed.intrinsics, fragments, video.clip.image(i), mask, 0.01 * rig.mesh.length)
        baker.end_clip()
    picture, from_frames = baker.picture()
    return Texture(charts, picture, from_frames)


def _measure(video: ExportedVideo, rig: Rig, posed: PosedClip, views: np.ndarray, run: Run) -> quality.ClipQuality:
    """Compare the posed mesh with every kept frame's mask; counts in `views` which vertices were seen."""
    clip = video.clip
    side = min(_QUALITY_SIDE_PX, max(clip.width, clip.height))
    width, height, _ = pictures.scaled_size(clip.width, clip.height, side)
    intrinsics = pictures.scaled_intrinsics(posed.intrinsics, clip.width, clip.height, width, height)
    slack = 0.02 * rig.mesh.length
    iou, missing, extra = np.full((3, len(clip)), np.nan)
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
        missing[i], extra[i] = quality.mask_misfit(fragments.covered, mask)
        normals = vertex_normals(points, rig.mesh.faces)
        views += quality.visible_vertices(points, normals, intrinsics, fragments, mask, slack)
    return quality.ClipQuality(
        video.name,
        clip.source_idx,
        iou,
        missing,
        extra,
        video.root_confidence,
        video.facts.confidence,
        video.facts.flags,
        len(clip.source_time_s),
        posed.skinning_error[8],
        posed.skinning_error[4],
    )
