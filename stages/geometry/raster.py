"""A z-buffer rasteriser for triangle meshes in plain numpy: no window system, no GPU, same bytes every time.

Cameras are OpenCV's: x right, y down, z forward; the centre of pixel (column c, row r) is at (c + 0.5, r + 0.5).
Good for meshes of some ten thousand faces at a few hundred pixels, tens of frames a second on one core, because every
candidate pixel of every triangle is tested in one vectorised pass and the nearest is found with one scatter-minimum.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

_CANDIDATES_PER_PASS = 2_000_000  # bounds memory when a few triangles fill the whole image
_EDGE_SLACK = 1e-5  # barycentric; neighbours both claim pixels on their shared edge, so no cracks appear


@dataclass(frozen=True)
class Fragments:
    """The nearest triangle under every pixel centre.

    face_idx: (H, W) int32, -1 where there is none.
    depth: (H, W) float32, z in the camera's frame; infinity where there is none.
    barycentric: (H, W, 3) float32, perspective-correct weights of the face's corners; zero where there is none.
    """

    face_idx: np.ndarray
    depth: np.ndarray
    barycentric: np.ndarray

    @property
    def covered(self) -> np.ndarray:
        """(H, W) bool silhouette."""
        return self.face_idx >= 0

    def pixels(self) -> np.ndarray:
        """(P,) indices of covered pixels in the flattened image."""
        return np.flatnonzero(self.covered)

    def at_pixels(self, pixels: np.ndarray, faces: np.ndarray, attribute: np.ndarray) -> np.ndarray:
        """A vertex attribute (V, C) at covered `pixels` (P,): (P, C) float32."""
        corners = faces[self.face_idx.reshape(-1)[pixels]]
        weight = self.barycentric.reshape(-1, 3)[pixels]
        values = attribute.astype(np.float32)
        mixed = values[corners[:, 0]] * weight[:, :1]
        mixed += values[corners[:, 1]] * weight[:, 1:2]
        mixed += values[corners[:, 2]] * weight[:, 2:]
        return mixed

    def interpolate(self, faces: np.ndarray, attribute: np.ndarray, background: float = 0.0) -> np.ndarray:
        """Spread a vertex attribute (V, C) over the pixels: (H, W, C) float32, `background` off the mesh."""
        image = np.full((*self.face_idx.shape, attribute.shape[1]), background, np.float32)
        pixels = self.pixels()
        image.reshape(-1, attribute.shape[1])[pixels] = self.at_pixels(pixels, faces, attribute)
        return image


def project(points_camera: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in the camera's frame; depth must not be zero."""
    homogeneous = points_camera @ np.asarray(intrinsics, np.float64).T
    return homogeneous[:, :2] / homogeneous[:, 2:3]


