"""Fitting a category's puppet: to the subject of a clip (2D) and to the surface of a model (3D).

Both go back and forth between two steps. *Match*: every seen point looks for its vertex, by its embedding and, more
and more, by where the puppet is by now; that is what tells a left leg from a right one when the embedding does not.
*Move*: proportions (one set for all frames), root poses and the turn of every bone in every frame are moved by descent
so that the matched vertices lie on their points; motion is smooth, and turning is priced by what animals do.

Axes: N frames, P points a frame, V vertices, B bones. Pixels are divided by the subject's size in the picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.geometry.cameras import project
from stages.geometry.rotations import so3_exp
from stages.retargeting.puppet import Puppet, skinned, vertex_turns

_LEAST_SPREAD = 0.06  # a point that misses by more than this counts little in the end, in object sizes
_NORMAL = 0.03  # a normal that points the other way is as bad as being so far off, in object sizes


@dataclass(frozen=True)
class Seen:
    """Points of a clip with their embeddings."""

    pixels: Tensor  # (N, P, 2) pixels
    features: Tensor  # (N, P, 16) unit length
    weight: Tensor  # (N, P) in 0..1; zero where there is none
    intrinsics: Tensor  # (3, 3) pixels
    size_px: Tensor  # (N,) the subject's size in each frame
    time_s: Tensor  # (N,)
    outside: Tensor  # (N, h, w) distance in pixels of the picture from the mask, zero on it
    boxes: Tensor  # (N, 4) what of the picture `outside` covers: x0, y0, x1, y1 in pixels


@dataclass(frozen=True)
class Posture:
    """A fitted puppet: `shape` (B, 3, 3), `orientations` (N, B, 3, 3), `shift` (N, 3), `misfit` (N,) object sizes."""

    shape: Tensor
    orientations: Tensor
    shift: Tensor
    misfit: Tensor

    def transforms(self, puppet: Puppet) -> Tensor:
        """(N, B, 3, 4) from the puppet's rest surface to its posed one."""
        return puppet.transforms(self.shape, self.orientations, self.shift)


@dataclass(frozen=True)
class Effort:
    """How long and how stiffly a puppet is fitted."""

    rounds: int = 12
    """Matchings."""
    steps: int = 20
    """Steps of descent a round."""
    learning_rate: float = 0.02
    """Largest change of an angle a step, radians."""
    near: tuple[float, float] = (0.15, 0.06)
    """How far a match may lie from where the puppet is, first and last round, in object sizes."""
    rest: float = 0.01
    """Price of turning bones."""
    smooth: float = 0.3
    """Price of angular acceleration, scaled to the time a limb takes to swing."""
    shape: float = 0.2
    """Price of limbs of other than average length."""
    inside: float = 3.0
    """Price of vertices that lie off the mask."""
    hold_root: bool = False
    """Leave the root's rotation as it is at the start."""


def match(
    puppet: Puppet, places: Tensor, facing: Tensor, points: Tensor, features: Tensor, near: Tensor | float
) -> Tensor:
    """Vertex (N, P) of each point: alike in embedding, near in place, not on the far side.

    Args:
        places: (N, V, D) where vertices are now; `points` (N, P, D) in the same units.
        facing: (N, V) in 0..1, how much a vertex may be matched.
        near: distance that costs as much as a fairly unlike embedding.
    """
    found = []
    for here, front, point, feature in zip(places, facing, points, features, strict=True):
        unlike = 1 - feature @ puppet.embedding.T
        apart = torch.cdist(point, here) / near
        found.append((unlike / 0.15 + 0.5 * apart.square().clamp_max(16.0) + 1.5 * (1 - front)).argmin(1))
    return torch.stack(found)


