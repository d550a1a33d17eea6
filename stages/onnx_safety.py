"""What an ONNX file asks for, read from its protobuf bytes without loading it: outside files, operators, huge tensors.

Only the fields that matter are followed (onnx.proto: model 7 graph, 8 opset_import, 25 functions; graph 1 node,
5 initializer, 15 sparse_initializer; node 1 input, 2 output, 4 op_type, 5 attribute, 7 domain; attribute 5 tensor,
6 graph, 10 tensors, 11 graphs; tensor 1 dims, 2 data_type, 7 int64_data, 8 name, 9 raw_data, 13 external_data,
14 data_location). Everything else is skipped by its length.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import prod
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
_INT64 = 7
KNOWN_DOMAINS = ("", "ai.onnx", "ai.onnx.ml", "com.microsoft", "com.microsoft.nchwc")
"""Operators of ONNX itself and those that onnxruntime brings along."""
HUGE = 1 << 29
"""Elements of a tensor (2 GB of float32) beyond which a file is refused."""
# Operators that make a tensor of the size that one of their inputs names.
_BY_SHAPE = {"ConstantOfShape": 0, "Expand": 1, "Tile": 1}


@dataclass
class Findings:
    """What a model file holds that matters for safety."""

    graphs: int = 0
    outside: list[str] = field(default_factory=list)
    """Names of the files that hold weights outside it."""
    domains: set[str] = field(default_factory=set)
    """Domains of its operators, functions of its own left out."""
    local: set[str] = field(default_factory=set)
    """Domains of functions that the file itself defines."""
    largest: int = 0
    """Elements of the largest tensor that it holds or makes from a constant shape."""

    @property
    def foreign(self) -> list[str]:
        """Domains of operators that nothing here can run."""
        return sorted(self.domains - set(KNOWN_DOMAINS) - self.local)


def inspect(path: Path) -> Findings | None:
    """Read a model file; None when it is no ONNX file, or a damaged one."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            reader = _Reader(data)
            reader.message(0, len(data), "model", 0)
            reader.judge_shapes()
            return reader.found if reader.found.graphs else None
    except (ValueError, OSError, IndexError, struct.error):
        return None


class _Reader:
    def __init__(self, data: mmap.mmap) -> None:
        self.data, self.found = data, Findings()
        self.shapes: dict[str, list[int]] = {}  # constants of a few int64, by name
        self.uses: list[tuple[str, list[str]]] = []  # operators that make a tensor of a given shape, their inputs

    def message(self, start: int, end: int, kind: str, depth: int) -> None:
        """Follow one message and what lies in it."""
        if depth > _MAX_DEPTH:
            raise ValueError("nested too deeply")
        if kind == "tensor":
            self._tensor(start, end)
            return
        inputs: list[str] = []
        outputs: list[str] = []
        operator, domain = "", ""
        for number, wire, low, high in _fields(self.data, start, end):
            if wire != 2:
                continue
            if kind == "node" and number in (1, 2, 4, 7):
                text = bytes(self.data[low:high]).decode("utf-8", "replace")
                if number == 1:
                    inputs.append(text)
                elif number == 2:
                    outputs.append(text)
                elif number == 4:
                    operator = text
                else:
                    domain = text
            elif kind == "function" and number == 10:
                self.found.local.add(bytes(self.data[low:high]).decode("utf-8", "replace"))
            elif number in _FOLLOW[kind]:
                inner = _FOLLOW[kind][number]
                self.found.graphs += inner == "graph"
                held = len(self.shapes)
                self.message(low, high, inner, depth + 1)
                if operator == "Constant" and inner == "attribute" and len(self.shapes) > held and outputs:
                    self.shapes[outputs[0]] = self.shapes.pop(next(reversed(self.shapes)))
        if kind == "node":
            self.found.domains.add(domain)
            if operator in _BY_SHAPE:
                self.uses.append((operator, inputs))

    def _tensor(self, start: int, end: int) -> None:
        dims: list[int] = []
        whole: list[int] = []
        name, raw, data_type = "", b"", 0
        for number, wire, low, high in _fields(self.data, start, end):
            if number == 13 and wire == 2:
                self.found.outside.append(_location(self.data, low, high))
            elif number == 14 and wire == 0 and low == 1 and not self.found.outside:
                self.found.outside.append("external data")
            elif number in (1, 7):
                if high - low <= 128 or wire == 0:  # longer ones are no shapes
                    values = [low] if wire == 0 else _packed(self.data, low, high)
                    (dims if number == 1 else whole).extend(_signed(v) for v in values)
                elif number == 1:
                    raise ValueError("a tensor of too many dimensions")
            elif number == 2 and wire == 0:
                data_type = low
            elif number == 8 and wire == 2:
                name = bytes(self.data[low:high]).decode("utf-8", "replace")
            elif number == 9 and wire == 2 and high - low <= 64:
                raw = bytes(self.data[low:high])
        if any(d < 0 for d in dims):
            raise ValueError("a tensor of negative size")
        self.found.largest = max(self.found.largest, prod(dims))
        if data_type == _INT64 and len(dims) <= 1 and prod(dims) <= 8:
            values = whole or list(struct.unpack(f"<{len(raw) // 8}q", raw[: len(raw) // 8 * 8]))
            self.shapes[name or f"\0{len(self.shapes)}"] = values

    def judge_shapes(self) -> None:
        """The sizes that operators are told to make, where the file tells them."""
        for operator, inputs in self.uses:
            which = _BY_SHAPE[operator]
            if len(inputs) > which and inputs[which] in self.shapes:
                size = prod(max(1, v) for v in self.shapes[inputs[which]])
                self.found.largest = max(self.found.largest, size)


def _fields(data: mmap.mmap, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """(field, wire type, start, end) of each field; for a varint, start is its value."""
    while at < end:
        tag, at = _varint(data, at, end)
        number, wire = tag >> 3, tag & 7
        if wire == 0:
            value, at = _varint(data, at, end)
            yield number, wire, value, at
        elif wire == 1 or wire == 5:
            at += 8 if wire == 1 else 4
        elif wire == 2:
            length, at = _varint(data, at, end)
            if at + length > end:
                raise ValueError("a field runs past its message")
            yield number, wire, at, at + length
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


def _packed(data: mmap.mmap, at: int, end: int) -> list[int]:
    """Varints of a packed field."""
    values = []
    while at < end:
        value, at = _varint(data, at, end)
        values.append(value)
    return values


def _signed(value: int) -> int:
    return value - (1 << 64) if value >= 1 << 63 else value


def _location(data: mmap.mmap, start: int, end: int) -> str:
    """Value of a key-value pair of a tensor's external data."""
    for number, wire, low, high in _fields(data, start, end):
        if number == 2 and wire == 2:
            return bytes(data[low:high]).decode("utf-8", "replace")
    return "external data"
