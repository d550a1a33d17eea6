"""Does an ONNX file keep weights outside itself? Read from its protobuf bytes, without loading it.

Only the fields that can lead to a tensor are followed (onnx.proto: model 7 graph, 25 functions; graph 1 node,
5 initializer, 15 sparse_initializer; node 5 attribute; attribute 5 tensor, 6 graph, 10 tensors, 11 graphs;
tensor 13 external_data, 14 data_location). Everything else is skipped by its length.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path

_FOLLOW = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
_MAX_DEPTH = 40


def external_data(path: Path) -> list[str] | None:
    """Names of the outside files a model asks for; empty when it is whole in itself; None when it is no ONNX file."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            found: list[str] = []
            graphs = _walk(data, 0, len(data), "model", found, 0)
            return found if graphs else None
    except (ValueError, OSError, IndexError):
        return None


def _walk(data: mmap.mmap, start: int, end: int, kind: str, found: list[str], depth: int) -> int:
    """Number of sub-messages followed; the outside files they name are added to `found`."""
    if depth > _MAX_DEPTH:
        raise ValueError("nested too deeply")
    followed = 0
    for field, wire, low, high in _fields(data, start, end):
        if kind == "tensor":
            if field == 13 and wire == 2:
                found.append(_location(data, low, high))
            elif field == 14 and wire == 0 and low == 1 and not found:
                found.append("external data")
        elif wire == 2 and field in _FOLLOW[kind]:
            _walk(data, low, high, _FOLLOW[kind][field], found, depth + 1)
            followed += 1
    return followed


def _fields(data: mmap.mmap, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """(field, wire type, start, end) of each field; for a varint, start is its value."""
    while at < end:
        tag, at = _varint(data, at, end)
        field, wire = tag >> 3, tag & 7
        if wire == 0:
            value, at = _varint(data, at, end)
            yield field, wire, value, at
        elif wire == 1 or wire == 5:
            at += 8 if wire == 1 else 4
        elif wire == 2:
            length, at = _varint(data, at, end)
            if at + length > end:
                raise ValueError("a field runs past its message")
            yield field, wire, at, at + length
            at += length
        else:
            raise ValueError(f"wire type {wire}")
    if at != end:
        raise ValueError("a field runs past its message")


def _varint(data: mmap.mmap, at: int, end: int) -> tuple[int, int]:
    value = shift = 0
    while at < end and shift < 64:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError("a number runs past its message")


def _location(data: mmap.mmap, start: int, end: int) -> str:
    """Value of a key-value pair of a tensor's external data."""
    for field, wire, low, high in _fields(data, start, end):
        if field == 2 and wire == 2:
            return bytes(data[low:high]).decode("utf-8", "replace")
    return "external data"
