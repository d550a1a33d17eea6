"""A texture: charts by xatlas, texels coloured from the videos where they saw them, else by the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xatlas
from scipy import ndimage

from stages.geometry.raster import Fragments, face_normals, project, rasterise
from stages.meshing.surface import Mesh

_FIELD_WEIGHT = 0.02  # of the model's own colour beside what the frames say; a frontal, sharp sample weighs 1
_FRONTAL = 2.0  # power of the cosine of the angle of view: how much the most frontal views dominate
_LIGHT = 1.2  # how much brighter one side of an object may be than its mean
_OUTLIER = 0.4  # a sample that differs so much from the model's colour is taken for background or an occluder


@dataclass(frozen=True)
class Atlas:
    """Charts of a mesh of V vertices and F faces, cut open into U vertices.

    vertex: (U,) vertex of the mesh. faces: (F, 3) into U, in the order of the mesh's faces.
    uv: (U, 2) in 0..1, v downward as in glTF: texel (column c, row r) of an S x S picture is at ((c, r) + 0.5) / S.
    """

    vertex: np.ndarray
    faces: np.ndarray
    uv: np.ndarray

    @property
    def corner_uv(self) -> np.ndarray:
        """(F, 3, 2) coordinates of each corner."""
        return self.uv[self.faces]


def fitting_side_px(silhouette_px: float, most_px: int) -> int:
    """Side of a texture that holds what pictures show whose silhouette covers `silhouette_px` pixels: a power of two.

    The surface has about four times the area of its silhouette (exactly so for the mean of a convex one), charts fill
    some 60 % of the picture, and one and a half texels a pixel lose nothing.
    """
    needed = 1.5 * np.sqrt(4 * silhouette_px / 0.6)
    return int(min(most_px, 2 ** np.ceil(np.log2(max(needed, 64.0)))))


def unwrap(mesh: Mesh, size_px: int) -> Atlas:
    """Cut the surface into charts and pack them into a square picture of `size_px`."""
    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.padding = 3
    pack.resolution = size_px
    pack.create_image = False
    atlas.generate(xatlas.ChartOptions(), pack)
    vertex, faces, uv = atlas[0]
    return Atlas(vertex.astype(np.int64), faces.astype(np.int64), np.clip(uv.astype(np.float64), 0, 1))


@dataclass(frozen=True)
class Texels:
    """The texels that lie in a chart: flat index (P,) into the picture, face (P,), barycentric weights (P, 3)."""

    size_px: int
    pixel: np.ndarray
    face: np.ndarray
    weight: np.ndarray

    def spread(self, faces: np.ndarray, attribute: np.ndarray) -> np.ndarray:
        """A vertex attribute (V, C) at the texels: (P, C)."""
        return np.asarray(np.einsum("pk,pkc->pc", self.weight, attribute[faces[self.face]]))


def texels_of(atlas: Atlas, size_px: int) -> Texels:
    """Rasterise the charts."""
    flat = np.concatenate([atlas.uv, np.ones((len(atlas.uv), 1))], axis=1)
    scale = np.diag([float(size_px), float(size_px), 1.0])
    fragments = rasterise(flat, atlas.faces, scale, size_px, size_px, cull_back=False)
    pixel = fragments.pixels()
    return Texels(
        size_px, pixel, fragments.face_idx.reshape(-1)[pixel], fragments.barycentric.reshape(-1, 3)[pixel].astype(float)
    )


class Baker:
    """Gathers colour for texels, frame by frame and clip by clip.

    Samples are weighted by the angle of view and by how many pixels the frame spends on the face, raised so that the
    best views dominate; near the outline of the object nothing is taken.
    """

    def __init__(self, mesh: Mesh, texels: Texels, field_colour: np.ndarray) -> None:
        self._mesh, self._texels = mesh, texels
        self._field = field_colour.astype(np.float32)  # (P, 3) the model's own, in 0..1
        self._total, self._clip_total = np.zeros_like(self._field), np.zeros_like(self._field)
        self._weight, self._clip_weight = np.zeros((2, len(texels.pixel)), np.float32)

    def add(
        self,
        vertices_camera: np.ndarray,
        intrinsics: np.ndarray,
        fragments: Fragments,
        frame: np.ndarray,
        mask: np.ndarray,
        slack: float,
        trust: float = 1.0,
    ) -> None:
        """Take what one frame (H, W, 3) uint8 shows of the mesh at `vertices_camera` (V, 3), inside its mask.

        `trust` weighs the frame against others of its clip: a blurred frame should count for less.
        """
        faces = self._mesh.faces
        normal = face_normals(vertices_camera, faces)
        centre = vertices_camera[faces].mean(axis=1)
        area = np.linalg.norm(normal, axis=1)
        facing = -(normal * centre).sum(axis=1) / np.maximum(area * np.linalg.norm(centre, axis=1), 1e-12)
        pixels_per_unit = intrinsics[0, 0] / np.maximum(centre[:, 2], 1e-3)
        face_weight = np.clip((facing - 0.2) / 0.8, 0, 1) ** _FRONTAL * (pixels_per_unit / intrinsics[0, 0] * 3) ** 2
        candidate = np.flatnonzero(face_weight[self._texels.face] > 1e-3)
        corner = vertices_camera[faces[self._texels.face[candidate]]]
        point = np.einsum("pk,pkc->pc", self._texels.weight[candidate], corner)
        position = project(point, intrinsics)
        height, width = mask.shape
        inside = (position >= 1).all(axis=1) & (position[:, 0] < width - 1) & (position[:, 1] < height - 1)
        candidate, point, position = candidate[inside], point[inside], position[inside]
        column, row = np.floor(position).astype(int).T
        # A texel is taken only well inside both outlines: a pixel of error there would bring in the background.
        solid = ndimage.binary_erosion(mask & fragments.covered, iterations=2)
        clear = solid[row, column] & (point[:, 2] <= fragments.depth[row, column] + slack)
        candidate, position = candidate[clear], position[clear]
        if not len(candidate):
            return
        colour = _bilinear(frame, position - 0.5)
        weight = (trust * face_weight[self._texels.face[candidate]]).astype(np.float32)
        weight[np.abs(colour - self._field[candidate]).max(axis=1) > _OUTLIER] = 0
        self._clip_total[candidate] += colour * weight[:, None]
        self._clip_weight[candidate] += weight

    def end_clip(self) -> None:
        """Merge what was added since the last call: frames of one video, in one light.

        Exposure and light differ from clip to clip, so the clip is brought towards the model's own colour by gains, one
        a channel. What may be the light on the side it shows is evened out by half only, as a picture of that side
        should keep some of it; what goes beyond is exposure, and taken off.
        """
        weight = self._clip_weight[:, None]
        colour = self._clip_total / np.maximum(weight, 1e-9)
        wanted = (weight * colour * self._field).sum(axis=0, dtype=np.float64)
        gain = np.clip(wanted / ((weight * colour * colour).sum(axis=0, dtype=np.float64) + 1e-6), 0.5, 2.0)
        gain /= np.sqrt(np.clip(gain, 1 / _LIGHT, _LIGHT))
        self._total += np.minimum(self._clip_total * gain.astype(np.float32), self._clip_weight[:, None])
        self._weight += self._clip_weight
        self._clip_total[:], self._clip_weight[:] = 0, 0

    def picture(self) -> tuple[np.ndarray, float]:
        """The texture (S, S, 3) uint8 sRGB, charts grown into the gaps, and the share of texels from frames."""
        colour = (self._total + self._field * _FIELD_WEIGHT) / (self._weight[:, None] + _FIELD_WEIGHT)
        size = self._texels.size_px
        image = np.zeros((size * size, 3), np.float32)
        empty = np.ones(size * size, bool)
        image[self._texels.pixel], empty[self._texels.pixel] = colour, False
        nearest = ndimage.distance_transform_edt(empty.reshape(size, size), return_distances=False, return_indices=True)
        filled = image.reshape(size, size, 3)[nearest[0], nearest[1]]
        return np.round(np.clip(filled, 0, 1) * 255).astype(np.uint8), float((self._weight > _FIELD_WEIGHT).mean())


def _bilinear(frame: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Colours (P, 3) in 0..1 at positions (P, 2), x then y, in units of pixels whose centres are whole numbers."""
    low = np.floor(position).astype(int)
    part = (position - low).astype(np.float32)
    x, y = low.T
    right, down = np.minimum(x + 1, frame.shape[1] - 1), np.minimum(y + 1, frame.shape[0] - 1)
    top = frame[y, x] * (1 - part[:, :1]) + frame[y, right] * part[:, :1]
    bottom = frame[down, x] * (1 - part[:, :1]) + frame[down, right] * part[:, :1]
    return np.asarray((top * (1 - part[:, 1:]) + bottom * part[:, 1:]) / 255, np.float32)


def sample(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours (P, 3) in 0..1 of a texture (S, S, 3) uint8 at (P, 2) coordinates."""
    return _bilinear(texture, np.clip(uv * texture.shape[0] - 0.5, 0, texture.shape[0] - 1))
