"""The container of a GLB file: its JSON document, its binary chunk, and the arrays that lie in there, all checked."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_DTYPE = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}


class GlbError(ValueError):
    """A GLB file that cannot be used; the message is one sentence."""


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the binary chunk of a GLB. Raises GlbError."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise GlbError("is not a GLB file")
    version, total = struct.unpack("<II", data[4:12])
    length, kind = struct.unpack("<I4s", data[12:20])
    if version != 2:
        raise GlbError(f"is glTF version {version}, not 2")
    if total > len(data) or 20 + length > total:
        raise GlbError("is cut off")
    if kind != b"JSON":
        raise GlbError("does not begin with its JSON chunk")
    try:
        document = json.loads(data[20 : 20 + length].decode("utf-8"))
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise GlbError(f"has a damaged JSON chunk ({type(error).__name__})") from error
    if not isinstance(document, dict):
        raise GlbError("has no JSON object")
    start = 20 + length
    blob = b""
    if start + 8 <= total:
        size, kind = struct.unpack("<I4s", data[start : start + 8])
        if kind == b"BIN\0":
            if start + 8 + size > total:
                raise GlbError("is cut off")
            blob = data[start + 8 : start + 8 + size]
    return document, blob


def read_accessor(document: dict[str, Any], blob: bytes, index: Any) -> np.ndarray:
    """Elements (N, C) of an accessor, checked against the buffer."""
    accessors = document.get("accessors") or []
    accessor = accessors[index_of(index, len(accessors), "accessor")]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise GlbError("uses sparse accessors, which are not read here")
    if accessor.get("componentType") not in _DTYPE or accessor.get("type") not in _WIDTH:
        raise GlbError("has an accessor of an unknown type")
    dtype: np.dtype[Any] = np.dtype(_DTYPE[accessor["componentType"]])
    width = _WIDTH[accessor["type"]]
    count, offset = accessor.get("count"), accessor.get("byteOffset", 0)
    if not isinstance(count, int) or not isinstance(offset, int) or count < 0 or offset < 0:
        raise GlbError("has an accessor without a count")
    raw = view_bytes(document, blob, accessor["bufferView"])
    view = document["bufferViews"][accessor["bufferView"]]
    item = dtype.itemsize * width
    stride = view.get("byteStride", item)
    if not isinstance(stride, int) or stride < item or (count and offset + stride * (count - 1) + item > len(raw)):
        raise GlbError("has an accessor that leaves its buffer")
    data = np.ndarray((count, width), dtype, raw, offset, (stride, dtype.itemsize)) if count else np.zeros((0, width))
    if accessor.get("normalized") and dtype.kind in "iu":
        return np.maximum(data / np.iinfo(dtype).max, -1.0)
    return np.array(data)


def view_bytes(document: dict[str, Any], blob: bytes, index: Any) -> bytes:
    """The bytes of a buffer view, checked against the buffer."""
    views = document.get("bufferViews") or []
    view = views[index_of(index, len(views), "buffer view")]
    buffers = document.get("buffers") or []
    if view.get("buffer", 0) != 0 or not buffers or "uri" in buffers[0]:
        raise GlbError("keeps its data outside the file")
    start, length = view.get("byteOffset", 0), view.get("byteLength")
    if not isinstance(start, int) or not isinstance(length, int) or start < 0 or length < 0:
        raise GlbError("has a malformed buffer view")
    if start + length > len(blob):
        raise GlbError("has a buffer view that leaves its buffer")
    return blob[start : start + length]


def index_of(value: Any, count: int, what: str) -> int:
    """`value` where it is an index below `count`. Raises GlbError."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < count:
        raise GlbError(f"names a {what} that is not there")
    return value
