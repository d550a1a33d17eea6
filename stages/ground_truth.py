"""What a reconstruction is measured against: true surfaces, root poses, masks and flow of some videos.

The folder of an object::

    gt/meshes.npz              faces (F, 3), rest (V, 3), verts (N, V, 3), video_names (K), frame_index (K, T): rows of
                               `verts`; face_seen (F) if some faces never show
    <look>/gt/<video>.json     object_to_camera: a 4x4 a frame
    <look>/gt/<video>-mask.npz packed (np.packbits) and shape (T, H, W)
    <look>/gt/<video>-flow.npz frames (N), flow (N, H, W, 2) px from frame i to i + 1, object and visible (N, H, W)
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from pipeline import BadInput
from stages.formats import FormatError, read_json

_MESHES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")


@dataclass(frozen=True)
class TrueSurfaces:
    """rest_edge: longest edge of the rest shape's box; vertices: video -> (T, V, 3); faces (F, 3): those that show."""

    vertices: dict[str, np.ndarray]
    faces: np.ndarray
    rest_edge: float


def read_surfaces(root: Path) -> TrueSurfaces:
    """Read ``gt/meshes.npz`` of an object's folder, or the file itself. Raises BadInput when it is none."""
    path = root / "gt" / "meshes.npz" if root.is_dir() else root
    arrays = _arrays(path, ("faces", "rest", "verts", "video_names", "frame_index"))
    faces = arrays["faces"].astype(np.int64)
    if "face_seen" in arrays:
        faces = faces[arrays["face_seen"].astype(bool)]
    rows = arrays["frame_index"]
    names = [str(n) for n in arrays["video_names"]]
    vertices = {name: arrays["verts"][rows[k]].astype(np.float64) for k, name in enumerate(names)}
    return TrueSurfaces(vertices, faces, float(np.ptp(arrays["rest"], axis=0).max()))


def looks(root: Path) -> list[str]:
    """Names of the folders that hold a ``gt`` folder with poses or masks."""
    if not root.is_dir():
        return []
    return sorted(p.parent.name for p in root.glob("*/gt") if p.is_dir())


def read_rotations(path: Path) -> np.ndarray:
    """(T, 3, 3) of a JSON file with ``object_to_camera``; a scale inside them is taken off."""
    value = read_json(path)
    rows = value.get("object_to_camera") if isinstance(value, dict) else value
    try:
        matrices = np.array(rows, np.float64)[:, :3, :3]
    except (TypeError, ValueError, IndexError) as error:
        raise FormatError(f"{path.name}: object_to_camera is missing or malformed") from error
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return np.asarray(u @ vt)


def read_true_masks(path: Path) -> np.ndarray:
    """(T, H, W) bool."""
    arrays = _arrays(path, ("packed", "shape"))
    shape = tuple(int(n) for n in arrays["shape"])
    return np.unpackbits(arrays["packed"], count=int(np.prod(shape))).reshape(shape).astype(bool)


def read_true_flow(path: Path) -> dict[str, np.ndarray]:
    """The arrays ``frames``, ``flow``, ``object`` and ``visible``."""
    return _arrays(path, ("frames", "flow", "object", "visible"))


def frame_meshes(folder: Path, count: int) -> dict[int, Path]:
    """Mesh file of each frame: in the order of names where there are `count`, else by the last number in the name."""
    files = sorted(p for p in folder.glob("*") if p.suffix.lower() in _MESHES) if folder.is_dir() else []
    if len(files) == count:
        return dict(enumerate(files))
    found = {}
    for file in files:
        numbers = re.findall(r"\d+", file.stem)
        if not numbers:
            raise BadInput(f"{len(files)} meshes for {count} frames, and {file.name} has no number", where=folder)
        if int(numbers[-1]) < count:
            found[int(numbers[-1])] = file
    return found


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a mesh file. Raises BadInput when it holds none."""
    try:
        mesh: Any = trimesh.load(path, process=False, force="mesh")
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise BadInput(f"{path.name} cannot be read as a mesh ({error})", where=path.parent) from error
    if not len(faces):
        raise BadInput(f"{path.name} has no faces", where=path.parent)
    return vertices, faces


def _arrays(path: Path, needed: tuple[str, ...]) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise BadInput(f"{path.name} cannot be read ({error})", where=path.parent) from error
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise BadInput(f"{path.name} lacks {', '.join(missing)}", where=path.parent)
    return arrays