def start_rotations(puppet: Puppet, seen: Seen) -> Tensor:
    """(N, 3, 3) root rotations from matches alone: least squares under weak perspective, robustly."""
    found = []
    for pixels, features, weight, size in zip(seen.pixels, seen.features, seen.weight, seen.size_px, strict=True):
        vertex = (features @ puppet.embedding.T).argmax(1)
        x = torch.cat([puppet.vertices[vertex], torch.ones(len(vertex), 1)], 1)
        y = pixels / size
        w = weight.clone()
        for _ in range(4):
            gram = x.T @ (x * w[:, None]) + 1e-4 * torch.eye(4)
            affine = torch.linalg.solve(gram, x.T @ (y * w[:, None])).T
            error = (x @ affine.T - y).norm(dim=1)
            w = weight / (1 + (error / 0.06).square())
        u, _, vt = torch.linalg.svd(affine[:, :3], full_matrices=False)
        rows = u @ vt
        found.append(torch.stack([rows[0], rows[1], torch.linalg.cross(rows[0], rows[1])]))
    return torch.stack(found)


def weak_misfit(puppet: Puppet, seen: Seen, rotations: Tensor) -> float:
    """Median distance in object sizes of matched vertices at rest from their pixels, each frame scaled and shifted."""
    errors = []
    for pixels, features, weight, size, rotation in zip(
        seen.pixels, seen.features, seen.weight, seen.size_px, rotations, strict=True
    ):
        if not bool((weight > 0).any()):
            continue
        vertex = (features @ puppet.embedding.T).argmax(1)
        x = (puppet.vertices[vertex] @ rotation.T)[:, :2]
        y = pixels / size
        x, y = x - x.median(0).values, y - y.median(0).values
        errors.append((x * ((x * y).sum() / x.square().sum()) - y).norm(dim=1)[weight > 0].median())
    return float(torch.stack(errors).median()) if errors else float("inf")


