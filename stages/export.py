"""Stage: what a user holds at the end: a rigged, animated GLB, meshes, cameras, videos, an honest report.

The folder::

    model.glb                   surface, texture, skin, joints in a tree, a clip a video, root motion apart, cameras;
                                attribute ``_SEEN`` is the share of the frames that saw each vertex
    model.usdz                  the same for phones and USD programs, a variant a clip, motion in place
    rest.ply                    the surface at rest; property ``views`` counts the frames that saw each vertex
    rest.obj, rest.mtl, texture.png    the surface at rest for everything else
    meshes/<video>/00042.ply    the surface articulated at every frame of the source, object space (root motion off),
                                on some of the vertices
    motion/<video>.bvh          the joints' motion, root motion in a joint of its own
    cameras/<video>.json        K and object_to_camera of every frame of the source, usable as a given ``.poses.json``
    colmap/                     the same cameras in COLMAP's text format
    bones.json                  joints: names, tree, Gaussians at rest
    turntable.mp4               the rest pose turning
    overlay-<video>.mp4         each source frame beside the posed mesh
    quality.json                how far to trust it, a video, a frame and overall
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import BadInput, Folder, Resources, Run, Scene, stage
from stages import formats
from stages.export_files import (
    ExportedVideo,
    write_bones,
    write_cameras,
    write_meshes,
    write_overlay,
    write_rest,
    write_turntable,
)
from stages.export_measure import bake, measure
from stages.export_rig import RigFiles, shown_pose
from stages.meshing import quality
from stages.meshing.cleanup import CleanerMissing, repair_with_pymeshlab
from stages.meshing.coarse import coarse_subset
from stages.meshing.naming import kind_of_body, name_by_place
from stages.meshing.rig import Animatable, build_rig, surface_colour
from stages.model.banmo import Banmo
from stages.video_io import read_pictures

_TRUSTED_AXES = 0.5  # trust in the root poses from which names by place (left, front ...) are given

FORMATS = ("obj", "usdz", "bvh", "colmap")


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
    """Side of the texture at most (less where the videos show no more); 0 leaves vertex colours only."""
    frame_meshes: bool = True
    """Write a mesh for every frame of every video."""
    frame_mesh_faces: int = 4000
    """Faces of those meshes at most; 375 frames take about 22 MB at 4000 and 55 MB at 10000."""
    formats: tuple[str, ...] = FORMATS
    """What else to write: obj, usdz, bvh, colmap."""
    rest_frame: str = ""
    """The pose shown at rest: empty for the model's own, "mean" for the mean of all frames, or "video:frame"."""
    root_motion: str = "object"
    """What moves with the object in the GLB's clips: object, camera (it goes round the object), or none."""
    category: str = ""
    """Name the joints as of a "quadruped" or a "human"; empty takes what the features say, "other" names none."""
    cleaner: str = "builtin"
    """What mends the surface before it is decimated: builtin or pymeshlab."""
    video_side_px: int = 384
    """Longer side of one picture in the turntable and the overlays."""
    turntable_frames: int = 72
    """Pictures of one turn, at 24 a second."""


_RANGES = {
    "resolution": (16, 1024),
    "faces": (20, 2_000_000),
    "frame_mesh_faces": (20, 2_000_000),
    "influences": (1, 32),
    "texture_px": (0, 8192),
    "video_side_px": (16, 2048),
    "turntable_frames": (1, 2000),
}
_CHOICES = {"root_motion": ("object", "camera", "none"), "cleaner": ("builtin", "pymeshlab")}


