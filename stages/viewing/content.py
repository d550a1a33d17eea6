"""What a live view shows: a finished model at any time of a clip, or the newest checkpoint of one that still grows."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.animating.adding import pack_glb
from stages.animating.playing import ROOT_MOTION, Player
from stages.checkpoint import Checkpoints
from stages.meshing.pictures import joint_palette

if TYPE_CHECKING:
    from torch import Tensor

LOOKS = ("colour", "bones' skin", "what was seen", "shape")
_UNSEEN = np.array([0.86, 0.22, 0.28])
_RAMP = np.array([[0.27, 0.0, 0.33], [0.23, 0.32, 0.55], [0.13, 0.57, 0.55], [0.37, 0.79, 0.38], [0.99, 0.91, 0.14]])


@dataclass(frozen=True)
class Shown:
    """A mesh to draw: vertices (V, 3), faces (F, 3), colours (V, 3) uint8; bones (E, 2, 3) as pieces of line."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray
    bones: np.ndarray


def ramp(values: np.ndarray) -> np.ndarray:
    """Colours (N, 3) in 0..1 of values (N,) in 0..1, dark violet to yellow."""
    place = np.clip(values, 0, 1) * (len(_RAMP) - 1)
    low = np.minimum(place.astype(int), len(_RAMP) - 2)
    share = (place - low)[:, None]
    return _RAMP[low] * (1 - share) + _RAMP[low + 1] * share


class Finished:
    """The exported model."""

    def __init__(self, player: Player) -> None:
        self.player = player
        self.clips = [a.name for a in player.glb.animations]
        nodes = player.glb.joints()
        self._palette = joint_palette(len(nodes))
        _, self._parent = player.bones(player.scene(None, np.zeros(1)))
        seen = player.glb.attribute("_SEEN")
        self.seen = None if seen is None else seen[:, 0].astype(np.float64)

    @property
    def looks(self) -> tuple[str, ...]:
        """Ways of colouring that this file offers."""
        return tuple(look for look in LOOKS if look != "what was seen" or self.seen is not None)

    def seconds(self, clip: str) -> float:
        """Length of a clip; zero at rest."""
        return float(self.player.glb.animation(clip).time_s[-1]) if clip in self.clips else 0.0

    def at(self, clip: str, time_s: float, look: str) -> Shown:
        """The model at a moment of a clip, in place; an unknown clip is the rest pose."""
        animation = self.player.glb.animation(clip) if clip in self.clips else None
        scene = self.player.scene(animation, np.array([time_s]), root_motion=False)
        joints, _ = self.player.bones(scene)
        pairs = [(j, p) for j, p in enumerate(self._parent.tolist()) if p >= 0]
        bones = np.array([[joints[0, p], joints[0, j]] for j, p in pairs]).reshape(-1, 2, 3)
        vertices = self.player.surface(scene)[0]
        return Shown(vertices, self.player.faces, to_bytes(self._colours(look, vertices)), bones)

    def playing(self, clip: str, look: str) -> bytes:
        """A GLB that holds one clip, in place, coloured as `look` says: browsers play it smoothly by themselves."""
        glb = self.player.glb
        document = copy.deepcopy(glb.document)
        document["animations"] = [a for a in document.get("animations", []) if a.get("name") == clip]
        roots = {n for n, name in enumerate(glb.names) if name == ROOT_MOTION}
        for record in document["animations"]:
            record["channels"] = [c for c in record["channels"] if c["target"].get("node") not in roots]
        blob = bytearray(glb.blob)
        if look != "colour":
            blob.extend(b"\0" * (-len(blob) % 4))
            colours = to_bytes(self._colours(look, self.player.vertices)).astype(np.float64) / 255
            linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
            raw = np.ascontiguousarray(linear, np.float32).tobytes()
            document["bufferViews"].append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(raw)})
            blob.extend(raw)
            view = len(document["bufferViews"]) - 1
            accessor = {"bufferView": view, "componentType": 5126, "count": len(linear), "type": "VEC3"}
            document["accessors"].append(accessor)
            attributes = document["meshes"][0]["primitives"][0]["attributes"]
            attributes["COLOR_0"] = len(document["accessors"]) - 1
            for material in document.get("materials", []):
                material.get("pbrMetallicRoughness", {}).pop("baseColorTexture", None)
            document["buffers"][0]["byteLength"] = len(blob)
        return pack_glb(document, bytes(blob))

    def _colours(self, look: str, vertices: np.ndarray) -> np.ndarray:
        if look == "bones' skin":
            return self.player.skin_colour(self._palette)
        if look == "what was seen" and self.seen is not None:
            shown = ramp(np.sqrt(self.seen / max(float(self.seen.max()), 1e-9)))
            return np.where(self.seen[:, None] > 0, shown, _UNSEEN)
        if look == "shape":
            return normal_colours(vertices, self.player.faces)
        return self.player.colour


class Growing:
    """The newest checkpoint under a workspace's ``checkpoints``; read again only when there is a newer one."""

    def __init__(self, root: Path, resolution: int = 72) -> None:
        self.root, self.resolution = root, resolution
        self._known = ""
        self.shown: Shown | None = None
        self.step = 0
        self.loss: list[tuple[float, float]] = []
        self.preview: Path | None = None

    def refresh(self) -> bool:
        """Look for something newer; returns whether there was."""
        states = sorted(self.root.glob("*/step-*/state.json"), key=lambda p: p.stat().st_mtime)
        if not states or str(states[-1]) == self._known:
            return False
        folder = states[-1].parent.parent
        saved = Checkpoints(folder).latest()
        if saved is None:
            return False
        self._known = str(states[-1])
        self.step = saved.step
        self.loss = [(float(r["step"]), float(r["total"])) for r in saved.history if "total" in r]
        preview = folder / "preview.png"
        self.preview = preview if preview.is_file() else None
        shape = _rest_shape(saved.model_tensors(), saved.description, self.resolution)
        if shape is not None:
            self.shown = shape
        return True


def _rest_shape(tensors: dict[str, Tensor], description: dict[str, Any], resolution: int) -> Shown | None:
    """The canonical surface of a model that is being fitted, in its colours; None while it has no surface."""
    import torch
    from skimage.measure import marching_cubes

    from stages.fitting.surface import sample_volume
    from stages.model.banmo import Banmo

    model = Banmo.restore(tensors, description)
    volume, low, spacing = sample_volume(model, resolution)
    if not volume.min() < 0 < volume.max():
        return None
    vertices, faces, _, _ = marching_cubes(volume, 0.0, spacing=tuple(float(s) for s in spacing))
    points = torch.from_numpy(vertices.astype(np.float32)) + low
    centres, parents = model.bone_centres.numpy(), model.bone_parents.numpy()
    bones = np.array([[centres[p], centres[b]] for b, p in enumerate(parents.tolist()) if p != b]).reshape(-1, 2, 3)
    return Shown(points.numpy(), faces.astype(np.int64), to_bytes(model.colour(points).numpy()), bones)


def normal_colours(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Colours (V, 3) in 0..1 of the directions in which the surface faces."""
    from stages.geometry.raster import vertex_normals

    normals = vertex_normals(vertices, faces)
    return 0.5 + 0.5 * normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def to_bytes(colours: np.ndarray) -> np.ndarray:
    """(V, 3) uint8 of colours in 0..1."""
    return np.asarray(np.round(np.clip(colours, 0, 1) * 255), np.uint8)
