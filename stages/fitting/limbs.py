"""Limbs tried in poses that they have elsewhere, each by itself: legs that were confused where they crossed.

A gallop is not a walk sped up: no frame has all of its legs right, but each leg has been seen where it now is. So each
limb (a branch of the tree of bones) is hung onto the body as it stands in poses of other frames and compared with the
mask together with the rest of the body; the best path through them is found for one limb after the other, twice.
Not in the paper.

Axes: T all kept frames, B bones, L bones of one limb, N surface points, n those of one limb, K known poses of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.fitting.known_poses import BARE, best_sequence, looked_up, mask_distance, runs, spread
from stages.fitting.observations import Observations
from stages.geometry.cameras import project, transform
from stages.model.banmo import Banmo
from stages.model.motion import chain, local_motion

_POINTS, _KNOWN, _FROM = 240, 36, 400  # of the surface; poses a limb is tried in; frames these are chosen from
_LARGEST, _SMALL = 0.3, 3  # share of the bones that a limb has at most; bones that are never too many
_FEWEST = 4  # points of a limb worth moving
_JUMP = 0.5  # price in object sizes of misfit of a mean jump of one unit between successive frames
_MARGIN = 0.02  # of the body's misfit: what a move has to gain in a frame
_ROUNDS = 2


class Body(NamedTuple):
    """What is needed to hang limbs onto a body, in kept frames."""

    local: Tensor  # (T, B, 4, 4): each bone's motion in its parent's frame
    parents: Tensor  # (B,)
    bone: Tensor  # (N,): the bone that each point goes with
    points: Tensor  # (N, 3) canonical
    camera: Tensor  # (T, 4, 4): camera space from the space that bones move in
    intrinsics: Tensor  # (T, 3, 3)


class Limb(NamedTuple):
    """A branch of the tree of bones, and poses it was seen in."""

    bones: Tensor  # (L,), its stem first
    parents: Tensor  # (L,) in the limb; the stem is its own
    hangs_on: int  # bone outside the limb
    mine: Tensor  # (N,): whether a surface point goes with it
    at: Tensor  # (n,): place in `bones` of the bone that each of its points goes with
    points: Tensor  # (n, 3) canonical
    known: Tensor  # (K, n, 3): known poses, in the frame of the bone it hangs on
    motions: Tensor  # (K, L, 4, 4): motions of its bones in them

    def shapes(self, local: Tensor) -> Tensor:
        """Its points (F, n, 3) in the frame of the bone it hangs on, from motions of all bones (F, B, 4, 4)."""
        moved = chain(local[:, self.bones], self.parents)[:, self.at]
        return (moved[..., :3, :3] @ self.points[..., None]).squeeze(-1) + moved[..., :3, 3]


class _Scene(NamedTuple):
    """A stretch of frames (S,) with what was seen in them."""

    body: Body
    local: Tensor  # (S, B, 4, 4), changed as limbs are hung anew
    frames: Tensor  # (S,) kept frames
    masks: list[tuple[np.ndarray, np.ndarray]]
    scale: Tensor  # (S,) of silhouettes, from pixels

    def pixels(self, points: Tensor, s: int) -> Tensor:
        """Points (..., 3) on the silhouette of the stretch's frame `s`: (..., 2)."""
        frame = self.frames[s]
        return project(self.body.intrinsics[frame], transform(self.body.camera[frame], points)) * self.scale[s]


def limbs(parents: Tensor) -> list[Tensor]:
    """What hangs on the forks of a tree of bones (B,), large branches first: the bones (L,) of each, its stem first."""
    count = len(parents)
    branch = [[bone] for bone in range(count)]
    for bone in range(count - 1, 0, -1):
        branch[int(parents[bone])] += branch[bone]
    largest = max(_SMALL, _LARGEST * count)
    forks = [parent for parent in range(count) if int((parents[1:] == parent).sum()) > 1]
    stems = [bone for bone in range(1, count) if int(parents[bone]) in forks and len(branch[bone]) <= largest]
    return [torch.tensor(sorted(branch[stem])) for stem in sorted(stems, key=lambda stem: -len(branch[stem]))]


@torch.no_grad()
def other_limbs(model: Banmo, observations: Observations, tried: Tensor) -> tuple[Tensor, Tensor]:
    """Motions of the bones in their parents' frames (T, B, 4, 4) in which limbs lie better on masks, and by how much.

    Only frames that are `tried` (T,) are looked at. The second (T,) is the share of a frame's misfit that is gone;
    zero where nothing was found to be better, and where no bones move the body.
    """
    body = _body(model)
    seen = (observations.frame_weight > 0).cpu()
    found, gain = body.local.clone(), torch.zeros(len(seen))
    if model.dense is not None or len(model.surface) == 0 or not seen.any():
        return found, gain
    candidates = torch.nonzero(seen)[:, 0]
    candidates = candidates[spread(len(candidates), _FROM)]
    library = [limb for bones in limbs(body.parents) if (limb := _limb(body, bones, candidates)) is not None]
    for stretch in runs(torch.nonzero(tried.cpu() & seen)[:, 0], model):
        masks = [mask_distance(observations.silhouettes[t].numpy()) for t in stretch.tolist()]
        scene = _Scene(body, found[stretch], stretch, masks, observations.silhouette_scale[stretch])
        found[stretch], gain[stretch] = _hung_anew(scene, library)
    return found, gain


