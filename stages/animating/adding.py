"""Adding a motion to a GLB that has a skeleton: one more animation, everything else kept as it is."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stages.animating.container import GlbError, split_glb


@dataclass(frozen=True)
class NewMotion:
    """A motion to add: parent_from_node (T, 4, 4) rigid of each moving node, at times (T,) in seconds from zero."""

    name: str
    time_s: np.ndarray
    nodes: dict[int, np.ndarray]
    extras: dict[str, Any] = field(default_factory=dict)


def add_motion(data: bytes, motion: NewMotion) -> bytes:
    """The GLB `data` with `motion` as its last animation; one of the same name is replaced.

    Raises GlbError when the file is none, or the times do not increase.
    """
    document, blob = split_glb(data)
    times = np.asarray(motion.time_s, np.float32)
    if not len(times) or (np.diff(times) <= 0).any():
        raise GlbError("times of a motion must increase")
    body = bytearray(blob)
    views = document.setdefault("bufferViews", [])
    accessors = document.setdefault("accessors", [])

    def add(values: np.ndarray, kind: str, bounds: bool = False) -> int:
        body.extend(b"\0" * (-len(body) % 4))
        raw = np.ascontiguousarray(values, np.float32)
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": raw.nbytes})
        body.extend(raw.tobytes())
        accessor: dict[str, Any] = {
            "bufferView": len(views) - 1,
            "componentType": 5126,
            "count": len(raw),
            "type": kind,
        }
        if bounds:
            accessor["min"], accessor["max"] = [raw.min().item()], [raw.max().item()]
        accessors.append(accessor)
        return len(accessors) - 1

    clock = add(times, "SCALAR", bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for node, transforms in motion.nodes.items():
        parts = (("translation", transforms[:, :3, 3], "VEC3"), ("rotation", quaternions(transforms), "VEC4"))
        for path, values, kind in parts:
            samplers.append({"input": clock, "output": add(values, kind), "interpolation": "LINEAR"})
            channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
    record = {"name": motion.name, "samplers": samplers, "channels": channels, "extras": motion.extras}
    kept = [a for a in document.get("animations") or [] if a.get("name") != motion.name]
    document["animations"] = [*kept, record]
    if not document.get("buffers"):
        document["buffers"] = [{}]
    document["buffers"][0]["byteLength"] = len(body)
    return pack_glb(document, bytes(body))


def quaternions(transforms: np.ndarray) -> np.ndarray:
    """Unit quaternions (T, 4), x y z w, of rigid transforms (T, 4, 4), each in the half space of the one before."""
    found = np.atleast_2d(Rotation.from_matrix(transforms[:, :3, :3]).as_quat())
    found[0] *= 1.0 if found[0, 3] >= 0 else -1.0
    agree = np.sign((found[1:] * found[:-1]).sum(axis=1))
    agree[agree == 0] = 1.0
    found[1:] *= np.cumprod(agree)[:, None]
    return found


def pack_glb(document: dict[str, Any], blob: bytes) -> bytes:
    """A GLB of a JSON document and its binary chunk."""
    text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(blob))
    return header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
