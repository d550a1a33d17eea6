"""Codes in time and what they drive: body pose, root pose, environment (BANMo, sections 3.1 to 3.3).

A code is a Fourier series in time, its matrix A_v separate for each video: ``omega_v(t) = A_v F(t)`` with
``F(t) = [1, t, sin(2^k pi t), cos(2^k pi t)]_k`` and t in [-1, 1] over the video. So a code is defined at every
instant, kept frame or not, and neighbours in time share their parameters.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from stages.geometry.rotations import rigid, so3_exp


def octaves_for(duration_s: float, shortest_period_s: float) -> int:
    """Octaves K so that the fastest term of F(t) has about `shortest_period_s` in a clip of `duration_s`."""
    ratio = max(duration_s, 1e-3) / max(shortest_period_s, 1e-3)
    return min(10, max(2, 1 + round(math.log2(max(ratio, 1.0)))))


def spline_basis(time: Tensor, count: int) -> Tensor:
    """Uniform cubic B-splines (N, count) over [-1, 1] at times (N,): they sum to one, each spans four spacings."""
    spacing = 2 / (count - 3)
    centre = -1 + spacing * (torch.arange(count, dtype=time.dtype, device=time.device) - 1)
    x = ((time[:, None] - centre) / spacing).abs()
    return torch.where(x < 1, 2 / 3 - x * x * (1 - x / 2), (2 - x).clamp_min(0) ** 3 / 6)


def splines_for(duration_s: float, spacing_s: float) -> int:
    """How many splines span a clip of `duration_s` at about `spacing_s`; none if that is zero."""
    return 0 if spacing_s <= 0 else max(4, 3 + round(max(duration_s, 1e-3) / spacing_s))


def fourier_basis(time: Tensor, octaves: int) -> Tensor:
    """F(t) (N, 2 + 2K) of times (N,) in [-1, 1]."""
    phase = time[:, None] * (math.pi * 2.0 ** torch.arange(octaves, dtype=time.dtype, device=time.device))
    return torch.cat([torch.ones_like(time)[:, None], time[:, None], phase.sin(), phase.cos()], 1)


class FourierCode(nn.Module):
    """``omega_v(t) = A_v F(t)`` of C channels for V videos; higher octaves begin smaller.

    Octaves leave gaps between their frequencies. `splines` more functions, each alive for a moment, fill them.
    """

    def __init__(self, videos: int, channels: int, octaves: int, generator: torch.Generator, splines: int = 0) -> None:
        super().__init__()
        self.octaves, self.splines = octaves, splines
        size = 2.0 ** -torch.arange(octaves, dtype=torch.float32).clamp_max(6) * 0.5 + 0.05
        scale = torch.cat([torch.ones(2), size, size])
        noise = torch.randn(videos, 2 + 2 * octaves, channels, generator=generator)
        self.coefficients = nn.Parameter(
            torch.cat([noise * scale[:, None], noise.new_zeros(videos, splines, channels)], 1)
        )

    def basis(self, time: Tensor) -> Tensor:
        """F(t) (N, 2 + 2K + splines) of times (N,) in [-1, 1]."""
        basis = fourier_basis(time, self.octaves)
        return torch.cat([basis, spline_basis(time, self.splines)], 1) if self.splines else basis

    def forward(self, video_idx: Tensor, time: Tensor) -> Tensor:
        """Codes (N, C) at `time` (N,) of videos `video_idx` (N,)."""
        # Indexing with brackets adds gradients up in any order where tensors are large; this does so in theirs.
        own = self.coefficients.index_select(0, video_idx)
        return torch.einsum("nk,nkc->nc", self.basis(time), own)

    @torch.no_grad()
    def steer(self, video: int, time: Tensor, change: Tensor, ridge: float) -> None:
        """Change a video's code by `change` (T, C) at times (T,), as far as its functions of time can (ridge)."""
        basis = self.basis(time).double()
        gram = basis.T @ basis + ridge * torch.eye(basis.shape[1], dtype=torch.float64, device=basis.device)
        self.coefficients[video] += torch.linalg.solve(gram, basis.T @ change.double()).to(self.coefficients)


