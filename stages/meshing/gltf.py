"""A GLB (glTF 2.0) writer for one skinned, animated, coloured mesh.

Layout of the scene::

    <model>            the skinned mesh (its own transform is ignored, as glTF demands of skins)
    root_motion        moved by every clip: object in the camera's frame. Leave its channels out for motion in place
      bone_..          joints, a tree; at rest in the file, moved by every clip
    camera_<video>     fixed where that video's camera is: at the origin, looking along -z

or, with the root motion given to the camera, ``root_motion`` stays and ``camera_<video>`` is moved by its own clip;
or nothing but the joints moves.

glTF cameras look along -z with y up; ours (OpenCV) look along +z with y down. The two frames differ by half a turn
about x, so the root motion is ``diag(1, -1, -1) @ camera_from_object``. At rest the root motion is the identity and the
model stands upright at the origin, y up and front towards +z, as glTF wants it.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from stages.meshing.conversions import linear_from_srgb, translation_rotation
from stages.meshing.skeleton import Skeleton, invert

RootMotion = Literal["object", "camera", "none"]

GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
"""glTF's camera frame from OpenCV's: half a turn about x."""

_FLOAT, _UBYTE, _USHORT, _UINT = 5126, 5121, 5123, 5125
_VERTEX_DATA, _INDEX_DATA = 34962, 34963
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENTS = {"float32": _FLOAT, "uint8": _UBYTE, "uint16": _USHORT, "uint32": _UINT}


@dataclass(frozen=True)
class ClipMotion:
    """One video's motion.

    name: any text. time_s: (T,) of every source frame, not decreasing.
    joints: (T, B, 4, 4) object_from_joint, joint order. camera_from_object: (T, 4, 4), OpenCV.
    intrinsics: (3, 3) pixels of an image of width_px x height_px.
    """

    name: str
    time_s: np.ndarray
    joints: np.ndarray
    camera_from_object: np.ndarray
    intrinsics: np.ndarray
    width_px: int
    height_px: int


@dataclass(frozen=True)
class RiggedMesh:
    """What the file holds at rest.

    vertices, normals: (V, 3); faces: (F, 3); colour: (V, 3) sRGB in 0..1;
    joint_idx, weight: (V, K) skin, descending; padded to a multiple of four here.
    uv: (V, 2) and texture_png: the colour as a picture. With it the vertex colours are COLOR_1 and COLOR_0 is white,
    since a viewer multiplies COLOR_0 with the texture.
    seen: (V,) share of the frames that saw each vertex, 0 for never: the attribute ``_SEEN``. It stays the only one of
    our own: Blender's importer fails on two of different shapes.
    """

    name: str
    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    colour: np.ndarray
    joint_idx: np.ndarray
    weight: np.ndarray
    uv: np.ndarray | None = None
    texture_png: bytes | None = None
    seen: np.ndarray | None = None


@dataclass
class _Builder:
    blob: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes as one buffer view; returns its index."""
        self.blob += b"\0" * (-len(self.blob) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.blob += data
        self.views.append(view)
        return len(self.views) - 1

    def add(self, data: np.ndarray, target: int | None = None, bounds: bool = False, normalised: bool = False) -> int:
        """Append an array (N,) or (N, C) as one buffer view and accessor; returns the accessor's index."""
        data = np.ascontiguousarray(data)
        flat = data.reshape(len(data), -1)
        accessor: dict[str, Any] = {
            "bufferView": self.view(data.tobytes(), target),
            "componentType": _COMPONENTS[data.dtype.name],
            "count": len(data),
            "type": _KINDS[flat.shape[1]],
        }
        if normalised:
            accessor["normalized"] = True
        if bounds:
            accessor["min"], accessor["max"] = ([v.item() for v in row] for row in (flat.min(axis=0), flat.max(axis=0)))
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def clip_times(time_s: np.ndarray) -> np.ndarray:
    """Key times (T,) float32 from zero, strictly increasing as glTF demands."""
    times = (np.asarray(time_s, np.float64) - time_s[0]).astype(np.float32)
    for i in range(1, len(times)):
        if times[i] <= times[i - 1]:
            times[i] = np.nextafter(times[i - 1], np.float32(np.inf))
    return times


def write_glb(
    mesh: RiggedMesh,
    skeleton: Skeleton,
    clips: list[ClipMotion],
    extras: dict[str, Any],
    shown: np.ndarray | None = None,
    root_motion: RootMotion = "object",
) -> bytes:
    """The whole file; the same input gives the same bytes.

    Args:
        mesh: surface at rest with its skin.
        skeleton: joints at rest, to which the skin is bound.
        clips: one animation each, in this order.
        extras: plain JSON kept under ``asset.extras``.
        shown: (B, 4, 4) object_from_joint of the pose in which the file shows the model while no clip plays; None for
            the pose it is bound in. The skin stays bound where it is, so that the clips lose nothing.
        root_motion: what a clip moves for it: the object before a fixed camera, the camera round it, or nothing.
    """
    builder = _Builder()
    count = len(skeleton)
    joint_nodes = [2 + j for j in range(count)]
    nodes: list[dict[str, Any]] = [{"name": mesh.name, "mesh": 0, "skin": 0}, {"name": "root_motion"}]
    local = skeleton.local(skeleton.rest if shown is None else shown)
    for j in range(count):
        translation, rotation = translation_rotation(local[j : j + 1])
        node: dict[str, Any] = {
            "name": skeleton.names[j],
            "translation": [float(v) for v in translation[0]],
            "rotation": [float(v) for v in rotation[0]],
        }
        children = [joint_nodes[c] for c in np.flatnonzero(skeleton.parent == j)]
        if children:
            node["children"] = children
        nodes.append(node)
    nodes[1]["children"] = [joint_nodes[j] for j in np.flatnonzero(skeleton.parent < 0)]
    top_nodes = [0, 1]
    for k, clip in enumerate(clips):
        top_nodes.append(len(nodes))
        node = {"name": f"camera_{clip.name}", "camera": k}
        if root_motion == "camera":  # it is moved by its clip; until one plays it is where the clip starts
            start_t, start_r = translation_rotation(_camera_in_object(clip)[:1])
            node |= {"translation": start_t[0].tolist(), "rotation": start_r[0].tolist()}
        nodes.append(node)

    inverse_bind = np.swapaxes(invert(skeleton.rest), 1, 2).astype(np.float32).reshape(count, 16)
    matte: dict[str, Any] = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "banmo-pipeline", "extras": extras},
        "scene": 0,
        "scenes": [{"name": mesh.name, "nodes": top_nodes}],
        "nodes": nodes,
        "meshes": [{"name": mesh.name, "primitives": [_primitive(builder, mesh, count)]}],
        "materials": [{"name": "surface", "pbrMetallicRoughness": matte}],
        "skins": [
            {
                "name": "skin",
                "inverseBindMatrices": builder.add(inverse_bind),
                "skeleton": nodes[1]["children"][0],
                "joints": joint_nodes,
            }
        ],
    }
    if mesh.texture_png is not None:
        matte["baseColorTexture"] = {"index": 0}
        document["textures"] = [{"source": 0, "sampler": 0}]
        document["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
        document["images"] = [{"name": "colour", "mimeType": "image/png", "bufferView": builder.view(mesh.texture_png)}]
    if clips:
        document["cameras"] = [_camera(clip) for clip in clips]
        document["animations"] = [
            _animation(builder, clip, skeleton, joint_nodes, top_nodes[2 + k], root_motion)
            for k, clip in enumerate(clips)
        ]
    document["accessors"], document["bufferViews"] = builder.accessors, builder.views
    document["buffers"] = [{"byteLength": len(builder.blob)}]
    return _pack(document, bytes(builder.blob))


def _primitive(builder: _Builder, mesh: RiggedMesh, joint_count: int) -> dict[str, Any]:
    vertex_count, kept = mesh.weight.shape
    colour = np.ones((vertex_count, 4))
    index_type = np.uint16 if vertex_count < 65_535 else np.uint32
    joint_type = np.uint8 if joint_count <= 256 else np.uint16
    attributes = {
        "POSITION": builder.add(mesh.vertices.astype(np.float32), _VERTEX_DATA, bounds=True),
        "NORMAL": builder.add(mesh.normals.astype(np.float32), _VERTEX_DATA),
    }
    if mesh.uv is not None and mesh.texture_png is not None:
        attributes["TEXCOORD_0"] = builder.add(mesh.uv.astype(np.float32), _VERTEX_DATA)
        white = np.full((vertex_count, 4), 255, np.uint8)
        attributes["COLOR_0"] = builder.add(white, _VERTEX_DATA, normalised=True)
    colour[:, :3] = linear_from_srgb(mesh.colour)
    name = f"COLOR_{sum(a.startswith('COLOR_') for a in attributes)}"
    attributes[name] = builder.add(np.round(colour * 65535).astype(np.uint16), _VERTEX_DATA, normalised=True)
    if mesh.seen is not None:
        attributes["_SEEN"] = builder.add(mesh.seen.astype(np.float32), _VERTEX_DATA)
    for part in range(-(-kept // 4)):
        joints = np.zeros((vertex_count, 4), joint_type)
        weights = np.zeros((vertex_count, 4), np.float32)
        columns = mesh.weight[:, 4 * part : 4 * part + 4]
        joints[:, : columns.shape[1]] = mesh.joint_idx[:, 4 * part : 4 * part + 4]
        weights[:, : columns.shape[1]] = columns
        attributes[f"JOINTS_{part}"] = builder.add(joints, _VERTEX_DATA)
        attributes[f"WEIGHTS_{part}"] = builder.add(weights, _VERTEX_DATA)
    indices = builder.add(mesh.faces.astype(index_type).reshape(-1), _INDEX_DATA)
    return {"attributes": attributes, "indices": indices, "material": 0, "mode": 4}


def _camera(clip: ClipMotion) -> dict[str, Any]:
    fx, fy = float(clip.intrinsics[0, 0]), float(clip.intrinsics[1, 1])
    return {
        "name": f"camera_{clip.name}",
        "type": "perspective",
        "perspective": {
            "yfov": float(2 * np.arctan(clip.height_px / (2 * fy))),
            "aspectRatio": float(clip.width_px * fy / (clip.height_px * fx)),
            "znear": 0.01,
        },
        # glTF has no principal point; what it cannot say is kept here.
        "extras": {"K": clip.intrinsics.tolist(), "width_px": clip.width_px, "height_px": clip.height_px},
    }


def _camera_in_object(clip: ClipMotion) -> np.ndarray:
    """Scene_from_camera (T, 4, 4), glTF's camera frame, with the object at rest in the scene."""
    return np.asarray(invert(clip.camera_from_object) @ GL_FROM_CV)


def _animation(
    builder: _Builder,
    clip: ClipMotion,
    skeleton: Skeleton,
    joint_nodes: list[int],
    camera_node: int,
    root_motion: RootMotion,
) -> dict[str, Any]:
    times = builder.add(clip_times(clip.time_s), bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def move(node: int, transforms: np.ndarray) -> None:
        for path, values in zip(("translation", "rotation"), translation_rotation(transforms), strict=True):
            samplers.append({"input": times, "output": builder.add(values), "interpolation": "LINEAR"})
            channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})

    if root_motion == "object":
        move(1, GL_FROM_CV @ clip.camera_from_object)
    elif root_motion == "camera":
        move(camera_node, _camera_in_object(clip))
    local = skeleton.local(clip.joints)
    for j, node in enumerate(joint_nodes):
        move(node, local[:, j])
    start = {"start_time_s": float(clip.time_s[0]), "frames": len(clip.time_s)}
    return {"name": clip.name, "samplers": samplers, "channels": channels, "extras": start}


def _pack(document: dict[str, Any], blob: bytes) -> bytes:
    text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    total = 12 + 8 + len(text) + 8 + len(blob)
    header = struct.pack("<4sII", b"glTF", 2, total)
    return header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
