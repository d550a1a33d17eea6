"""The assembled model: a canonical field, bones, and the codes that pose them in every frame (BANMo, section 3).

Frames of reference: *canonical* space (shape at rest), *object* space at time t (posed, root motion off), *camera*
space. ``x_object = sum_b w_b J_b(t) x_canonical``; ``x_camera = G(t) x_object``. Units: the object is about 2 long.

Axis vocabulary: F frames of a batch, P pixels a frame, N points a frame, S samples a ray, B bones, V videos,
T all kept frames of the collection.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from stages.geometry.rotations import interpolate_rigid, invert_rigid
from stages.model.correspondence import cells_near
from stages.model.dense import DenseWarp
from stages.model.fields import GridField, MlpField
from stages.model.motion import BodyPose, FourierCode, RootPose
from stages.model.skeleton import (
    Bones,
    DeltaSkinning,
    blend,
    blend_rigidly,
    score_coefficients,
    skinning_weights,
)


@dataclass(frozen=True)
class VideoFacts:
    """What the model knows of one video: its name, kept frame times (s), image size and intrinsics (px)."""

    name: str
    time_s: tuple[float, ...]
    width: int
    height: int
    focal_px: tuple[float, float]
    principal_px: tuple[float, float]
    root_given: bool = False
    """Somebody gave the root poses: they may move, but their object space is meant."""
    root_wave_rad: tuple[float, float, float] | None = None
    """By how much root poses may be turned wrongly about each axis of object space, slowly, once they are steady: root
    mean square, radians. None where nobody knows."""


@dataclass(frozen=True)
class Architecture:
    """Sizes of the model's parts; written to model.json."""

    representation: str = "grid"
    voxel: float = 0.024
    mlp_depth: int = 8
    mlp_width: int = 256
    pose_code: int = 96
    pose_width: int = 128
    root_code: int = 32
    root_width: int = 64
    env_code: int = 16
    octaves: int = 5
    splines: int = 0
    blending: str = "linear"
    deformation: str = "skinning"


class FrameState(NamedTuple):
    """Everything that depends on the frame, for F frames."""

    transforms: Tensor
    """J (F, B, 4, 4), canonical to object space."""
    own: Tensor
    """Each bone's own rotation vector and shift against its parent (F, B, 6)."""
    inverse: Tensor
    """J^-1 (F, B, 4, 4)."""
    posed_coefficients: Tensor
    """Quadratic forms of the posed Gaussians (F, 10, B)."""
    rest_coefficients: Tensor
    """Quadratic forms of the Gaussians at rest (1, 10, B)."""
    code: Tensor
    """Body pose codes omega_b (F, C)."""
    camera_from_object: Tensor
    """G (F, 4, 4)."""
    intrinsics: Tensor
    """K (F, 3, 3), pixels."""
    environment: Tensor
    """omega_e (F, C)."""


