"""A quick picture of where an optimisation stands: source beside the posed surface, coloured by its normals."""

from __future__ import annotations

import numpy as np
import torch

from stages.fitting.surface import sample_volume
from stages.geometry.cameras import transform
from stages.geometry.raster import rasterise, vertex_normals
from stages.model.banmo import Banmo


def _normals(camera: np.ndarray, faces: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The surface on white, (H, W, 3) in 0..1, coloured by its camera-space normals."""
    seen = rasterise(camera, faces, intrinsics, *size, cull_back=False)
    hit = seen.face_idx >= 0
    corners = vertex_normals(camera, faces)[faces[seen.face_idx[hit]]]
    normal = (corners * seen.barycentric[hit][..., None]).sum(1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-9
    out = np.ones((*size, 3))
    out[hit] = 0.5 - 0.5 * normal  # a surface that faces the camera has normal -z
    return out


def preview_sheet(model: Banmo, images: list[tuple[int, int, np.ndarray]], side_px: int = 160) -> np.ndarray:
    """Rows of two pictures for (video index, kept frame, image (H, W, 3)); returns an RGB sheet, uint8."""
    from skimage.measure import marching_cubes
    from skimage.transform import resize

    volume, low, spacing = sample_volume(model, 64)
    tiles = []
    if volume.min() < 0 < volume.max():
        vertices, faces, _, _ = marching_cubes(volume, 0.0, spacing=tuple(float(s) for s in spacing))
        points = torch.from_numpy(vertices.astype(np.float32)) + low
    else:
        points, faces = torch.zeros(0, 3), np.zeros((0, 3), np.int64)
    for video, frame, image in images:
        height, width = image.shape[:2]
        scale = side_px / max(height, width)
        size = (max(1, round(height * scale)), max(1, round(width * scale)))
        small = np.clip(resize(image / 255.0, size, order=1, anti_aliasing=True), 0, 1)
        drawn = np.full((*size, 3), 1.0)
        if len(points):
            time = torch.tensor([model.videos[video].time_s[frame]], dtype=torch.float64)
            posed = model.forward_warp(points, video, time)[0]
            camera = transform(model.root_poses(video, time)[0], posed).numpy()
            k = model.intrinsics(video).numpy().copy()
            k[:2] *= scale
            drawn = _normals(camera, faces, k, size)
        tile = np.ones((side_px, 2 * side_px, 3))
        tile[: size[0], : size[1]] = small
        tile[: size[0], side_px : side_px + size[1]] = drawn
        tiles.append(tile)
    while len(tiles) % 2:
        tiles.append(np.ones((side_px, 2 * side_px, 3)))
    rows = [np.concatenate(tiles[i : i + 2], 1) for i in range(0, len(tiles), 2)]
    return np.round(np.concatenate(rows) * 255).astype(np.uint8)
