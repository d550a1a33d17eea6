"""From root poses and masks to a model that can be optimised: normalisation, hull, bones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from stages.fitting import hull
from stages.fitting.observations import Observations
from stages.geometry.cameras import transform
from stages.model.banmo import Architecture, Banmo, VideoFacts
from stages.model.fields import GridField
from stages.model.motion import octaves_for, splines_for
from stages.model.skeleton import Bones, bone_tree


@dataclass(frozen=True)
class Normalised:
    """Root poses in canonical units: ``x_object = scale x_canonical + centre`` (so the object is about 2 long)."""

    camera_from_canonical: Tensor  # (T, 4, 4)
    centre: Tensor  # (3,)
    scale: float


def normalise(observations: Observations, camera_from_object: Tensor, intrinsics: Tensor) -> Normalised:
    """Centre and scale the object of the given poses: half extent 1, centred on the origin.

    Poses that already obey the convention (extent within a third of it) are left as they are.
    """
    centre, extent = hull.object_box(observations, camera_from_object, intrinsics)
    if 0.7 < extent < 1.4 and float(centre.norm()) < 0.5:
        centre, extent = torch.zeros(3), 1.0
    poses = camera_from_object.clone()
    poses[:, :3, 3] = transform(camera_from_object, centre[None])[:, 0] / extent
    return Normalised(poses, centre, extent)


def lattice(voxel: float, half: float = 1.4) -> Tensor:
    """Voxel centres (N, N, N, 3) of the cube [-half, half]^3."""
    axis = torch.arange(-half, half + 1e-6, voxel)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def usable_frames(observations: Observations, most: int) -> Tensor:
    """Up to `most` frames with a mask, evenly spread."""
    usable = torch.nonzero(observations.frame_weight > 0)[:, 0]
    return usable[torch.linspace(0, len(usable) - 1, min(most, len(usable))).round().long()]


class Hull(NamedTuple):
    """A soft visual hull on a lattice."""

    nodes: Tensor  # (N, N, N, 3)
    share: Tensor  # (N, N, N): votes
    solid: Tensor  # (N, N, N) bool
    level: float


def rigid_hull(observations: Observations, poses: Tensor, intrinsics: Tensor, voxel: float) -> Hull:
    """The soft visual hull of an object that only its root moves, its vote level chosen by silhouette agreement."""
    nodes = lattice(voxel)
    flat = nodes.reshape(-1, 3)
    share = hull.votes(
        hull.rigid_placement(flat, poses), len(flat), observations, intrinsics, usable_frames(observations, 250)
    )
    near = share >= min(hull.LEVELS)
    place = hull.rigid_placement(flat[near], poses)
    level = hull.choose_level(share[near], place, voxel, observations, intrinsics, usable_frames(observations, 40))
    cube = share.reshape(nodes.shape[:3])
    solid = torch.from_numpy(hull.largest_component((cube >= level).numpy()))
    return Hull(nodes, cube, solid, level)


def swept(hull_: Hull, share: float) -> Tensor | None:
    """Voxel centres (M, 3) seen inside the mask in at least `share` of the frames: the shape and what limbs sweep."""
    if share >= hull_.level or share <= 0:
        return None
    wide = torch.from_numpy(hull.largest_component((hull_.share >= share).numpy()))
    return hull_.nodes[wide]


def place_bones(points: Tensor, count: int, seed: int, along: bool = False) -> Bones:
    """Bones among surface points (N, 3): farthest points first, then a few rounds of k-means.

    They hang in a tree by their distance through the body; `along`: by the way along the points, which suits a shape
    whose limbs have grown. A first hull has none yet, and limbs grow from a tree of straight links.

    Farthest points reach the ends of thin limbs, which k-means alone, ruled by mass, leaves without a bone. Each
    bone is as wide as 0.45 of the way to its neighbours.
    """
    points = points.cpu()
    data = points.numpy().astype(np.float64)
    count = min(count, len(data))
    rng = np.random.default_rng(seed)
    sample = data[rng.permutation(len(data))[:8000]]
    chosen = [int(((sample - sample.mean(0)) ** 2).sum(1).argmin())]
    distance = ((sample - sample[chosen[0]]) ** 2).sum(1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((sample - sample[chosen[-1]]) ** 2).sum(1))
    centres, _ = kmeans2(sample, sample[chosen], iter=4, minit="matrix")
    centres_t = torch.from_numpy(centres.astype(np.float32))
    if count > 1:
        gaps = torch.cdist(centres_t, centres_t) + torch.eye(count) * 1e9
        width = gaps.topk(min(3, count - 1), largest=False).values.mean(1)
    else:
        width = torch.full((1,), float(points.std()))
    order, parents = bone_tree((_way_along if along else _straight_through)(centres_t, points))
    return Bones(centres_t[order], torch.log(0.45 * width)[order, None].expand(count, 3).clone(), parents)


def _graph(points: np.ndarray) -> csr_matrix:
    """Distances between neighbouring points (N, 3) of a surface or solid: the eighth nearest, and a little more."""
    tree = cKDTree(points)
    reach = 1.4 * float(np.median(tree.query(points, k=min(9, len(points)))[0][:, -1]))
    pairs = tree.query_pairs(reach + 1e-9, output_type="ndarray")
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    return csr_matrix((length, (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))


def body_of(points: Tensor) -> Tensor:
    """The largest part of `points` (N, 3) that hangs together; specks that float beside it are left out."""
    _, part = connected_components(_graph(points.cpu().numpy().astype(np.float64)), directed=False)
    return points[torch.from_numpy(part == np.bincount(part).argmax())]


def _straight_through(centres: Tensor, points: Tensor) -> Tensor:
    """Distance (B, B) between bones that counts leaving the body thrice: halfway points far from `points` cost."""
    straight = torch.cdist(centres, centres)
    share = torch.linspace(0.25, 0.75, 3)[:, None, None, None]
    between = centres[None, :, None] * (1 - share) + centres[None, None] * share
    some = points[:: max(1, len(points) // 1500)]
    gap = torch.cdist(between.reshape(-1, 3), some).amin(1).reshape(between.shape[:-1]).amax(0)
    return straight + 3 * (gap - 0.5 * gap.diagonal()[:, None]).clamp_min(0)


def _way_along(centres: Tensor, points: Tensor) -> Tensor:
    """Distance (B, B) between bones along the body: two paws that stand side by side are a long way apart.

    It is the way through neighbouring `points` (N, 3), no shorter than the straight line; where there is none, thrice
    the straight line.
    """
    straight = torch.cdist(centres, centres)
    some = points[:: max(1, -(-len(points) // 3000))].numpy().astype(np.float64)
    nearest = cKDTree(some).query(centres.numpy().astype(np.float64))[1]
    along = dijkstra(_graph(some), directed=False, indices=nearest)[:, nearest]
    along = np.where(np.isfinite(along), along, 3 * straight.numpy() + 1)
    return torch.maximum(torch.from_numpy(along).float(), straight)


def set_shape(field: GridField, points: Tensor, voxel: float) -> None:
    """Start the field's signed distance from solid voxel centres (N, 3) of spacing `voxel`."""
    nodes = field.node_positions()
    solid = np.zeros(field.shape, bool)
    # A node is solid where the voxel that holds it is: look each node up in the voxels' own lattice.
    origin = points[0]
    keys = torch.round((points - origin) / voxel).long()
    wanted = torch.round((nodes.reshape(-1, 3) - origin) / voxel).long()
    lowest = torch.minimum(keys.amin(0), wanted.amin(0))
    size = torch.maximum(keys.amax(0), wanted.amax(0)) - lowest + 1

    def code(k: Tensor) -> np.ndarray:
        k = k - lowest
        return ((k[:, 0] * size[1] + k[:, 1]) * size[2] + k[:, 2]).numpy()

    solid = np.isin(code(wanted), code(keys)).reshape(field.shape)
    x, y, z = (float(s) for s in field.spacing)
    field.set_sdf(torch.from_numpy(hull.signed_distance(solid, (z, y, x))))


