"""Reading GLB files (glTF 2.0): scene tree, skin, mesh and animations, of our own files and of others'.

Everything that a file says is checked before it is used: a wrong file gives :class:`GlbError` with one sentence and
never more memory than the file itself is long, times a small factor.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from stages.animating.container import GlbError, index_of, read_accessor, split_glb, view_bytes

_PATHS = {"translation": 3, "rotation": 4, "scale": 3}


@dataclass(frozen=True)
class Track:
    """How one property of one node moves: times (T,) in seconds, values (T, 3) or (T, 4), way of interpolation."""

    node: int
    path: str
    time_s: np.ndarray
    values: np.ndarray
    interpolation: str

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Values (N, C) at times (N,); held beyond the ends. Cubic splines are read at their keys, linear between."""
        times = np.clip(time_s, self.time_s[0], self.time_s[-1])
        if len(self.time_s) == 1:
            return np.repeat(self.values, len(times), axis=0)
        if self.interpolation == "STEP":
            return self.values[np.searchsorted(self.time_s, times, side="right") - 1]
        if self.path == "rotation":
            return Slerp(self.time_s, Rotation.from_quat(self.values))(times).as_quat()
        return np.stack([np.interp(times, self.time_s, column) for column in self.values.T], axis=1)


@dataclass(frozen=True)
class Animation:
    """One animation: its tracks, and when it ends (seconds)."""

    name: str
    tracks: list[Track]
    extras: dict[str, Any] = field(default_factory=dict)

    @property
    def time_s(self) -> np.ndarray:
        """(T,) the key times of its longest track."""
        return max((t.time_s for t in self.tracks), key=len)


