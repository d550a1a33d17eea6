"""A category's puppet: its canonical surface on a skeleton, with limbs that can be lengthened and turned.

What two individuals of one category share is the canonical surface that our networks' embeddings point to (paper,
section 3.3: one surface a category). Put on a skeleton, it can be fitted to the animal in a clip and to the surface of
a model alike, each with limbs of its own length; what then goes from one to the other is how the limbs are turned.

Space of the rest shape: y up, z front, x its left, 2 units long. Axes: N frames, V vertices, B bones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.geometry.rotations import so3_exp

_TWIST, _LATERAL, _ANY = 6.0, 10.0, 1.0
_HANG = 0.55  # radians by which arms that are held out at rest hang down when they do nothing
_HINGED = ("forearm", "shin", "hand", "foot")
_STIFF = {"pelvis": 1.0, "loin": 3.0, "spine": 3.0, "chest": 3.0, "clavicle": 4.0, "ear": 8.0, "tail": 0.3}


@dataclass(frozen=True)
class Puppet:
    """The canonical surface of a category and its skeleton; the first bone is the root, parents come first."""

    vertices: Tensor  # (V, 3)
    normals: Tensor  # (V, 3), outward, unit length
    embedding: Tensor  # (V, 16), unit length
    weights: Tensor  # (V, B), rows sum to one
    names: tuple[str, ...]
    parents: tuple[int, ...]  # -1 for the root
    joints: Tensor  # (B, 3): a bone turns about its joint
    tips: Tensor  # (B, 3)
    axes: Tensor  # (B, 3): from joint to tip, unit length
    twins: Tensor  # (B,) int64: the bone's mirror image; itself in the middle
    idle: Tensor  # (B, 3): rotation vectors of a subject that just stands
    price: Tensor  # (B, 3, 3): r^T P r is how dear it is to turn a bone by r more than that

    @classmethod
    def of(cls, surface: dict[str, np.ndarray], skeleton: dict[str, np.ndarray]) -> Puppet:
        """From the canonical surface (`vertices`, `normals`, `embedding`) and the skeleton on it.

        Args:
            skeleton: `names`, `parents`, `joints`, `tips` (B, ...) and `weights` (V, B).
        """
        names = tuple(str(n) for n in skeleton["names"])
        joints = torch.from_numpy(skeleton["joints"]).float()
        tips = torch.from_numpy(skeleton["tips"]).float()
        axes = torch.nn.functional.normalize(tips - joints, dim=-1)
        weights = torch.from_numpy(skeleton["weights"]).float()
        twins = [names.index(_mirrored(name)) for name in names]
        return cls(
            vertices=torch.from_numpy(surface["vertices"]).float(),
            normals=torch.from_numpy(surface["normals"]).float(),
            embedding=torch.from_numpy(surface["embedding"]).float(),
            weights=weights / weights.sum(1, keepdim=True),
            names=names,
            parents=tuple(int(p) for p in skeleton["parents"]),
            joints=joints,
            tips=tips,
            axes=axes,
            twins=torch.tensor(twins),
            idle=_idle(names, axes),
            price=_prices(names, axes),
        )

    def shape(self, log_lengths: Tensor, log_girths: Tensor) -> Tensor:
        """(B, 3, 3) stretch of every bone along its axis and across it; left and right are made alike."""
        length = ((log_lengths + log_lengths[self.twins]) / 2).exp()[:, None, None]
        girth = ((log_girths + log_girths[self.twins]) / 2).exp()[:, None, None]
        along = self.axes[:, :, None] * self.axes[:, None, :]
        return length * along + girth * (torch.eye(3) - along)

    def turned(self, root: Tensor, turns: Tensor) -> Tensor:
        """(N, B, 3, 3) orientation of each bone: `root` (N, 3, 3), then rotation vectors `turns` (N, B, 3)."""
        local = so3_exp(turns)
        found = [root]
        for bone in range(1, len(self.parents)):
            found.append(found[self.parents[bone]] @ local[:, bone])
        return torch.stack(found, 1)

    def placed(self, shape: Tensor, orientations: Tensor, shift: Tensor) -> Tensor:
        """(N, B, 3) joints, the root's at `shift` (N, 3), of bones of a `shape` (B, 3, 3) in `orientations`."""
        found = [shift]
        for bone in range(1, len(self.parents)):
            parent = self.parents[bone]
            offset = shape[parent] @ (self.joints[bone] - self.joints[parent])
            found.append(found[parent] + orientations[:, parent] @ offset)
        return torch.stack(found, 1)

    def transforms(self, shape: Tensor, orientations: Tensor, shift: Tensor) -> Tensor:
        """(N, B, 3, 4) affine maps from the rest surface to the posed one."""
        linear = orientations @ shape
        joints = self.placed(shape, orientations, shift)
        return torch.cat([linear, (joints - (linear @ self.joints[..., None]).squeeze(-1))[..., None]], -1)


def skinned(points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Points ([N,] P, 3) moved by transforms (N, B, 3, 4), blended with weights ([N,] P, B): (N, P, 3)."""
    blended = (weights @ transforms.flatten(-2)).unflatten(-1, (3, 4))
    return (blended[..., :3] @ points[..., None]).squeeze(-1) + blended[..., 3]


def vertex_turns(weights: Tensor, orientations: Tensor) -> Tensor:
    """(N, P, 3, 3) blended orientations of vertices with weights (P, B); for normals, not exactly rotations."""
    return (weights @ orientations.flatten(-2)).unflatten(-1, (3, 3))


def _mirrored(name: str) -> str:
    if name.endswith("_left"):
        return name[:-5] + "_right"
    return name[:-6] + "_left" if name.endswith("_right") else name


def _idle(names: tuple[str, ...], axes: Tensor) -> Tensor:
    found = torch.zeros(len(names), 3)
    for i, (name, axis) in enumerate(zip(names, axes, strict=True)):
        if name.startswith("arm_") and abs(float(axis[0])) > 0.3:
            found[i, 2] = -_HANG if float(axis[0]) > 0 else _HANG
    return found


def _prices(names: tuple[str, ...], axes: Tensor) -> Tensor:
    """Twist about a bone's own axis is dear; legs swing forth and back, hinges hardly anything else."""
    rows = []
    for name, axis in zip(names, axes, strict=True):
        stem = name.split("_")[0].rstrip("0123456789")
        price = _STIFF.get(stem, _ANY) * torch.eye(3) + _TWIST * torch.outer(axis, axis)
        upright = abs(float(axis[1])) > 0.7  # a leg, not an arm that is held out
        if upright and (stem in _HINGED or stem in ("arm", "thigh")):
            price = price + _LATERAL * (3 if stem in _HINGED else 1) * torch.diag(torch.tensor([0.0, 1.0, 1.0]))
        rows.append(price)
    return torch.stack(rows)