def build(
    architecture: Architecture,
    videos: list[VideoFacts],
    poses: Tensor,
    solid: Tensor,
    solid_voxel: float,
    bones: int,
    seed: int,
    margin: float = 0.2,
    bone_points: Tensor | None = None,
) -> Banmo:
    """A model whose shape is the solid voxels (N, 3), with `bones` bones in it and `margin` around it.

    Bones lie among `bone_points` (M, 3) instead, if given: the shape with the room that its limbs sweep.
    """
    bounds = torch.stack([solid.amin(0) - margin, solid.amax(0) + margin])
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):  # layers draw their first weights from torch's own generator
        torch.manual_seed(seed)
        placed = place_bones(solid if bone_points is None else bone_points, bones, seed)
        model = Banmo(architecture, videos, poses, bounds, placed, generator)
    if isinstance(model.field, GridField):
        set_shape(model.field, solid, solid_voxel)
    return model


def octaves(videos: list[VideoFacts], shortest_period_s: float) -> int:
    """Octaves of the pose codes for the longest of `videos`."""
    return octaves_for(max(v.time_s[-1] - v.time_s[0] for v in videos), shortest_period_s)


def splines(videos: list[VideoFacts], spacing_s: float) -> int:
    """Local functions of the pose codes for the longest of `videos`, about `spacing_s` apart; none if that is zero."""
    return splines_for(max(v.time_s[-1] - v.time_s[0] for v in videos), spacing_s)
