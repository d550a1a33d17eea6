"""The rig in the formats that other programs open: GLB, OBJ with MTL, USDZ, BVH, COLMAP's text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import BadInput
from stages import formats
from stages.export_files import ExportedVideo, Texture
from stages.meshing import gltf, textfiles, usdz
from stages.meshing.rig import PosedClip, Rig
from stages.meshing.skeleton import invert, nearest_rigid
from stages.meshing.skinning import blend


@dataclass(frozen=True)
class Shown:
    """The pose in which the model is shown at rest: joints (B, 4, 4) object_from_joint, vertices (V, 3)."""

    joints: np.ndarray
    vertices: np.ndarray


def shown_pose(rig: Rig, names: list[str], clips: list[PosedClip], rest_frame: str, influences: int) -> Shown:
    """The pose that a setting names: "" the model's own rest, "mean", or "<video>:<frame>".

    The mean turns every joint by its mean turn against its parent (chordal L2) over all frames of all videos.

    Raises:
        BadInput: the setting names no such frame.
    """
    skeleton = rig.skeleton
    if not rest_frame:
        return Shown(skeleton.rest, rig.mesh.vertices)
    if rest_frame == "mean":
        local = np.concatenate([skeleton.local(clip.joints) for clip in clips])
        mean = nearest_rigid(local.mean(axis=0))
        joints = np.empty_like(mean)
        for j, parent in enumerate(skeleton.parent.tolist()):
            joints[j] = mean[j] if parent < 0 else joints[parent] @ mean[j]
    else:
        video, _, number = rest_frame.rpartition(":")
        hint = 'say "mean", or a video and the index of a frame of it, such as "' + f'{names[0]}:0"'
        if video not in names or not number.isdigit():
            raise BadInput(f"[export] rest_frame = {rest_frame!r} names no frame", hint=hint)
        clip = clips[names.index(video)]
        if int(number) >= len(clip.joints):
            raise BadInput(f"[export] rest_frame = {rest_frame!r}: {video} has {len(clip.joints)} frames", hint=hint)
        joints = clip.joints[int(number)]
    motion = np.empty_like(joints)
    motion[skeleton.bone] = joints @ invert(skeleton.rest)
    bone, weight = rig.skins[influences]
    return Shown(joints, blend(rig.mesh.vertices, motion[None], bone, weight)[0])


@dataclass(frozen=True)
class RigFiles:
    """What all formats are made of. colour: (V, 3) in 0..1; seen: (V,) share of the frames that saw each vertex."""

    rig: Rig
    shown: Shown
    videos: list[ExportedVideo]
    clips: list[PosedClip]
    colour: np.ndarray
    seen: np.ndarray
    texture: Texture | None
    influences: int

    def mesh(self) -> gltf.RiggedMesh:
        """The surface with its skin; cut open along the charts where there is a texture."""
        rig, texture = self.rig, self.texture
        joint_idx, weight = rig.joint_skin(self.influences)
        # A vertex on a seam has several texture coordinates, so it is written several times.
        cut = np.arange(len(rig.mesh.vertices)) if texture is None else texture.atlas.vertex
        return gltf.RiggedMesh(
            "model",
            rig.mesh.vertices[cut],
            rig.normals[cut],
            rig.mesh.faces if texture is None else texture.atlas.faces,
            self.colour[cut],
            joint_idx[cut],
            weight[cut],
            None if texture is None else texture.atlas.uv,
            None if texture is None else encode_png(texture.picture),
            self.seen[cut],
        )

    def write_glb(self, out: Path, root_motion: gltf.RootMotion, extras: dict[str, Any]) -> None:
        """``model.glb``."""
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
            for video, posed in zip(self.videos, self.clips, strict=True)
        ]
        shown = None if self.shown.joints is self.rig.skeleton.rest else self.shown.joints
        data = gltf.write_glb(self.mesh(), self.rig.skeleton, motions, extras, shown, root_motion)
        (out / "model.glb").write_bytes(data)

    def write_obj(self, out: Path) -> None:
        """``rest.obj``, ``rest.mtl`` and the texture as ``texture.png``."""
        mesh, texture = self.rig.mesh, self.texture
        uv = None if texture is None else texture.atlas.corner_uv
        text = textfiles.write_obj(self.shown.vertices, mesh.faces, self.colour, "rest.mtl", uv)
        (out / "rest.obj").write_text(text, encoding="ascii")
        (out / "rest.mtl").write_text(textfiles.write_mtl(None if texture is None else "texture.png"), encoding="ascii")
        if texture is not None:
            (out / "texture.png").write_bytes(encode_png(texture.picture))

    def write_usdz(self, out: Path) -> None:
        """``model.usdz``."""
        motions = [
            usdz.Motion(video.name, video.clip.source_time_s, posed.joints)
            for video, posed in zip(self.videos, self.clips, strict=True)
        ]
        (out / "model.usdz").write_bytes(usdz.write_usdz(self.mesh(), self.rig.skeleton, motions))

    def write_bvh(self, out: Path) -> None:
        """``motion/<video>.bvh``."""
        (out / "motion").mkdir()
        for video, posed in zip(self.videos, self.clips, strict=True):
            world = gltf.GL_FROM_CV @ posed.camera_from_object
            text = textfiles.write_bvh(self.rig.skeleton, posed.joints, world, video.clip.source_time_s)
            (out / "motion" / f"{video.name}.bvh").write_text(text, encoding="utf-8")

    def write_colmap(self, out: Path) -> None:
        """``colmap/cameras.txt``, ``images.txt``, ``points3D.txt``."""
        (out / "colmap").mkdir()
        cameras = [
            (video.name, posed.intrinsics, video.clip.width, video.clip.height, posed.camera_from_object)
            for video, posed in zip(self.videos, self.clips, strict=True)
        ]
        for name, text in textfiles.write_colmap(cameras).items():
            (out / "colmap" / name).write_text(text, encoding="utf-8")


def encode_png(picture: np.ndarray) -> bytes:
    """A picture (H, W, 3) uint8 as PNG."""
    ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not ok:
        raise formats.FormatError(f"cannot encode a texture of shape {picture.shape}")
    return bytes(data)
