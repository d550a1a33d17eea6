"""Playing a rigged GLB: its skinned surface and its joints at any time of any of its animations.

Scenes of ours hold a node ``root_motion`` above the joints that carries the object before the camera of a clip, in
glTF's camera frame (x right, y up, z backward). With it, vertices come out as the clip's camera saw them; without it,
in object space (y up, front towards +z).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.animating.glb import Animation, Glb, GlbError

ROOT_MOTION = "root_motion"
CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenCV's camera frame from glTF's: half a turn about x, its own inverse."""


@dataclass(frozen=True)
class Player:
    """The surface of a file, ready to be posed. vertices (V, 3) at rest, faces (F, 3), colour (V, 3) sRGB in 0..1."""

    glb: Glb
    vertices: np.ndarray
    faces: np.ndarray
    colour: np.ndarray
    joint: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, glb: Glb) -> Player:
        """Read the surface and the skin of a file. Raises GlbError."""
        vertices = glb.attribute("POSITION")
        if vertices is None or not len(vertices):
            raise GlbError("holds no mesh")
        joint, weight = glb.skin()
        if len(joint) != len(vertices):
            raise GlbError("its skin has another length than its mesh")
        return cls(glb, vertices.astype(np.float64), glb.faces(), vertex_colour(glb, len(vertices)), joint, weight)

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints, in the skin's order."""
        return [self.glb.names[n] for n in self.glb.joints()]

    def scene(self, animation: Animation | None, time_s: np.ndarray, root_motion: bool = True) -> np.ndarray:
        """scene_from_node (N, nodes, 4, 4) at times (N,)."""
        local = self.glb.locals_at(animation, time_s)
        if not root_motion:
            for node, name in enumerate(self.glb.names):
                if name == ROOT_MOTION:
                    local[:, node] = np.eye(4)
        return self.glb.scene_from_node(local)

    def surface(self, scene: np.ndarray) -> np.ndarray:
        """Skinned vertices (N, V, 3) of scene_from_node (N, nodes, 4, 4)."""
        bones = scene[:, self.glb.joints()] @ self.glb.inverse_bind()
        result = np.zeros((len(scene), *self.vertices.shape))
        for k in range(self.joint.shape[1]):
            part = self.weight[:, k]
            used = np.flatnonzero(part > 0)
            moved = bones[:, self.joint[used, k]]
            here = np.einsum("nvij,vj->nvi", moved[..., :3, :3], self.vertices[used]) + moved[..., :3, 3]
            result[:, used] += part[used][None, :, None] * here
        return result

    def skin_colour(self, palette: np.ndarray) -> np.ndarray:
        """(V, 3): colours of the joints (B, 3) mixed by skin weight."""
        return (palette[self.joint] * self.weight[..., None]).sum(axis=1)

    def bones(self, scene: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint places (N, B, 3) and the index of each joint's parent (B,), -1 for a root, of scene_from_node."""
        nodes = self.glb.joints()
        place = {node: i for i, node in enumerate(nodes)}
        parent = np.array([place.get(int(self.glb.parent[n]), -1) for n in nodes])
        return scene[:, nodes][..., :3, 3], parent


def vertex_colour(glb: Glb, count: int) -> np.ndarray:
    """sRGB colours (V, 3) in 0..1: of COLOR_1 where there is one (COLOR_0 is white then), of COLOR_0, else grey."""
    for name in ("COLOR_1", "COLOR_0"):
        linear = glb.attribute(name)
        if linear is not None and len(linear) == count and linear.shape[1] >= 3:
            c = np.clip(linear[:, :3].astype(np.float64), 0, 1)
            return np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.maximum(c, 1e-12) ** (1 / 2.4) - 0.055)
    return np.full((count, 3), 0.7)