def rasterise(
    vertices_camera: np.ndarray,
    faces: np.ndarray,
    intrinsics: np.ndarray,
    height_px: int,
    width_px: int,
    cull_back: bool = True,
    near: float = 0.02,
) -> Fragments:
    """Rasterise a triangle mesh given in the camera's frame.

    Args:
        vertices_camera: (V, 3) positions, camera frame.
        faces: (F, 3) vertex indices, counter-clockwise seen from outside.
        intrinsics: (3, 3) in pixels of this image.
        height_px, width_px: size of the image.
        cull_back: leave out triangles seen from inside (right for closed meshes, twice as fast).
        near: triangles with a corner nearer than this are left out.
    """
    vertices = np.asarray(vertices_camera, np.float64)
    pixel_count = height_px * width_px
    depth_buffer = np.full(pixel_count, np.inf, np.float32)
    face_buffer = np.full(pixel_count, -1, np.int32)
    weight_buffer = np.zeros((pixel_count, 3), np.float32)

    depth = vertices[:, 2]
    safe = np.where(depth > near, depth, 1.0)
    homogeneous = vertices @ np.asarray(intrinsics, np.float64).T
    xy = homogeneous[:, :2] / safe[:, None]

    corner = xy[faces]  # (F, 3, 2)
    edge_1, edge_2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = edge_1[:, 0] * edge_2[:, 1] - edge_1[:, 1] * edge_2[:, 0]  # negative: faces the camera, as y points down
    keep = (depth[faces] > near).all(axis=1) & (area < -1e-12 if cull_back else np.abs(area) > 1e-12)
    lowest = np.ceil(corner.min(axis=1) - 0.5 - 1e-4)
    highest = np.floor(corner.max(axis=1) - 0.5 + 1e-4)
    lowest = np.clip(lowest, 0, (width_px, height_px)).astype(np.int64)
    highest = np.clip(highest, -1, (width_px - 1, height_px - 1)).astype(np.int64)
    extent = np.maximum(highest - lowest + 1, 0)
    count = extent[:, 0] * extent[:, 1]
    selected = np.flatnonzero(keep & (count > 0))
    if not len(selected):
        return _finish(face_buffer, depth_buffer, weight_buffer, height_px, width_px)

    # Barycentric weights of corners 1 and 2 are affine in the pixel, relative to the box's first pixel centre.
    origin = lowest[selected] + 0.5 - corner[selected, 0]
    inverse_area = 1.0 / area[selected]
    e1, e2 = edge_1[selected] * inverse_area[:, None], edge_2[selected] * inverse_area[:, None]
    slope = np.stack([e2[:, 1], -e2[:, 0], -e1[:, 1], e1[:, 0]], axis=1)
    start = np.stack(
        [
            origin[:, 0] * slope[:, 0] + origin[:, 1] * slope[:, 1],
            origin[:, 0] * slope[:, 2] + origin[:, 1] * slope[:, 3],
        ],
        axis=1,
    ).astype(np.float32)
    slope = slope.astype(np.float32)
    inverse_depth = (1.0 / depth[faces[selected]]).astype(np.float32)
    first_pixel = lowest[selected, 1] * width_px + lowest[selected, 0]
    box_width, count = extent[selected, 0], count[selected]

    for begin, end in _passes(count):
        triangle = np.repeat(np.arange(begin, end), count[begin:end])
        run_start = np.cumsum(count[begin:end]) - count[begin:end]
        offset = np.arange(len(triangle)) - np.repeat(run_start, count[begin:end])
        row, column = np.divmod(offset.astype(np.int32), box_width[triangle].astype(np.int32))
        s = slope[triangle]
        w1 = start[triangle, 0] + s[:, 0] * column + s[:, 1] * row
        w2 = start[triangle, 1] + s[:, 2] * column + s[:, 3] * row
        inside = np.flatnonzero((w1 >= -_EDGE_SLACK) & (w2 >= -_EDGE_SLACK) & (w1 + w2 <= 1 + _EDGE_SLACK))
        triangle, w1, w2 = triangle[inside], w1[inside], w2[inside]
        pixel = first_pixel[triangle] + row[inside].astype(np.int64) * width_px + column[inside]
        reciprocal = inverse_depth[triangle]
        p0, p1, p2 = (1 - w1 - w2) * reciprocal[:, 0], w1 * reciprocal[:, 1], w2 * reciprocal[:, 2]
        z = (1.0 / (p0 + p1 + p2)).astype(np.float32)  # as the buffer, or no depth would equal its own minimum
        np.minimum.at(depth_buffer, pixel, z)
        won = np.flatnonzero(z == depth_buffer[pixel])
        winner = pixel[won]
        face_buffer[winner] = selected[triangle[won]]
        weight_buffer[winner] = np.stack([p0[won], p1[won], p2[won]], axis=1) * z[won, None]
    return _finish(face_buffer, depth_buffer, weight_buffer, height_px, width_px)


def _passes(count: np.ndarray) -> list[tuple[int, int]]:
    """Split triangles into runs of bounded candidate count."""
    total = np.cumsum(count)
    bounds = [0]
    while bounds[-1] < len(count):
        used = total[bounds[-1] - 1] if bounds[-1] else 0
        bounds.append(max(bounds[-1] + 1, int(np.searchsorted(total, used + _CANDIDATES_PER_PASS, side="right"))))
    return list(itertools.pairwise(bounds))


def _finish(faces: np.ndarray, depth: np.ndarray, weight: np.ndarray, height_px: int, width_px: int) -> Fragments:
    return Fragments(
        faces.reshape(height_px, width_px),
        depth.reshape(height_px, width_px),
        weight.reshape(height_px, width_px, 3),
    )


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) cross products, pointing outward, of length twice the face's area."""
    corner = vertices[faces]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals, mean of the adjoining faces weighted by area; (0, 1, 0) where there is none."""
    normal = face_normals(vertices.astype(np.float64), faces)
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(normal[:, axis], 3), minlength=len(vertices)) for axis in range(3)],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-12, total / np.maximum(length, 1e-12), (0.0, 1.0, 0.0))