@stage(per=Scene, version=2, needs=Resources(cpus=1))
def export(
    refine: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    features: dict[str, Folder],
    poses: Folder,
    settings: ExportSettings,
    out: Path,
    run: Run,
) -> None:
    """A rigged and animated GLB, meshes and cameras of every frame, videos to look at, and how far to trust them."""
    for key, (least, most) in _RANGES.items():
        if not least <= getattr(settings, key) <= most:
            raise BadInput(f"[export] {key} = {getattr(settings, key)} is not between {least} and {most}")
    chosen = {key: getattr(settings, key) for key in _CHOICES}
    for key, value, known in (
        *((key, value, _CHOICES[key]) for key, value in chosen.items()),
        *(("formats", value, FORMATS) for value in settings.formats),
    ):
        if value not in known:
            raise BadInput(f"[export] {key}: {value!r} is none of {', '.join(known)}")
    model = Banmo.restore(*formats.read_model(refine.path))
    inputs = []
    for name in model.video_names:
        track = formats.read_poses(refine / "poses" / f"{name}.json")
        clip, facts = formats.read_clip(frames[name].path), formats.read_mask_facts(masks[name].path)
        inputs.append(ExportedVideo(name, clip, masks[name].path, facts, track.confidence))
    summary = formats.read_json(poses / "poses.json") if (poses / "poses.json").is_file() else {}
    category = settings.category or _category(features, summary.get("trust"))
    export_model(model, inputs, summary, replace(settings, category=category), out, run)


def _category(features: dict[str, Folder], trust: Any) -> str:
    """What the features say the object is, where they agree and the object's axes can be believed; else ""."""
    said = {str(formats.read_json(folder / "features.json").get("category", "")) for folder in features.values()}
    kinds = {kind_of_body(category) for category in said}
    believed = isinstance(trust, int | float) and trust >= _TRUSTED_AXES
    return min(said) if len(kinds) == 1 and None not in kinds and believed else ""


def export_model(
    model: Animatable,
    inputs: list[ExportedVideo],
    pose_summary: dict[str, Any],
    settings: ExportSettings,
    out: Path,
    run: Run,
) -> None:
    """Write the whole folder for a model whose videos are `inputs`, in the model's order."""
    names, times = [video.name for video in inputs], [video.clip.source_time_s for video in inputs]
    kept = max(1, settings.influences)
    repair = repair_with_pymeshlab if settings.cleaner == "pymeshlab" else None
    try:
        rig, clips = build_rig(model, times, settings.resolution, settings.faces, sorted({4, 8, kept}), repair)
    except CleanerMissing as error:
        hint = "pip install banmo-pipeline[clean], or cleaner = builtin"
        raise BadInput("[export] cleaner: pymeshlab is not installed", hint=hint) from error
    rig = replace(rig, skeleton=name_by_place(rig.skeleton, settings.category, rig.mesh.vertices, rig.weights))
    run.log.info("surface: %d faces, %d joints", len(rig.mesh.faces), len(rig.skeleton))
    shown = shown_pose(rig, names, clips, settings.rest_frame, kept)
    colours = [surface_colour(model, rig, k) for k in range(len(inputs))]
    colour = np.mean(colours, axis=0)

    views = np.zeros(len(rig.mesh.vertices))
    figures = [measure(video, rig, posed, views, run) for video, posed in zip(inputs, clips, strict=True)]
    texture = bake(model, rig, inputs, clips, settings.texture_px, run) if settings.texture_px > 0 else None
    coarse = coarse_subset(rig.mesh, settings.frame_mesh_faces)
    for k, (video, posed) in enumerate(zip(inputs, clips, strict=True)):
        write_cameras(out, video, posed)
        if settings.frame_meshes:
            write_meshes(out, video, coarse, posed, colours[k])
        write_overlay(out, video, rig, posed, colours[k], settings.video_side_px, run)
    side, turn = settings.video_side_px, settings.turntable_frames
    write_turntable(out, rig, shown.vertices, shown.joints, colour, texture, side, turn, run)
    write_rest(out, rig, shown.vertices, colour, views)
    write_bones(out, model, rig)
    report = quality.report(rig.mesh, rig.normals, rig.facts, figures, views, pose_summary)
    report["texture_from_frames"] = None if texture is None else round(texture.from_frames, 4)
    formats.write_json(out / "quality.json", report)
    compared = max(sum(int(np.isfinite(f.iou).sum()) for f in figures), 1)
    files = RigFiles(rig, shown, inputs, clips, colour, views / compared, texture, kept)
    extras = {"length": rig.mesh.length, "trust": report["trust"], "verdict": report["verdict"]}
    files.write_glb(out, settings.root_motion, extras)  # type: ignore[arg-type]
    for name in settings.formats:
        {"obj": files.write_obj, "usdz": files.write_usdz, "bvh": files.write_bvh, "colmap": files.write_colmap}[name](
            out
        )

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
