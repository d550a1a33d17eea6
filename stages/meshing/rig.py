"""From a fitted model to a rig: surface, skin, joints; and the rig's motion in each video."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from stages.geometry.raster import vertex_normals
from stages.meshing.skeleton import Skeleton, build_skeleton, nearest_rigid
from stages.meshing.skinning import blend, fit_influences, refit_worst
from stages.meshing.surface import EmptySurface, Mesh, SurfaceFacts, clean_surface, evaluate, extract

_POINTS_PER_WARP = 150_000
_FIT_FRAMES = 150  # of all clips together, to fit the skin to
_SKIN_TOLERANCE = 5e-4  # of the length: vertices that are farther off in some frame are fitted again


class Animatable(Protocol):
    """What a fitted model must answer, float32 tensors without gradient; canonical space has y up and z front."""

    @property
    def bounds(self) -> Tensor:
        """(2, 3) canonical box."""
        ...

    @property
    def bone_centres(self) -> Tensor:
        """(B, 3)."""
        ...

    @property
    def bone_parents(self) -> Tensor | None:
        """(B,) the parent of each bone, a root being its own; None where bones move loosely."""
        ...

    @property
    def bone_orientations(self) -> Tensor:
        """(B, 3, 3)."""
        ...

    @property
    def bone_scales(self) -> Tensor:
        """(B, 3)."""
        ...

    def sdf(self, points: Tensor) -> Tensor:
        """(N,) signed distance at (N, 3), negative inside."""
        ...

    def colour(self, points: Tensor, video_idx: int = 0, time: float = 0.0) -> Tensor:
        """(N, 3) sRGB in 0..1; `time` runs over -1..1 within the video."""
        ...

    def rest_weights(self, points: Tensor) -> Tensor:
        """(N, B) skinning weights at rest."""
        ...

    def bone_transforms(self, video_idx: int, time_s: Tensor) -> Tensor:
        """(T, B, 4, 4) canonical to object space."""
        ...

    def forward_warp(self, points: Tensor, video_idx: int, time_s: Tensor) -> Tensor:
        """(T, N, 3) object space."""
        ...

    def root_poses(self, video_idx: int, time_s: Tensor) -> Tensor:
        """(T, 4, 4) camera_from_object."""
        ...

    def intrinsics(self, video_idx: int) -> Tensor:
        """(3, 3) pixels."""
        ...


@dataclass(frozen=True)
class Rig:
    """The model at rest: surface, normals (V, 3), joints, and skins by number of influences.

    weights: (V, B), the model's own, in the model's bone order. skins: influences -> bone indices and weights (V, K).
    """

    mesh: Mesh
    normals: np.ndarray
    weights: np.ndarray
    skeleton: Skeleton
    facts: SurfaceFacts
    skins: dict[int, tuple[np.ndarray, np.ndarray]]

    def joint_skin(self, influences: int) -> tuple[np.ndarray, np.ndarray]:
        """Joint (not bone) indices and weights (V, K), descending; index 0 where the weight is 0."""
        bone, weight = self.skins[influences]
        return np.where(weight > 0, self.skeleton.joint_of_bone()[bone], 0), weight


@dataclass(frozen=True)
class PosedClip:
    """The rig in one video, at T times.

    vertices: (T, V, 3) float32 as the rig poses them, object space: what every file shows. joints: (T, B, 4, 4)
    object_from_joint. camera_from_object: (T, 4, 4). intrinsics: (3, 3). skinning_error: influences kept -> the
    largest distance between the model's warp and linear blend skinning with so many influences, over vertices and
    frames, in units of the object's length.
    """

    vertices: np.ndarray
    joints: np.ndarray
    camera_from_object: np.ndarray
    intrinsics: np.ndarray
    skinning_error: dict[int, float]


def surface_of(
    model: Animatable, resolution: int, face_budget: int, repair: Callable[[Mesh], Mesh] | None = None
) -> tuple[Mesh, SurfaceFacts]:
    """The model's surface at level 0, cleaned; of a model without one, a level that encloses 2 % of its box."""
    bounds = model.bounds.cpu().numpy().astype(np.float64)
    try:
        return clean_surface(extract(model.sdf, bounds, resolution), face_budget, repair=repair)
    except EmptySurface:
        axes = [np.linspace(bounds[0, k], bounds[1, k], 32) for k in range(3)]
        values = evaluate(model.sdf, np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
        level = float(np.quantile(values, 0.02)) + 1e-4
        return clean_surface(extract(model.sdf, bounds, min(resolution, 64), level), face_budget, level, repair)


def build_rig(
    model: Animatable,
    clip_times_s: Sequence[np.ndarray],
    resolution: int,
    face_budget: int,
    influences: Sequence[int] = (8, 4),
    repair: Callable[[Mesh], Mesh] | None = None,
) -> tuple[Rig, list[PosedClip]]:
    """Extract the surface, join the bones, and pose both as in every video.

    Args:
        clip_times_s: times in seconds of each video, in the model's order.
        resolution: cells along the longest edge of the object's box.
        face_budget: faces to keep.
        influences: the numbers of influences to make skins for; the largest is made as exact as it can be.
        repair: a tool of the user's that mends the mesh before it is decimated.
    """
    mesh, facts = surface_of(model, resolution, face_budget, repair)
    weights = model.rest_weights(_points(mesh.vertices)).cpu().numpy().astype(np.float64)
    weights = np.clip(weights, 0, None)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    posed = [_warp(model, mesh.vertices, k, times) for k, times in enumerate(clip_times_s)]
    motion = [nearest_rigid(_bone_motion(model, k, times)) for k, times in enumerate(clip_times_s)]
    every = [slice(None, None, max(1, -(-len(times) * len(posed) // _FIT_FRAMES))) for times in clip_times_s]
    some_motion = np.concatenate([m[part] for m, part in zip(motion, every, strict=True)])
    some_posed = np.concatenate([p[part] for p, part in zip(posed, every, strict=True)])

    def inside(points: np.ndarray) -> np.ndarray:
        return evaluate(model.sdf, points) < facts.level

    parents = None if model.bone_parents is None else model.bone_parents.cpu().numpy()
    skeleton = build_skeleton(model.bone_centres.cpu().numpy(), some_motion, weights, mesh.vertices, inside, parents)
    length = max(mesh.length, 1e-12)
    skins = {k: fit_influences(mesh.vertices, weights, some_motion, some_posed, k, length) for k in influences}
    most = max(influences)
    whole = np.concatenate(motion), np.concatenate(posed)
    skins[most] = refit_worst(mesh.vertices, weights, *whole, skins[most], length, _SKIN_TOLERANCE)
    rig = Rig(mesh, vertex_normals(mesh.vertices, mesh.faces), weights, skeleton, facts, skins)
    clips = [_posed_clip(model, rig, k, clip_times_s[k], posed[k], motion[k]) for k in range(len(posed))]
    return rig, clips


def _posed_clip(
    model: Animatable, rig: Rig, video_idx: int, time_s: np.ndarray, vertices: np.ndarray, transforms: np.ndarray
) -> PosedClip:
    error = {}
    for influences in sorted(rig.skins):  # the most exact comes last, and stays
        skinned = blend(rig.mesh.vertices, transforms, *rig.skins[influences])
        error[influences] = float(np.linalg.norm(skinned - vertices, axis=-1).max()) / max(rig.mesh.length, 1e-12)
    return PosedClip(
        skinned.astype(np.float32),
        rig.skeleton.posed(transforms),
        nearest_rigid(model.root_poses(video_idx, _seconds(time_s)).cpu().numpy()),
        model.intrinsics(video_idx).cpu().numpy().astype(np.float64),
        error,
    )


def surface_colour(model: Animatable, rig: Rig, video_idx: int) -> np.ndarray:
    """(V, 3) sRGB in 0..1: mean over the light of three moments of a video."""
    points = _points(rig.mesh.vertices)
    moments = [model.colour(points, video_idx, time).cpu().numpy() for time in (-0.5, 0.0, 0.5)]
    return np.clip(np.mean(moments, axis=0, dtype=np.float64), 0, 1)


def field_colour(model: Animatable, points: np.ndarray, video_count: int) -> np.ndarray:
    """(N, 3) sRGB in 0..1 at canonical points (N, 3): mean over the light of up to four videos."""
    chosen = np.unique(np.linspace(0, video_count - 1, min(4, video_count)).round().astype(int))
    total = np.zeros((len(points), 3))
    for start in range(0, len(points), _POINTS_PER_WARP):
        part = _points(points[start : start + _POINTS_PER_WARP])
        for k in chosen:
            total[start : start + _POINTS_PER_WARP] += model.colour(part, int(k), 0.0).cpu().numpy()
    return np.clip(total / len(chosen), 0, 1)


def _warp(model: Animatable, vertices: np.ndarray, video_idx: int, time_s: np.ndarray) -> np.ndarray:
    points = _points(vertices)
    per_pass = max(1, _POINTS_PER_WARP // len(points))
    parts = [
        model.forward_warp(points, video_idx, _seconds(time_s[i : i + per_pass])).cpu().numpy()
        for i in range(0, len(time_s), per_pass)
    ]
    return np.concatenate(parts).astype(np.float32)


def _bone_motion(model: Animatable, video_idx: int, time_s: np.ndarray) -> np.ndarray:
    return model.bone_transforms(video_idx, _seconds(time_s)).cpu().numpy().astype(np.float64)


def _points(vertices: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(vertices, np.float32))


def _seconds(time_s: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(time_s, np.float64))