@dataclass(frozen=True)
class Glb:
    """One parsed file. Nodes are numbered as in the file; parent -1 is the scene."""

    document: dict[str, Any]
    blob: bytes
    names: list[str]
    parent: np.ndarray  # (nodes,)
    order: list[int]  # parents before children
    translation: np.ndarray  # (nodes, 3) at rest
    rotation: np.ndarray  # (nodes, 4) x y z w at rest
    scale: np.ndarray  # (nodes, 3) at rest
    animations: list[Animation]

    # ------------------------------------------------------------------------------------------ poses

    def locals_at(self, animation: Animation | None, time_s: np.ndarray) -> np.ndarray:
        """parent_from_node (N, nodes, 4, 4) at times (N,) of an animation; at rest without one."""
        count = len(time_s)
        parts = {
            "translation": np.repeat(self.translation[None], count, axis=0),
            "rotation": np.repeat(self.rotation[None], count, axis=0),
            "scale": np.repeat(self.scale[None], count, axis=0),
        }
        for track in animation.tracks if animation else ():
            parts[track.path][:, track.node] = track.at(time_s)
        return compose(parts["translation"], parts["rotation"], parts["scale"])

    def scene_from_node(self, local: np.ndarray) -> np.ndarray:
        """(N, nodes, 4, 4) of parent_from_node (N, nodes, 4, 4)."""
        result = local.copy()
        for node in self.order:
            if self.parent[node] >= 0:
                result[:, node] = result[:, self.parent[node]] @ local[:, node]
        return result

    def animation(self, name: str) -> Animation:
        """The animation called `name`. Raises GlbError naming those there are."""
        for found in self.animations:
            if found.name == name:
                return found
        known = ", ".join(repr(a.name) for a in self.animations) or "none"
        raise GlbError(f"there is no animation {name!r}; it has {known}")

    # ------------------------------------------------------------------------------------------ parts

    def accessor(self, index: Any) -> np.ndarray:
        """Elements (N, C) as float64 or integers; normalised integers become 0..1 or -1..1."""
        return read_accessor(self.document, self.blob, index)

    def joints(self) -> list[int]:
        """Nodes of the first skin's joints."""
        skins = self.document.get("skins") or []
        joints = skins[0].get("joints") if skins and isinstance(skins[0], dict) else None
        if not isinstance(joints, list) or not joints:
            raise GlbError("has no skin: nothing in it can be posed")
        return [index_of(j, len(self.names), "joint") for j in joints]

    def inverse_bind(self) -> np.ndarray:
        """joint_from_mesh (B, 4, 4) at rest, of the first skin."""
        count = len(self.joints())
        index = self.document["skins"][0].get("inverseBindMatrices")
        if index is None:
            return np.repeat(np.eye(4)[None], count, axis=0)
        data = self.accessor(index)
        if data.shape != (count, 16):
            raise GlbError(f"has {len(data)} inverse bind matrices for {count} joints")
        return np.swapaxes(data.reshape(count, 4, 4), 1, 2).astype(np.float64)

    def attribute(self, name: str) -> np.ndarray | None:
        """An attribute (V, C) of the first mesh's first primitive, None where it has none."""
        index = self._primitive().get("attributes", {}).get(name)
        return None if index is None else self.accessor(index)

    def faces(self) -> np.ndarray:
        """Triangles (F, 3) of the first mesh's first primitive."""
        primitive = self._primitive()
        if primitive.get("mode", 4) != 4 or "indices" not in primitive:
            raise GlbError("its mesh is not a list of triangles with indices")
        faces = self.accessor(primitive["indices"]).reshape(-1)
        vertices = self.attribute("POSITION")
        if len(faces) % 3 or vertices is None or (len(faces) and int(faces.max()) >= len(vertices)):
            raise GlbError("its triangles name vertices that are not there")
        return faces.reshape(-1, 3).astype(np.int64)

    def skin(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint indices and weights (V, K) of every vertex, all sets together; rows sum to one."""
        index, weight = [], []
        for part in range(8):
            joints, weights = self.attribute(f"JOINTS_{part}"), self.attribute(f"WEIGHTS_{part}")
            if joints is None or weights is None:
                break
            index.append(joints.astype(np.int64))
            weight.append(weights.astype(np.float64))
        if not index:
            raise GlbError("its mesh has no skin weights")
        joint, share = np.concatenate(index, axis=1), np.concatenate(weight, axis=1)
        if joint.shape != share.shape or (joint.size and int(joint.max()) >= len(self.joints())):
            raise GlbError("its skin names joints that are not there")
        return joint, share / np.maximum(share.sum(axis=1, keepdims=True), 1e-12)

    def picture(self) -> bytes | None:
        """The first embedded picture (PNG or JPEG bytes), None where there is none."""
        images = self.document.get("images") or []
        view = images[0].get("bufferView") if images and isinstance(images[0], dict) else None
        return None if view is None else view_bytes(self.document, self.blob, view)

    def _primitive(self) -> dict[str, Any]:
        try:
            primitive = self.document["meshes"][0]["primitives"][0]
        except (KeyError, IndexError, TypeError):
            raise GlbError("holds no mesh") from None
        if not isinstance(primitive, dict) or not isinstance(primitive.get("attributes", {}), dict):
            raise GlbError("its mesh is malformed")
        return primitive


def compose(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Transforms (..., 4, 4) of translations (..., 3), quaternions (..., 4) x y z w and scales (..., 3)."""
    result = np.zeros((*translation.shape[:-1], 4, 4))
    matrix = Rotation.from_quat(rotation.reshape(-1, 4)).as_matrix().reshape(*rotation.shape[:-1], 3, 3)
    result[..., :3, :3] = matrix * scale[..., None, :]
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1.0
    return result


def read_glb(data: bytes) -> Glb:
    """Parse a whole file. Raises GlbError."""
    document, blob = split_glb(data)
    try:
        return _build(document, blob)
    except GlbError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise GlbError(f"is not a well-formed glTF 2.0 file ({type(error).__name__}: {error})") from error


def _build(document: dict[str, Any], blob: bytes) -> Glb:
    nodes = document.get("nodes") or []
    count = len(nodes)
    parent = np.full(count, -1)
    for i, node in enumerate(nodes):
        for child in node.get("children", ()):
            at = index_of(child, count, "child")
            if parent[at] >= 0 or at == i:
                raise GlbError("its nodes are no tree")
            parent[at] = i
    order = [i for i in range(count) if parent[i] < 0]
    for node_idx in order:  # grows while it is read: breadth first
        order.extend(index_of(c, count, "child") for c in nodes[node_idx].get("children", ()))
    if len(order) != count:
        raise GlbError("its nodes go round in a circle")
    translation, rotation, scale = np.zeros((count, 3)), np.zeros((count, 4)), np.ones((count, 3))
    rotation[:, 3] = 1.0
    for i, node in enumerate(nodes):
        if "matrix" in node:
            matrix = _numbers(node["matrix"], 16).reshape(4, 4).T
            scale[i] = np.linalg.norm(matrix[:3, :3], axis=0)
            if (scale[i] < 1e-9).any():
                raise GlbError(f"node {i} is flattened to nothing")
            turn = matrix[:3, :3] / scale[i]
            if np.linalg.det(turn) < 0:
                raise GlbError(f"node {i} is mirrored")
            translation[i], rotation[i] = matrix[:3, 3], Rotation.from_matrix(turn).as_quat()
            continue
        translation[i] = _numbers(node.get("translation", (0, 0, 0)), 3)
        rotation[i] = _unit(_numbers(node.get("rotation", (0, 0, 0, 1)), 4)[None])[0]
        scale[i] = _numbers(node.get("scale", (1, 1, 1)), 3)
    animations = [_animation(document, blob, a, k, count) for k, a in enumerate(document.get("animations") or [])]
    names = [str(node.get("name", f"node_{i}")) for i, node in enumerate(nodes)]
    return Glb(document, blob, names, parent, order, translation, rotation, scale, [a for a in animations if a.tracks])


def _animation(document: dict[str, Any], blob: bytes, record: dict[str, Any], number: int, count: int) -> Animation:
    tracks = []
    for channel in record.get("channels", ()):
        target = channel.get("target", {})
        path = target.get("path")
        if path not in _PATHS or "node" not in target:
            continue  # weights of morph targets and extensions move no joint
        node = index_of(target["node"], count, "node")
        sampler = record["samplers"][index_of(channel["sampler"], len(record["samplers"]), "sampler")]
        kind = sampler.get("interpolation", "LINEAR")
        times = read_accessor(document, blob, sampler["input"]).reshape(-1).astype(np.float64)
        values = read_accessor(document, blob, sampler["output"]).astype(np.float64)
        if kind == "CUBICSPLINE":
            values = values.reshape(len(times), 3, -1)[:, 1]
        if not len(times) or values.shape != (len(times), _PATHS[path]):
            raise GlbError(f"animation {number}: as many values as times are needed")
        if not (np.isfinite(times).all() and np.isfinite(values).all()) or (np.diff(times) <= 0).any():
            raise GlbError(f"animation {number}: times must increase and all values be finite")
        tracks.append(Track(node, path, times, _unit(values) if path == "rotation" else values, kind))
    extras = record.get("extras")
    return Animation(str(record.get("name", f"animation_{number}")), tracks, extras if isinstance(extras, dict) else {})


def _numbers(value: Any, count: int) -> np.ndarray:
    array = np.array(value, np.float64)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise GlbError("has a node whose place is not made of finite numbers")
    return array


def _unit(quaternions: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if (length < 1e-6).any():
        raise GlbError("has a rotation of length zero")
    return quaternions / length
