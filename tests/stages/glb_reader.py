"""A second, independent reading of GLB files: accessors, node trees, keyframes and skinning, by the specification."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_DTYPE = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}


class Glb:
    """One file, parsed."""

    def __init__(self, data: bytes) -> None:
        magic, version, total = struct.unpack("<4sII", data[:12])
        assert magic == b"glTF" and version == 2 and total == len(data)
        (length,) = struct.unpack("<I", data[12:16])
        assert data[16:20] == b"JSON" and length % 4 == 0
        self.document: dict[str, Any] = json.loads(data[20 : 20 + length].decode("utf-8"))
        (size,) = struct.unpack("<I", data[20 + length : 24 + length])
        assert data[24 + length : 28 + length] == b"BIN\0" and size % 4 == 0
        self.blob = data[28 + length :]
        assert len(self.blob) == size
        assert size - 3 <= self.document["buffers"][0]["byteLength"] <= size

    def accessor(self, index: int) -> np.ndarray:
        """Raw elements (N, C); checks that they lie inside their view and the view inside the buffer."""
        accessor = self.document["accessors"][index]
        view = self.document["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(_DTYPE[accessor["componentType"]]), _WIDTH[accessor["type"]]
        size = accessor["count"] * width * dtype.itemsize
        assert size <= view["byteLength"]
        assert view["byteOffset"] + view["byteLength"] <= len(self.blob)
        assert view["byteOffset"] % dtype.itemsize == 0
        raw = self.blob[view["byteOffset"] : view["byteOffset"] + size]
        data = np.frombuffer(raw, dtype).reshape(accessor["count"], width)
        if "min" in accessor:
            np.testing.assert_array_equal(data.min(axis=0), np.array(accessor["min"], dtype))
            np.testing.assert_array_equal(data.max(axis=0), np.array(accessor["max"], dtype))
        return data

    def attribute(self, name: str) -> np.ndarray:
        """An attribute of the one primitive."""
        return self.accessor(self.document["meshes"][0]["primitives"][0]["attributes"][name])

    def faces(self) -> np.ndarray:
        """(F, 3)."""
        return self.accessor(self.document["meshes"][0]["primitives"][0]["indices"]).reshape(-1, 3).astype(int)

    def locals_at(self, animation: int | None, key: int, leave_out: tuple[int, ...] = ()) -> np.ndarray:
        """(nodes, 4, 4) local transforms, at rest or at a key of an animation; some nodes may be left at rest."""
        nodes = self.document["nodes"]
        translation = [np.array(n.get("translation", (0, 0, 0)), float) for n in nodes]
        rotation = [np.array(n.get("rotation", (0, 0, 0, 1)), float) for n in nodes]
        if animation is not None:
            record = self.document["animations"][animation]
            for channel in record["channels"]:
                if channel["target"]["node"] in leave_out:
                    continue
                value = self.accessor(record["samplers"][channel["sampler"]]["output"])[key].astype(float)
                target = translation if channel["target"]["path"] == "translation" else rotation
                target[channel["target"]["node"]] = value
        return np.stack([compose(t, r) for t, r in zip(translation, rotation, strict=True)])

    def globals_of(self, local: np.ndarray) -> np.ndarray:
        """(nodes, 4, 4) scene_from_node."""
        result = np.full_like(local, np.nan)

        def visit(node: int, above: np.ndarray) -> None:
            assert np.isnan(result[node]).all(), "a node has two parents"
            result[node] = above @ local[node]
            for child in self.document["nodes"][node].get("children", ()):
                visit(child, result[node])

        for root in self.document["scenes"][self.document["scene"]]["nodes"]:
            visit(root, np.eye(4))
        assert np.isfinite(result).all(), "a node hangs nowhere"
        return result

    def skinned(
        self, animation: int | None, key: int, leave_out: tuple[int, ...] = (), influences: int = 8
    ) -> np.ndarray:
        """(V, 3) vertices in the scene, by the specification's skinning."""
        skin = self.document["skins"][0]
        nodes = self.globals_of(self.locals_at(animation, key, leave_out))
        bind = self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2).astype(float)
        joint = nodes[skin["joints"]] @ bind
        position = self.attribute("POSITION").astype(float)
        homogeneous = np.concatenate([position, np.ones((len(position), 1))], axis=1)
        total = np.zeros_like(position)
        weight_sum = np.zeros((len(position), 1))
        for part in range(influences // 4):
            if f"JOINTS_{part}" in self.document["meshes"][0]["primitives"][0]["attributes"]:
                joints, weights = self.attribute(f"JOINTS_{part}"), self.attribute(f"WEIGHTS_{part}").astype(float)
                for k in range(4):
                    moved = np.einsum("vij,vj->vi", joint[joints[:, k]], homogeneous)[:, :3]
                    total += weights[:, k : k + 1] * moved
                    weight_sum += weights[:, k : k + 1]
        return total / weight_sum


def compose(translation: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """4x4 of a translation and a unit quaternion x y z w, written out."""
    assert abs(np.linalg.norm(quaternion) - 1) < 1e-5
    x, y, z, w = quaternion
    result = np.eye(4)
    result[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result[:3, 3] = translation
    return result