def fit_clip(
    puppet: Puppet, seen: Seen, root: Tensor, effort: Effort, tick: Callable[[int, int], None] | None = None
) -> Posture:
    """The puppet on the subject of a clip, from root rotations `root` (N, 3, 3), camera from object.

    `tick` hears of each step taken and of all there will be; it may raise to end the work.
    """
    count, bones = len(seen.pixels), len(puppet.names)
    focal = float((seen.intrinsics[0, 0] + seen.intrinsics[1, 1]) / 2)
    lengths, girths = torch.zeros(bones), torch.zeros(bones)
    turns, root_turn = puppet.idle.repeat(count, 1, 1), torch.zeros(count, 3)
    shift = _start_shift(puppet, seen, root, focal)
    parameters = [p.requires_grad_() for p in (lengths, girths, turns, root_turn, shift)]
    rates = [0.5, 0.5, 1.0, 0.0 if effort.hold_root else 0.5, 0.5]
    descent = torch.optim.Adam(
        [{"params": [p], "lr": effort.learning_rate * r, "rate": r} for p, r in zip(parameters, rates, strict=True)],
        betas=(0.9, 0.98),
    )
    step_s = float((seen.time_s[1:] - seen.time_s[:-1]).median()) if count > 1 else 1.0
    inertia = effort.smooth * (0.05 / max(step_s, 1e-3)) ** 4
    centre = seen.pixels.mean(1, keepdim=True)
    size = seen.size_px[:, None, None]
    some = torch.arange(0, len(puppet.vertices), max(1, len(puppet.vertices) // 250))
    misfit = torch.zeros(count)
    for turn in range(effort.rounds):
        share = turn / max(1, effort.rounds - 1)
        near = effort.near[0] * (effort.near[1] / effort.near[0]) ** share
        with torch.no_grad():
            shape = puppet.shape(lengths, girths)
            orientations = puppet.turned(so3_exp(root_turn) @ root, turns)
            moved = skinned(puppet.vertices, puppet.weights, puppet.transforms(shape, orientations, shift))
            looking = (vertex_turns(puppet.weights, orientations) @ puppet.normals[..., None]).squeeze(-1)
            facing = torch.sigmoid(-8 * (looking * torch.nn.functional.normalize(moved, dim=-1)).sum(-1))
            places = (project(seen.intrinsics, moved) - centre) / size
            vertex = match(puppet, places, facing, (seen.pixels - centre) / size, seen.features, near)
        points, weights = puppet.vertices[vertex], puppet.weights[vertex]
        sigma = max(_LEAST_SPREAD, 0.5 * near)
        for k in range(effort.steps):
            if tick is not None:
                tick(turn * effort.steps + k, effort.rounds * effort.steps)
            last = turn == effort.rounds - 1
            for group in descent.param_groups:
                group["lr"] = effort.learning_rate * group["rate"] * (1 - 0.9 * k / effort.steps if last else 1.0)
            shape = puppet.shape(lengths, girths)
            orientations = puppet.turned(so3_exp(root_turn) @ root, turns)
            transforms = puppet.transforms(shape, orientations, shift)
            error = (project(seen.intrinsics, skinned(points, weights, transforms)) - seen.pixels) / size
            square = error.square().sum(-1)
            robust = square / (square + sigma**2)
            loss = (robust * seen.weight).sum(1).mean() / seen.pixels.shape[1] * (sigma / 0.03) ** 2 * 0.5
            if effort.inside > 0:
                body = project(seen.intrinsics, skinned(puppet.vertices[some], puppet.weights[some], transforms))
                loss = loss + effort.inside * _off_mask(seen, body).mean()
            loss = loss + effort.rest * _price(puppet, turns)
            if count > 2:
                change = turns[2:] - 2 * turns[1:-1] + turns[:-2]
                sway = root_turn[2:] - 2 * root_turn[1:-1] + root_turn[:-2]
                drift = shift[2:] - 2 * shift[1:-1] + shift[:-2]
                rough = change.square().sum(-1).mean() * bones + 2 * sway.square().sum(-1).mean()
                loss = loss + inertia * (rough + 2 * drift.square().sum(-1).mean())
            loss = loss + effort.shape * (lengths.square().mean() + girths.square().mean())
            loss = loss + effort.shape * 4 * (lengths.mean().square() + girths.mean().square())
            descent.zero_grad(set_to_none=True)
            loss.backward()
            descent.step()
        misfit = (square.detach().sqrt() * seen.weight).sum(1) / seen.weight.sum(1).clamp_min(1e-6)
    with torch.no_grad():
        orientations = puppet.turned(so3_exp(root_turn) @ root, turns)
        return Posture(puppet.shape(lengths, girths), orientations, shift.detach(), misfit)


@dataclass(frozen=True)
class Surface:
    """Points of a model's surface at rest, object space. P points."""

    points: Tensor  # (P, 3)
    normals: Tensor  # (P, 3) outward, unit length
    features: Tensor  # (P, 16) the model's own canonical embedding, unit length


def fit_surface(puppet: Puppet, surface: Surface, effort: Effort) -> Posture:
    """The puppet on a model's surface at rest: one frame, in object space; ``misfit`` (1,) in object sizes."""
    bones = len(puppet.names)
    features = surface.features[None]
    target = surface.points[None]
    size = float((surface.points.amax(0) - surface.points.amin(0)).max())
    rotation, scale, shift = lay(puppet, surface)
    lengths, girths = torch.full((bones,), scale).log(), torch.full((bones,), scale).log()
    start = float(lengths[0])
    turns, root_turn = 0.5 * puppet.idle[None], torch.zeros(1, 3)
    parameters = [p.requires_grad_() for p in (lengths, girths, turns, root_turn, shift)]
    descent = torch.optim.Adam(parameters, lr=effort.learning_rate, betas=(0.9, 0.98))
    misfit = torch.zeros(1)
    for turn in range(effort.rounds):
        near = effort.near[0] * (effort.near[1] / effort.near[0]) ** (turn / max(1, effort.rounds - 1))
        with torch.no_grad():
            orientations = puppet.turned(so3_exp(root_turn) @ rotation, turns)
            transforms = puppet.transforms(puppet.shape(lengths, girths), orientations, shift)
            moved = skinned(puppet.vertices, puppet.weights, transforms)
            normals = (vertex_turns(puppet.weights, orientations) @ puppet.normals[..., None]).squeeze(-1)
            places = torch.cat([moved / size, _NORMAL * normals], -1)
            wanted = torch.cat([target / size, _NORMAL * surface.normals[None]], -1)
            vertex = match(puppet, places, torch.ones(1, len(puppet.vertices)), wanted, features, near)
        sigma = max(0.03, 0.5 * near)
        for k in range(effort.steps):
            if turn == effort.rounds - 1:
                descent.param_groups[0]["lr"] = effort.learning_rate * (1 - 0.9 * k / effort.steps)
            orientations = puppet.turned(so3_exp(root_turn) @ rotation, turns)
            transforms = puppet.transforms(puppet.shape(lengths, girths), orientations, shift)
            error = skinned(puppet.vertices[vertex], puppet.weights[vertex], transforms) - target
            square = error.square().sum(-1) / size**2
            loss = (square / (square + sigma**2)).mean() * (sigma / 0.03) ** 2 * 0.5
            loss = loss + effort.rest * _price(puppet, turns)
            loss = loss + effort.shape * ((lengths - start).square().mean() + (girths - start).square().mean()) * 0.2
            descent.zero_grad(set_to_none=True)
            loss.backward()
            descent.step()
        misfit = square.detach().sqrt().mean(1)
    with torch.no_grad():
        orientations = puppet.turned(so3_exp(root_turn) @ rotation, turns)
        return Posture(puppet.shape(lengths, girths), orientations, shift.detach(), misfit)


def lay(puppet: Puppet, surface: Surface) -> tuple[Tensor, float, Tensor]:
    """Rotation (1, 3, 3), scale and root joint (1, 3) that lay the puppet on the surface by its embedding alone."""
    vertex = (surface.features @ puppet.embedding.T).argmax(1)
    x, y = puppet.vertices[vertex], surface.points
    weight = torch.ones(len(x))
    rotation, scale, offset = torch.eye(3), 1.0, torch.zeros(3)
    for _ in range(8):
        w = weight / weight.sum()
        a, b = (w[:, None] * x).sum(0), (w[:, None] * y).sum(0)
        u, s, vt = torch.linalg.svd((y - b).T @ ((x - a) * w[:, None]))
        flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.sign(torch.det(u @ vt)))]))
        rotation = u @ flip @ vt
        scale = float((s * flip.diagonal()).sum() / (w * (x - a).square().sum(1)).sum())
        offset = b - scale * rotation @ a
        error = (scale * x @ rotation.T + offset - y).norm(dim=1)
        weight = 1 / (1 + (error / 0.15).square())
    return rotation[None], scale, (scale * rotation @ puppet.joints[0] + offset)[None]


