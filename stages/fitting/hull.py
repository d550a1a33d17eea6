"""A first shape from silhouettes alone: the soft visual hull of all frames (Laurentini 1994, with votes).

A voxel's vote is the share of frames that see it inside the mask, among those whose picture it falls into. Moving
limbs lose votes, so the level is chosen by how well the hull's own silhouettes agree with the masks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter, label
from torch import Tensor

from stages.fitting.observations import Observations
from stages.geometry.cameras import pixel_directions, project, transform

Placement = Callable[[int], Tensor]
"""Camera-space positions (N, 3) of the same N canonical points in kept frame f: rigid, or posed by bones."""


def rigid_placement(points: Tensor, camera_from_object: Tensor) -> Placement:
    """Points (N, 3) that only the root poses (T, 4, 4) move."""
    return lambda f: transform(camera_from_object[f], points)


def object_box(observations: Observations, camera_from_object: Tensor, intrinsics: Tensor) -> tuple[Tensor, float]:
    """Centre (3,) and half extent of the object from mask centroids and sizes, in the units of the poses.

    The centre is the point closest to all centroid rays (least squares); the half extent is the 90th percentile of
    the masks' half size (radius about the centroid) at that point's depth. Poses (T, 4, 4), intrinsics (T, 3, 3).
    """
    normal, right = torch.zeros(3, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    radii = []
    for f in torch.nonzero(observations.frame_weight > 0)[:, 0]:
        rows, columns = torch.nonzero(observations.silhouettes[f] > 127, as_tuple=True)
        if len(rows) < 8:
            continue
        xy = torch.stack([columns, rows], 1).double() + 0.5
        xy = xy / observations.silhouette_scale[f].double()
        middle = xy.mean(0)
        radius = torch.quantile((xy - middle).norm(dim=1), 0.97)
        pose, k = camera_from_object[f].double(), intrinsics[f].double()
        direction = pose[:3, :3].T @ pixel_directions(k, middle[None])[0]
        direction = direction / direction.norm()
        origin = -pose[:3, :3].T @ pose[:3, 3]
        projector = torch.eye(3, dtype=torch.float64) - torch.outer(direction, direction)
        normal += projector
        right += projector @ origin
        radii.append((f, radius, k[0, 0]))
    if not radii:
        raise ValueError("no frame has a usable mask")
    # A weak pull to the middle of the clips' look-at depth keeps a single static view well posed.
    weight = 1e-3 * len(radii)
    depth = torch.stack([camera_from_object[f, 2, 3].double() for f, _, _ in radii]).median()
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) * depth
    used = camera_from_object[[int(f) for f, _, _ in radii]].double()
    prior = ((ahead - used[:, :3, 3])[:, None] @ used[:, :3, :3])[:, 0].mean(0)
    centre = torch.linalg.solve(normal + weight * torch.eye(3, dtype=torch.float64), right + weight * prior)
    extent = []
    for f, radius, focal in radii:
        extent.append(radius / focal * float(transform(camera_from_object[f].double(), centre[None])[0, 2]))
    return centre.float(), float(torch.quantile(torch.tensor(extent, dtype=torch.float64), 0.9))


def votes(place: Placement, count: int, observations: Observations, intrinsics: Tensor, frames: Tensor) -> Tensor:
    """Share (count,) of `frames` whose mask covers each placed point, among those whose picture contains it."""
    inside, seen = torch.zeros(count), torch.zeros(count)
    size = observations.silhouettes.shape[1]
    for f in frames.tolist():
        pixels = project(intrinsics[f], place(f))
        in_picture = ((pixels >= 0) & (pixels < observations.image_size[f])).all(-1)
        cell = (pixels * observations.silhouette_scale[f]).long().clamp(0, size - 1)
        value = observations.silhouettes[f].float()[cell[:, 1], cell[:, 0]] / 255
        weight = in_picture.float() * observations.frame_weight[f]
        inside += value * weight
        seen += weight
    return torch.where(seen > 0.2 * len(frames), inside / seen.clamp_min(1e-6), torch.zeros_like(inside))


def silhouette_agreement(
    place: Placement, kept: Tensor, voxel: float, observations: Observations, intrinsics: Tensor, frames: Tensor
) -> np.ndarray:
    """Agreement of the masks with placed points, splatted as voxels on a raster that a voxel just fills.

    `kept` (L, N) bool selects points for each of L candidates. Returns mean intersection over union (L,).
    """
    scores = np.zeros(len(kept))
    for f in frames.tolist():
        camera = place(f)
        depth = float(camera[:, 2].median())
        cell_px = max(1.0, 1.2 * voxel * float(intrinsics[f, 0, 0]) / max(depth, 1e-3))
        width, height = (int(v / cell_px) + 1 for v in observations.image_size[f].tolist())
        cell = (project(intrinsics[f], camera) / cell_px).floor().long()
        ok = (cell >= 0).all(-1) & (cell[:, 0] < width) & (cell[:, 1] < height)
        rows, columns = torch.nonzero(observations.silhouettes[f] > 127, as_tuple=True)
        xy = (torch.stack([columns, rows], 1) + 0.5) / observations.silhouette_scale[f] / cell_px
        target = torch.zeros(height, width, dtype=torch.bool)
        target[xy[:, 1].long().clamp_max(height - 1), xy[:, 0].long().clamp_max(width - 1)] = True
        for i, chosen in enumerate(kept):
            use = ok & chosen
            drawn = torch.zeros(height, width, dtype=torch.bool)
            drawn[cell[use, 1], cell[use, 0]] = True
            scores[i] += (drawn & target).sum().item() / max(1, (drawn | target).sum().item())
    return scores / max(1, len(frames))


LEVELS = tuple(round(0.4 + 0.05 * i, 2) for i in range(11))
"""Vote levels tried: below, moving parts smear; above, one bad frame removes a part."""


def choose_level(
    share: Tensor, place: Placement, voxel: float, observations: Observations, intrinsics: Tensor, frames: Tensor
) -> float:
    """The vote level whose hull silhouettes agree best with the masks."""
    kept = torch.stack([share >= level for level in LEVELS])
    scores = silhouette_agreement(place, kept, voxel, observations, intrinsics, frames)
    return LEVELS[int(scores.argmax())]


def largest_component(solid: np.ndarray) -> np.ndarray:
    """The largest connected part of a boolean volume; corners connect, as thin limbs run diagonally."""
    labels, count = label(solid, structure=np.ones((3, 3, 3)))
    if count <= 1:
        return solid
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == sizes.argmax()


def signed_distance(solid: np.ndarray, spacing: tuple[float, float, float], blur: float = 0.7) -> np.ndarray:
    """Signed distance, negative inside, of a boolean volume with `spacing` along its axes; lightly smoothed."""
    outside = distance_transform_edt(~solid, sampling=spacing)
    inside = distance_transform_edt(solid, sampling=spacing)
    # Half a cell on either side: the surface runs between the last solid and the first empty node.
    half = 0.5 * float(np.mean(spacing))
    distance = np.where(solid, -(inside - half), outside - half)
    return gaussian_filter(distance, blur).astype(np.float32)