class Banmo(nn.Module):
    """The model of a collection of V videos. `base_poses` (T, 4, 4) are G_0, the initial root poses at kept frames."""

    base_poses: Tensor
    gauge: Tensor
    surface: Tensor
    root_free: Tensor
    video_idx: Tensor
    time: Tensor

    def __init__(
        self,
        architecture: Architecture,
        videos: list[VideoFacts],
        base_poses: Tensor,
        bounds: Tensor,
        bones: Bones,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        a = self.architecture = architecture
        self.videos = videos
        self.video_names = [v.name for v in videos]
        count = len(videos)
        self.field: GridField | MlpField
        if a.representation == "grid":
            self.field = GridField(bounds, a.voxel, a.env_code)
        else:
            self.field = MlpField(bounds, a.env_code, a.mlp_depth, a.mlp_width)
        self.bones = bones
        self.body = BodyPose(count, len(bones), a.octaves, a.pose_code, a.pose_width, generator, a.splines)
        self.root = RootPose(count, max(2, a.octaves - 1), a.root_code, a.root_width, generator)
        self.environment = FourierCode(count, a.env_code, 2, generator)
        self.delta = DeltaSkinning(len(bones), a.pose_code)
        self.use_delta = False
        self._blend = {"linear": blend, "dual_quaternion": blend_rigidly}[a.blending]
        self.dense: nn.ModuleList | None = None
        if a.deformation != "skinning":
            turns = {"se3": True, "translation": False}[a.deformation]
            self.dense = nn.ModuleList(DenseWarp(a.pose_code, turns, generator) for _ in range(2))
        self.log_focal = nn.Parameter(torch.zeros(count))
        self.register_buffer("base_poses", base_poses.clone().float())
        self.register_buffer("gauge", torch.eye(4).repeat(len(base_poses), 1, 1))  # see stages.fitting.gauge
        self.register_buffer("surface", torch.zeros(0, 3))
        self._cells = (torch.zeros(0, 3), 0, torch.zeros(0, 3))  # see match_cells
        self.register_buffer("root_free", torch.ones(count))  # 0 holds a video's root poses where they were given

        # Kept as plain tensors, rebuilt from `videos`: times in seconds need float64 to stay exact on disk.
        self.starts = [0]
        for v in videos:
            self.starts.append(self.starts[-1] + len(v.time_s))
        index = torch.cat([torch.full((len(v.time_s),), i) for i, v in enumerate(videos)])
        self.register_buffer("video_idx", index, persistent=False)
        self.half_span_s = max(max(v.time_s[-1] - v.time_s[0] for v in videos) / 2, 1e-3)
        time = torch.cat([self.normalised_time(i, torch.tensor(v.time_s)) for i, v in enumerate(videos)])
        self.register_buffer("time", time, persistent=False)

    # ------------------------------------------------------------------------------------------ frames

    @property
    def beta_floor(self) -> float:
        """Smallest useful width of the density, a quarter of a voxel."""
        return 0.25 * self.architecture.voxel

    def normalised_time(self, video_idx: int, time_s: Tensor) -> Tensor:
        """Time in [-1, 1] over the longest video, zero in the middle of each; (N,) float32 from seconds (N,)."""
        times = self.videos[video_idx].time_s
        return ((time_s.double() - (times[0] + times[-1]) / 2) / self.half_span_s).float()

    def intrinsics_of(self, video_idx: Tensor) -> Tensor:
        """K (N, 3, 3) of videos (N,): the focal length is optimised as a log ratio."""
        scale = torch.exp(self.log_focal[video_idx])
        focal = torch.tensor([v.focal_px for v in self.videos], device=scale.device)[video_idx] * scale[:, None]
        centre = torch.tensor([v.principal_px for v in self.videos], device=scale.device)[video_idx]
        k = torch.zeros(len(video_idx), 3, 3, device=scale.device)
        k[:, 2, 2] = 1
        index = torch.tensor([0, 1], device=scale.device)
        k[:, index, index] = focal
        k[:, :2, 2] = centre
        return k

    def state_at(self, video_idx: Tensor, time: Tensor, base: Tensor, gauge: Tensor) -> FrameState:
        """Frame state at normalised `time` (F,) of videos (F,), with initial root poses `base` (F, 4, 4).

        `gauge` (F, 4, 4) is the rigid motion that goes from the root pose to all bones: G gauge^-1 and gauge J_b.
        """
        transforms, own, code = self.body(video_idx, time, self.bones.centres, self.bones.parents)
        transforms = gauge[:, None] @ transforms
        rest = score_coefficients(self.bones.centres, self.bones.orientations, self.bones.log_scales)[None]
        centres = (transforms[..., :3, :3] @ self.bones.centres[..., None]).squeeze(-1) + transforms[..., :3, 3]
        posed = score_coefficients(centres, transforms[..., :3, :3] @ self.bones.orientations, self.bones.log_scales)
        return FrameState(
            transforms=transforms,
            own=own,
            inverse=invert_rigid(transforms),
            posed_coefficients=posed,
            rest_coefficients=rest,
            code=code,
            camera_from_object=self.root(video_idx, time, base, self.root_free[video_idx]) @ invert_rigid(gauge),
            intrinsics=self.intrinsics_of(video_idx),
            environment=self.environment(video_idx, time),
        )

    def frames(self, frame_idx: Tensor) -> FrameState:
        """Frame state of kept frames `frame_idx` (F,), counted over the collection."""
        index = frame_idx.to(self.time.device)
        return self.state_at(self.video_idx[index], self.time[index], self.base_poses[index], self.gauge[index])

    # ------------------------------------------------------------------------------------------ warps

    def backward(self, state: FrameState, points: Tensor) -> Tensor:
        """W_backward: object space (F, N, 3) to canonical space (F, N, 3), equations 4 to 8."""
        if self.dense is not None:
            return self.dense[0](points, state.code)
        delta = self.delta(points, state.code) if self.use_delta else None
        weights = skinning_weights(points, state.posed_coefficients, delta)
        return self._blend(points, weights, state.inverse)

    def forward_points(self, state: FrameState, points: Tensor) -> Tensor:
        """W_forward: canonical space (F, N, 3) to object space (F, N, 3), equations 4 to 8."""
        if self.dense is not None:
            return self.dense[1](points, state.code)
        rest = self.delta(points, torch.zeros_like(state.code)) if self.use_delta else None
        weights = skinning_weights(points, state.rest_coefficients.expand(len(points), -1, -1), rest)
        return self._blend(points, weights, state.transforms)

    # ------------------------------------------------------------------------------------------ matching

    def match_cells(self) -> Tensor:
        """Cells (C, 3) of canonical space that pixels are matched to (equation 10); worked out once a surface."""
        surface, version, cells = self._cells
        if surface is not self.surface or version != self.surface._version:
            cells = cells_near(self.surface)
            self._cells = (self.surface, self.surface._version, cells)
        return cells

    # ------------------------------------------------------------------------------------------ reading a model

    def describe(self) -> dict[str, Any]:
        """Everything :meth:`restore` needs beside the tensors; goes to model.json."""
        return {
            "architecture": asdict(self.architecture),
            "bones": len(self.bones),
            "use_delta": self.use_delta,
            "bounds": [[float(x) for x in row] for row in self.field.bounds],
            "videos": [asdict(v) for v in self.videos],
            "conventions": "OpenCV cameras; x_camera = G x_object; canonical space y up; object about 2 units long",
        }

    @classmethod
    def restore(cls, tensors: dict[str, Tensor], description: dict[str, Any]) -> Banmo:
        """Rebuild a model from its tensors and its description."""
        videos = [
            VideoFacts(
                name=v["name"],
                time_s=tuple(v["time_s"]),
                width=v["width"],
                height=v["height"],
                focal_px=tuple(v["focal_px"]),
                principal_px=tuple(v["principal_px"]),
                root_given=bool(v.get("root_given", False)),
                root_wave_rad=(float(w[0]), float(w[1]), float(w[2])) if (w := v.get("root_wave_rad")) else None,
            )
            for v in description["videos"]
        ]
        count = int(description["bones"])
        model = cls(
            Architecture(**description["architecture"]),
            videos,
            tensors["base_poses"],
            torch.tensor(description["bounds"]),
            Bones(torch.zeros(count, 3), torch.zeros(count, 3), tensors["bones.parents"]),
            torch.Generator().manual_seed(0),
        )
        model.surface = torch.zeros_like(tensors["surface"])
        model.load_state_dict({"gauge": model.gauge, **tensors})
        model.use_delta = bool(description["use_delta"])
        return model

    @property
    def root_given(self) -> Tensor:
        """(V,) bool: videos whose root poses somebody gave."""
        return torch.tensor([video.root_given for video in self.videos], device=self.root_free.device)

    @property
    def bounds(self) -> Tensor:
        """Canonical box (2, 3)."""
        return self.field.bounds

    @property
    def bone_centres(self) -> Tensor:
        """(B, 3), canonical space."""
        return self.bones.centres.detach()

    @property
    def bone_parents(self) -> Tensor:
        """(B,) int64: parent of each bone, before it in the list; the root is its own."""
        return self.bones.parents

    @property
    def bone_orientations(self) -> Tensor:
        """(B, 3, 3): columns are the Gaussians' axes."""
        return self.bones.orientations.detach()

    @property
    def bone_scales(self) -> Tensor:
        """(B, 3): standard deviations along the axes."""
        return self.bones.log_scales.detach().exp()

    @torch.no_grad()
    def sdf(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at canonical points (N, 3), negative inside."""
        return self.field.sdf(self.field.prepare(), points)

    @torch.no_grad()
    def colour(self, points: Tensor, video_idx: int = 0, time: float = 0.0) -> Tensor:
        """Colour (N, 3) in 0..1 sRGB at canonical points (N, 3), in the light of a video at normalised `time`."""
        queried = self.field.query(self.field.prepare(), points)
        light = self.environment(torch.tensor([video_idx]), torch.tensor([time])).expand(len(points), -1)
        return self.field.shade(queried.appearance, torch.zeros_like(points) + torch.tensor([0.0, 0.0, 1.0]), light)

    @torch.no_grad()
    def embedding(self, points: Tensor) -> Tensor:
        """Canonical embedding (N, 16) at canonical points (N, 3), unit length."""
        return self.field.embedding(points)

    @torch.no_grad()
    def rest_weights(self, points: Tensor) -> Tensor:
        """Skinning weights (N, B) at rest of canonical points (N, 3)."""
        coefficients = score_coefficients(self.bones.centres, self.bones.orientations, self.bones.log_scales)[None]
        code = torch.zeros(1, self.architecture.pose_code)
        delta = self.delta(points[None], code) if self.use_delta else None
        return skinning_weights(points[None], coefficients, delta)[0]

    def _state_at_seconds(self, video_idx: int, time_s: Tensor) -> FrameState:
        video = torch.full((len(time_s),), video_idx)
        start, end = self.starts[video_idx], self.starts[video_idx + 1]
        known = torch.tensor(self.videos[video_idx].time_s, dtype=torch.float64)
        base = interpolate_rigid(self.base_poses[start:end], known, time_s.double())
        gauge = interpolate_rigid(self.gauge[start:end], known, time_s.double())
        return self.state_at(video, self.normalised_time(video_idx, time_s), base, gauge)

    @torch.no_grad()
    def bone_transforms(self, video_idx: int, time_s: Tensor) -> Tensor:
        """J (N, B, 4, 4), canonical to object space, at times (N,) in seconds."""
        return self._state_at_seconds(video_idx, time_s).transforms

    @torch.no_grad()
    def forward_warp(self, points: Tensor, video_idx: int, time_s: Tensor) -> Tensor:
        """Canonical points (N, 3) in object space at times (T,) in seconds: (T, N, 3)."""
        state = self._state_at_seconds(video_idx, time_s)
        return self.forward_points(state, points[None].expand(len(time_s), -1, -1))

    @torch.no_grad()
    def root_poses(self, video_idx: int, time_s: Tensor) -> Tensor:
        """G (N, 4, 4), camera_from_object, at times (N,) in seconds."""
        return self._state_at_seconds(video_idx, time_s).camera_from_object

    @torch.no_grad()
    def intrinsics(self, video_idx: int) -> Tensor:
        """K (3, 3) in pixels of the kept frames."""
        return self.intrinsics_of(torch.tensor([video_idx]))[0]