def _hung_anew(scene: _Scene, library: list[Limb]) -> tuple[Tensor, Tensor]:
    """Limbs of a stretch in other poses: motions (S, B, 4, 4), and the share of misfit (S,) that is gone."""
    before: Tensor | None = None
    after = torch.zeros(len(scene.local))
    for _ in range(_ROUNDS):
        for limb in library:
            own = limb.shapes(scene.local)
            cost = _misfits(scene, limb, own)
            before = cost[:, 0].clone() if before is None else before
            path = _path(cost, own, limb)
            moved = torch.nonzero(path > 0)[:, 0]
            scene.local[moved[:, None], limb.bones] = limb.motions[path[moved] - 1]
            after = cost[torch.arange(len(cost)), path]
    if before is None:
        return scene.local, after
    return scene.local, ((before - after) / before.clamp_min(1e-6)).clamp_min(0.0)


@torch.no_grad()
def hung(model: Banmo, local: Tensor, points: Tensor, frames: Tensor) -> Tensor:
    """Canonical points (N, 3) in object space in `frames` (F,), moved by bones' own motions (T, B, 4, 4): (F, N, 3)."""
    parts = []
    for some in frames.split(64):
        state = model.frames(some)
        moved = model.gauge[some][:, None] @ chain(local[some].to(points), model.bones.parents)
        parts.append(model.forward_points(state._replace(transforms=moved), points[None].expand(len(some), -1, -1)))
    return torch.cat(parts)


def _body(model: Banmo) -> Body:
    states = [model.frames(some) for some in torch.arange(len(model.time)).split(64)]
    own = torch.cat([state.own for state in states])
    camera = torch.cat([state.camera_from_object for state in states]) @ model.gauge
    points = model.surface[spread(len(model.surface), _POINTS)]
    parents = model.bones.parents
    return Body(
        local=local_motion(own[..., :3], own[..., 3:], model.bones.centres, parents).cpu(),
        parents=parents.cpu(),
        bone=model.rest_weights(points).argmax(-1).cpu(),
        points=points.cpu(),
        camera=camera.cpu(),
        intrinsics=torch.cat([state.intrinsics for state in states]).cpu(),
    )


def _limb(body: Body, bones: Tensor, candidates: Tensor) -> Limb | None:
    """A limb in the poses that differ most among those of `candidates` (K,); None where hardly anything hangs on it."""
    mine = torch.isin(body.bone, bones)
    if int(mine.sum()) < _FEWEST or bool(mine.all()):
        return None
    place = {int(bone): i for i, bone in enumerate(bones)}
    parents = torch.tensor([place.get(int(body.parents[bone]), 0) for bone in bones])
    at = torch.tensor([place[int(bone)] for bone in body.bone[mine]])
    limb = Limb(bones, parents, int(body.parents[bones[0]]), mine, at, body.points[mine], mine.new_zeros(0), mine)
    shapes = limb.shapes(body.local[candidates])
    chosen = _far_apart(shapes.flatten(1), _KNOWN)
    return limb._replace(known=shapes[chosen], motions=body.local[candidates[chosen]][:, bones])


def _far_apart(values: Tensor, most: int) -> Tensor:
    """Up to `most` indices (K,) of rows of (N, D) far from each other, each the farthest from those before it."""
    chosen = [int((values - values.mean(0)).norm(dim=1).argmin())]
    nearest = (values - values[chosen[0]]).norm(dim=1)
    while len(chosen) < min(most, len(values)):
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (values - values[chosen[-1]]).norm(dim=1))
    return torch.tensor(chosen)


def _misfits(scene: _Scene, limb: Limb, own: Tensor) -> Tensor:
    """(S, 1 + K): the whole body's misfit with a limb as it is (S, n, 3), and in each known pose, in object sizes."""
    body = scene.body
    placed = chain(scene.local, body.parents)
    bones = placed[:, body.bone[~limb.mine]]
    rest = (bones[..., :3, :3] @ body.points[~limb.mine][..., None]).squeeze(-1) + bones[..., :3, 3]
    hangs_on = placed[:, limb.hangs_on]
    cost = torch.zeros(len(own), 1 + len(limb.known))
    for s, (outside, wanted) in enumerate(scene.masks):
        if len(wanted) == 0:  # too small to be seen at the size of the silhouettes
            continue
        shapes = torch.cat([own[s : s + 1], limb.known])
        fixed = scene.pixels(rest[s], s)
        pixels = scene.pixels(transform(hangs_on[s], shapes.reshape(-1, 3)), s).reshape(*shapes.shape[:2], 2)
        beyond = looked_up(outside, fixed).sum() + looked_up(outside, pixels).sum(1)
        aim = torch.from_numpy(wanted)
        bare = torch.cdist(aim[None].expand(len(pixels), -1, -1), pixels).amin(-1)
        bare = torch.minimum(bare, torch.cdist(aim, fixed).amin(-1))
        size = max(8.0, float(np.sqrt((outside == 0).sum())))
        cost[s] = (beyond / len(body.points) + BARE * (bare - 1.0).clamp_min(0).mean(1)) / size
    return cost


def _path(cost: Tensor, own: Tensor, limb: Limb) -> Tensor:
    """Of frames (S,) which known pose to take (1 + index), or 0 for the limb as it is (Viterbi)."""
    price = _JUMP * len(limb.at) / len(limb.mine)
    among = price * (limb.known[:, None] - limb.known[None]).norm(dim=-1).mean(-1)
    to_known = price * (own[:, None] - limb.known[None]).norm(dim=-1).mean(-1)  # (S, K)
    jumps = among.new_zeros(max(0, len(own) - 1), 1 + len(among), 1 + len(among))
    jumps[:, 1:, 1:] = among
    jumps[:, 0, 0] = price * (own[1:] - own[:-1]).norm(dim=-1).mean(-1)
    jumps[:, 0, 1:], jumps[:, 1:, 0] = to_known[1:], to_known[:-1]
    charged = cost.clone()
    charged[:, 1:] += _MARGIN * cost[:, :1]
    return best_sequence(charged, jumps)