class MotionHead(nn.Module):
    """Two hidden layers from a code to `count` rigid motions: rotation vectors and translations, near zero at first."""

    def __init__(self, code_channels: int, count: int, width: int, translation_scale: float) -> None:
        super().__init__()
        self.count, self.translation_scale = count, translation_scale
        self.hidden1 = nn.Linear(code_channels, width)
        self.hidden2 = nn.Linear(width, width)
        self.out = nn.Linear(width, 6 * count)
        nn.init.normal_(self.out.weight, std=1e-3)
        nn.init.zeros_(self.out.bias)

    def forward(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """Rotation vectors (N, count, 3) in radians and translations (N, count, 3)."""
        hidden = torch.relu(self.hidden1(code))
        hidden = torch.relu(self.hidden2(hidden))
        out = self.out(hidden).reshape(len(code), self.count, 6)
        return out[..., :3], out[..., 3:] * self.translation_scale


class BodyPose(nn.Module):
    """Bone transforms J_b(t), canonical to object space, from the body pose code omega_b (equations 4, 5).

    The paper's bones move freely. Ours turn about the joint with their parent, half way between the two centres,
    and inherit its motion; a small shift of their own remains. So limbs swing rather than stretch, which is what
    lets a limb be found before it is well modelled, and the tree is the rig that is exported.
    """

    def __init__(
        self,
        videos: int,
        bones: int,
        octaves: int,
        code: int,
        width: int,
        generator: torch.Generator,
        splines: int = 0,
    ) -> None:
        super().__init__()
        self.code = FourierCode(videos, code, octaves, generator, splines)
        self.head = MotionHead(code, bones, width, translation_scale=0.3)

    def forward(
        self, video_idx: Tensor, time: Tensor, centres: Tensor, parents: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """J (N, B, 4, 4) at `time` (N,), own turns and shifts (N, B, 6), and codes (N, C); `centres` (B, 3)."""
        code = self.code(video_idx, time)
        vectors, shift = self.head(code)
        rotation = so3_exp(vectors)
        joints = (centres + centres[parents]) / 2
        local = rigid(rotation, joints - (rotation @ joints[..., None]).squeeze(-1) + shift)
        return chain(local, parents), torch.cat([vectors, shift], -1), code


def chain(local: Tensor, parents: Tensor) -> Tensor:
    """Compose transforms relative to the parent (N, B, 4, 4) along a tree (B,) whose parents come first."""
    depth = [0] * len(parents)
    for bone, parent in enumerate(parents.tolist()):
        depth[bone] = 0 if parent == bone else depth[parent] + 1
    composed: list[Tensor] = [local[:, 0]] * len(parents)
    for level in range(max(depth) + 1):
        members = [bone for bone, d in enumerate(depth) if d == level]
        if level == 0:
            for bone in members:
                composed[bone] = local[:, bone]
            continue
        above = torch.stack([composed[int(parents[bone])] for bone in members], 1)
        here = above @ local[:, members]
        for i, bone in enumerate(members):
            composed[bone] = here[:, i]
    return torch.stack(composed, 1)


class RootPose(nn.Module):
    """Correction of the initial root poses: ``G(t) = MLP_G(omega_r(t)) G_0(t)`` (BANMo, section 3.4).

    The correction turns the object about the depth it stands at, not about the camera's centre, so that rotation
    and translation stay decoupled.
    """

    def __init__(self, videos: int, octaves: int, code: int, width: int, generator: torch.Generator) -> None:
        super().__init__()
        self.code = FourierCode(videos, code, octaves, generator)
        self.head = MotionHead(code, 1, width, translation_scale=0.3)

    def forward(self, video_idx: Tensor, time: Tensor, base: Tensor, free: Tensor) -> Tensor:
        """Root poses (N, 4, 4), camera_from_object, from `base` poses (N, 4, 4) at `time` (N,).

        `free` (N,) in 0..1 scales the correction; zero leaves the base pose as it is.
        """
        vectors, shift = self.head(self.code(video_idx, time))
        rotation = so3_exp(vectors[:, 0] * free[:, None]) @ base[:, :3, :3]
        return rigid(rotation, base[:, :3, 3] + shift[:, 0] * free[:, None])
