"""Gaussian bones and their skinning weights (BANMo, section 3.2, equations 6 to 8).

A bone b is an anisotropic Gaussian in canonical space: centre C_b, orientation V_b, standard deviations
exp(log_scale_b). The skinning score of a point is minus half its squared Mahalanobis distance, plus a learned
delta; weights are the softmax of the scores over the bones.

The quadratic form is evaluated as a product of the point's 10 monomials (1, x, y, z, x^2, y^2, z^2, xy, xz, yz)
with a 10 x B matrix a frame: one small matrix product in place of B differences a point.

Axes: frame F, point N, bone B. Units are those of canonical space (the object is about 2 long).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stages.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix


class Bones(nn.Module):
    """B Gaussian bones: ``centres`` (B, 3), ``quaternions`` (B, 4), ``log_scales`` (B, 3), ``parents`` (B,) int64.

    Bones hang in a tree, listed so that a parent comes before its children; the first is the root, its own parent.
    """

    parents: Tensor

    def __init__(self, centres: Tensor, log_scales: Tensor, parents: Tensor) -> None:
        super().__init__()
        self.register_buffer("parents", parents.clone().long())
        self.centres = nn.Parameter(centres.clone())
        identity = torch.tensor([1.0, 0, 0, 0]).expand(len(centres), 4)
        self.quaternions = nn.Parameter(identity.clone())
        self.log_scales = nn.Parameter(log_scales.clone())

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def orientations(self) -> Tensor:
        """(B, 3, 3): columns are the Gaussians' principal axes."""
        return quaternion_to_matrix(self.quaternions)


def bone_tree(distance: Tensor) -> tuple[Tensor, Tensor]:
    """Order (B,) and parents (B,) of a tree over bones at mutual `distance` (B, B): the minimum spanning tree.

    The root is the bone whose farthest bone along the tree is nearest. ``order[i]`` is the old index of new bone i;
    ``parents[i]`` is the new index of its parent, smaller than i.
    """
    count = len(distance)
    linked = [0]
    edges: list[list[int]] = [[] for _ in range(count)]
    best, source = distance[0].clone(), torch.zeros(count, dtype=torch.int64)
    best[0] = torch.inf
    while len(linked) < count:
        new = int(best.argmin())
        edges[new].append(int(source[new]))
        edges[int(source[new])].append(new)
        linked.append(new)
        closer = distance[new] < best
        source[closer] = new
        best = torch.minimum(best, distance[new])
        best[linked] = torch.inf

    def walk(root: int) -> tuple[list[int], dict[int, int], float]:
        order, parent, far = [root], {root: root}, {root: 0.0}
        for node in order:
            for other in edges[node]:
                if other not in parent:
                    parent[other], far[other] = node, far[node] + float(distance[node, other])
                    order.append(other)
        return order, parent, max(far.values())

    root = min(range(count), key=lambda b: walk(b)[2])
    order, parent, _ = walk(root)
    place = {old: new for new, old in enumerate(order)}
    return torch.tensor(order), torch.tensor([place[parent[old]] for old in order])


def monomials(points: Tensor) -> Tensor:
    """(..., N, 10): 1, x, y, z, x^2, y^2, z^2, xy, xz, yz of points (..., N, 3)."""
    x, y, z = points.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], -1)


def score_coefficients(centres: Tensor, orientations: Tensor, log_scales: Tensor) -> Tensor:
    """Coefficients (..., 10, B) with ``monomials(x) @ coefficients == -0.5 (x - C)^T V S^-2 V^T (x - C)``.

    `centres` (..., B, 3), `orientations` (..., B, 3, 3), `log_scales` (B, 3) or (..., B, 3).
    """
    scaled = orientations * torch.exp(-log_scales)[..., None, :]
    precision = scaled @ scaled.transpose(-1, -2)
    linear = (precision @ centres[..., None]).squeeze(-1)
    constant = -0.5 * (linear * centres).sum(-1)
    p = precision
    rows = [
        constant, linear[..., 0], linear[..., 1], linear[..., 2],
        -0.5 * p[..., 0, 0], -0.5 * p[..., 1, 1], -0.5 * p[..., 2, 2],
        -p[..., 0, 1], -p[..., 0, 2], -p[..., 1, 2],
    ]  # fmt: skip
    return torch.stack(rows, -2)


def skinning_weights(points: Tensor, coefficients: Tensor, delta: Tensor | None = None) -> Tensor:
    """Softmax skinning weights (F, N, B) of points (F, N, 3) under `coefficients` (F, 10, B) (equation 8)."""
    scores = monomials(points) @ coefficients
    if delta is not None:
        scores = scores + delta
    return scores.softmax(-1)


def blend(points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Linear blend skinning: ``sum_b w_b J_b x`` of points (F, N, 3), weights (F, N, B), transforms (F, B, 4, 4)."""
    flat = transforms[..., :3, :].reshape(*transforms.shape[:-2], 12)
    matrices = (weights @ flat).reshape(*points.shape[:-1], 3, 4)
    return (matrices[..., :3] * points[..., None, :]).sum(-1) + matrices[..., 3]


def dual_quaternions(transforms: Tensor) -> Tensor:
    """Unit dual quaternions (..., B, 8) of rigid transforms (..., B, 4, 4): real part, then dual part.

    Signs are those of the first bone's hemisphere, so that a blend takes the short way round (Kavan et al. 2008).
    """
    real = matrix_to_quaternion(transforms[..., :3, :3])
    side = (real * real[..., :1, :]).sum(-1, keepdim=True)
    real = torch.where(side < 0, -real, real)
    shift = transforms[..., :3, 3]
    w, v = real[..., :1], real[..., 1:]
    # 0.5 (0, t) (w, v)
    dual = 0.5 * torch.cat([-(shift * v).sum(-1, keepdim=True), w * shift + torch.linalg.cross(shift, v)], -1)
    return torch.cat([real, dual], -1)


def blend_rigidly(points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Dual quaternion skinning of points (F, N, 3): rigid everywhere, so joints do not collapse where they twist."""
    mixed = weights @ dual_quaternions(transforms)
    mixed = mixed / mixed[..., :4].norm(dim=-1, keepdim=True).clamp_min(1e-8)
    w, v = mixed[..., :1], mixed[..., 1:4]
    dual_w, dual_v = mixed[..., 4:5], mixed[..., 5:]
    turned = points + 2 * torch.linalg.cross(v, torch.linalg.cross(v, points) + w * points)
    return turned + 2 * (w * dual_v - dual_w * v + torch.linalg.cross(v, dual_v))


class DeltaSkinning(nn.Module):
    """Learned correction of the skinning scores, ``MLP_delta(X, omega_b)`` (equation 8); zero at the start."""

    def __init__(self, bones: int, code_channels: int, width: int = 64) -> None:
        super().__init__()
        self.point_layer = nn.Linear(10, width)
        self.code_layer = nn.Linear(code_channels, width, bias=False)
        self.hidden = nn.Linear(width, width)
        self.out = nn.Linear(width, bones)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        """(F, N, B) score corrections at points (F, N, 3) with pose codes (F, C)."""
        hidden = torch.relu(self.point_layer(monomials(points)) + self.code_layer(code)[:, None])
        return self.out(torch.relu(self.hidden(hidden)))