def _price(puppet: Puppet, turns: Tensor) -> Tensor:
    more = turns - puppet.idle
    square = torch.einsum("nbi,bij,nbj->nb", more, puppet.price, more)[:, 1:]
    return square.sum(1).mean()


def _off_mask(seen: Seen, pixels: Tensor) -> Tensor:
    """Robust distance (N, K) of pixels (N, K, 2) from the mask, in object sizes."""
    low, high = seen.boxes[:, None, :2], seen.boxes[:, None, 2:]
    unit = (pixels - low) / (high - low) * 2 - 1
    away = torch.nn.functional.grid_sample(
        seen.outside[:, None], unit[:, :, None], align_corners=False, padding_mode="border"
    )[:, 0, :, 0]
    away = away / seen.size_px[:, None]
    return away.square() / (away.square() + 0.05**2) * 0.05


def _start_shift(puppet: Puppet, seen: Seen, root: Tensor, focal: float) -> Tensor:
    """(N, 3) where the root joint is at the start: as large and in the middle as the matched points are."""
    rows = []
    for pixels, features, weight, rotation in zip(seen.pixels, seen.features, seen.weight, root, strict=True):
        vertex = (features @ puppet.embedding.T).argmax(1)
        x = (puppet.vertices[vertex] - puppet.joints[0]) @ rotation.T
        flat, y = x[:, :2], pixels
        a, b = flat - flat.median(0).values, y - y.median(0).values
        keep = weight > 0
        scale = (b[keep].norm(dim=1).median() / a[keep].norm(dim=1).median().clamp_min(1e-3)).clamp_min(1e-2)
        depth = focal / scale
        middle = (y.median(0).values - seen.intrinsics[:2, 2]) / focal * depth - flat.median(0).values
        rows.append(torch.cat([middle, (depth - x[:, 2].median())[None]]))
    shift = torch.stack(rows)
    known = seen.weight.sum(1) > 0
    depth = shift[known, 2].median()
    shift[:, 2] = shift[:, 2].clamp(0.6 * depth, 1.7 * depth)
    return shift
