"""Find the limbs that the rigid hull misses, and put them into the canonical shape.

What moves fast is inside few masks at any one place, so the average of all frames has no arms. But a single frame
shows them: mask area that the posed core does not explain. The frame that shows most of it, a moment with limbs
spread, supplies their outline; their depth is where, along each pixel's ray, the hull's votes are densest (smoothed
over the limb); their thickness is their width in the picture (limbs are about as deep as wide).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import binary_closing, binary_dilation, distance_transform_edt, gaussian_filter, label
from torch import Tensor

from stages.fitting import hull
from stages.fitting.growth import posed_placement, shell
from stages.fitting.initialise import Hull
from stages.fitting.observations import Observations
from stages.geometry.cameras import project, transform
from stages.model.banmo import Banmo


class Unexplained(NamedTuple):
    """Mask area that the posed shape does not cover, per kept frame."""

    area: np.ndarray  # (T,) share of the frame's mask area
    regions: list[np.ndarray]  # (h, w) bool each, at silhouette resolution


def _covered(pixels: np.ndarray, shape: tuple[int, int], radius: int) -> np.ndarray:
    """Pixels (N, 2) splatted on a raster, with holes between them closed and grown by `radius`."""
    drawn = np.zeros(shape, bool)
    cell = np.floor(pixels).astype(int)
    ok = ((cell >= 0) & (cell < np.array(shape[::-1]))).all(1)
    drawn[cell[ok, 1], cell[ok, 0]] = True
    return binary_dilation(drawn, iterations=radius)


def unexplained(
    model: Banmo, observations: Observations, intrinsics: Tensor, body: Hull, frames: Tensor, least_share: float = 0.015
) -> Unexplained:
    """Where the posed `body` leaves mask uncovered in `frames`; specks under `least_share` of the mask are dropped."""
    place = posed_placement(model, shell(body.solid, body.nodes))
    voxel = float(body.nodes[1, 0, 0, 0] - body.nodes[0, 0, 0, 0])
    area = np.zeros(len(observations))
    regions: list[np.ndarray] = [np.zeros(0, bool)] * len(observations)
    for f in frames.tolist():
        mask = observations.silhouettes[f].numpy() > 127
        camera = place(f)
        scale = float(observations.silhouette_scale[f])
        pixel_voxel = voxel * float(intrinsics[f, 0, 0]) * scale / max(float(camera[:, 2].median()), 1e-3)
        radius = max(1, round(0.5 * pixel_voxel + 1))
        rest = mask & ~_covered((project(intrinsics[f], camera) * scale).numpy(), mask.shape, radius)
        labels, count = label(rest)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)
        depth = distance_transform_edt(rest)
        thick = np.zeros(count + 1)
        np.maximum.at(thick, labels.ravel(), depth.ravel())
        keep = (sizes >= least_share * mask.sum()) & (thick >= 1.4)
        keep[0] = False
        regions[f] = keep[labels]
        area[f] = regions[f].sum() / max(1, mask.sum())
    return Unexplained(area, regions)


def choose_frame(found: Unexplained, observations: Observations, taken: set[int]) -> int:
    """The frame that shows most unexplained area, as long as its neighbours in time show it too."""
    area = found.area * observations.frame_weight.numpy()
    steady = area.copy()
    video = observations.video_idx.numpy()
    for f in range(len(area)):
        for g in (f - 1, f + 1):
            if 0 <= g < len(area) and video[g] == video[f]:
                steady[f] = min(steady[f], 1.5 * area[g])
        if any(abs(f - t) < 5 and video[t] == video[f] for t in taken):
            steady[f] = 0
    return int(steady.argmax())


def limb_voxels(
    model: Banmo, observations: Observations, intrinsics: Tensor, body: Hull, frame: int, region: np.ndarray, votes: Tensor
) -> np.ndarray:
    """Voxels (X, Y, Z) bool of the body's lattice that fill `region` of `frame`, in the canonical pose.

    `votes` (X, Y, Z) on the same lattice steer the depth.
    """
    state = model.frames(torch.tensor([frame]))
    nodes = body.nodes.reshape(-1, 3)
    with torch.no_grad():
        posed = model.forward_points(state, nodes[None])[0]
        camera = transform(state.camera_from_object[0], posed)
    scale = float(observations.silhouette_scale[frame])
    focal = float(intrinsics[frame, 0, 0])
    pixels = (project(intrinsics[frame], camera) * scale).numpy()
    mask = observations.silhouettes[frame].numpy() > 127
    # The limb reaches a little into the body, so that the two grow together.
    reach = binary_dilation(region, iterations=3) & mask
    depth_px = distance_transform_edt(mask)

    body_depth = camera[body.solid.reshape(-1), 2].numpy()
    low, high = np.quantile(body_depth, 0.01) - 0.35, np.quantile(body_depth, 0.99) + 0.35
    bins = 48
    edges = np.linspace(low, high, bins)
    rows, columns = np.nonzero(reach)
    # Votes are rigid (object space): read them at the points of each ray.
    xy = torch.tensor(np.stack([columns, rows], 1) + 0.5, dtype=torch.float32) / scale
    k = intrinsics[frame]
    direction = torch.cat([(xy - k[:2, 2]) / torch.stack([k[0, 0], k[1, 1]]), torch.ones(len(xy), 1)], 1)
    pose = state.camera_from_object[0].detach()
    points = direction[:, None] * torch.tensor(edges, dtype=torch.float32)[None, :, None]
    points = (points - pose[:3, 3]) @ pose[:3, :3]
    half = float(body.nodes.max())
    unit = (points / half).flip(-1).reshape(1, 1, 1, -1, 3)  # the lattice is indexed x, y, z
    read = torch.nn.functional.grid_sample(votes[None, None], unit, align_corners=True)
    cost = np.zeros((*mask.shape, bins), np.float32)
    cost[rows, columns] = read.reshape(len(xy), bins).numpy()
    sigma = 0.03 * mask.shape[0]
    weight = gaussian_filter(reach.astype(np.float32), sigma) + 1e-6
    smooth = np.stack([gaussian_filter(cost[..., b], sigma) for b in range(bins)], -1) / weight[..., None]
    # Near the body, and where no frame votes (a limb's far end), the depth of the body that it hangs on.
    hang, away_px = _nearest_depth(camera, pixels, body, mask.shape)
    pull = 0.15 + np.exp(-away_px / (0.04 * mask.shape[0]))
    smooth += pull[..., None] * np.exp(-((edges - hang[..., None]) ** 2) / 0.045)
    power = np.maximum(smooth, 0) ** 6  # a soft argmax: the densest depths win, neighbours agree
    centre = (power * edges).sum(-1) / np.maximum(power.sum(-1), 1e-12)

    cell = np.clip(np.floor(pixels).astype(int), 0, mask.shape[0] - 1)
    inside = ((pixels >= 0) & (pixels < mask.shape[0])).all(1) & reach[cell[:, 1], cell[:, 0]]
    z = camera[:, 2].numpy()
    # Half thickness: the limb's own half width near this pixel, in units at this depth.
    local = gaussian_filter(np.where(reach, depth_px, 0.0), 2) / np.maximum(gaussian_filter(reach.astype(float), 2), 1e-6)
    width = np.maximum(local[cell[:, 1], cell[:, 0]], 1.0) * np.maximum(z, 1e-3) / (focal * scale)
    voxel = float(body.nodes[1, 0, 0, 0] - body.nodes[0, 0, 0, 0])
    solid = inside & (np.abs(z - centre[cell[:, 1], cell[:, 0]]) <= np.maximum(1.3 * width, 0.8 * voxel))
    near = binary_dilation(body.solid.numpy(), iterations=max(1, round(1.0 / voxel)))
    return solid.reshape(body.solid.shape) & near


def _nearest_depth(camera: Tensor, pixels: np.ndarray, body: Hull, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Mean depth (h, w) of the body at each pixel, elsewhere at the nearest pixel that shows it; and how far that is."""
    solid = body.solid.reshape(-1).numpy()
    cell = np.floor(pixels[solid]).astype(int)
    ok = ((cell >= 0) & (cell < np.array(shape[::-1]))).all(1)
    total, count = np.zeros(shape), np.zeros(shape)
    np.add.at(total, (cell[ok, 1], cell[ok, 0]), camera[torch.from_numpy(solid), 2].numpy()[ok])
    np.add.at(count, (cell[ok, 1], cell[ok, 0]), 1)
    away, nearest = distance_transform_edt(count == 0, return_indices=True)
    return (total / np.maximum(count, 1))[tuple(nearest)], away


def attach(body: Hull, limbs: np.ndarray) -> Hull:
    """The body with limbs, gaps of a voxel closed, what stays loose dropped."""
    joined = binary_closing(np.pad(body.solid.numpy() | limbs, 2), iterations=1)[2:-2, 2:-2, 2:-2]
    solid = hull.largest_component(joined | body.solid.numpy())
    return Hull(body.nodes, body.share, torch.from_numpy(solid), body.level)
