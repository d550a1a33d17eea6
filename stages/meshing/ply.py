"""Binary PLY: a mesh with colours as bytes; the same mesh gives the same bytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def to_bytes(colour: np.ndarray) -> np.ndarray:
    """Colours in 0..1 as uint8."""
    return np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8)


@dataclass(frozen=True)
class PlyWriter:
    """Writes meshes that share faces and colours: only the positions change from frame to frame.

    colour: (V, 3) uint8 sRGB. extra: further vertex properties by name, each (V,) float32.
    """

    faces: np.ndarray
    colour: np.ndarray
    extra: dict[str, np.ndarray]

    def encode(self, vertices: np.ndarray) -> bytes:
        """The file of positions (V, 3)."""
        fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
        fields += [(name, "<f4") for name in self.extra]
        row = np.empty(len(vertices), np.dtype(fields))
        for axis, name in enumerate("xyz"):
            row[name] = vertices[:, axis]
        for channel, name in enumerate(("red", "green", "blue")):
            row[name] = self.colour[:, channel]
        for name, values in self.extra.items():
            row[name] = values
        index, name_of_index = ("<u2", "ushort") if len(vertices) <= 65_535 else ("<i4", "int")
        face = np.empty(len(self.faces), np.dtype([("count", "u1"), ("index", index, 3)]))
        face["count"], face["index"] = 3, self.faces
        kinds = {"<f4": "float", "u1": "uchar"}
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
        header += [f"property {kinds[kind]} {name}" for name, kind in fields]
        header += [f"element face {len(self.faces)}", f"property list uchar {name_of_index} vertex_indices"]
        header += ["end_header\n"]
        return "\n".join(header).encode("ascii") + row.tobytes() + face.tobytes()
