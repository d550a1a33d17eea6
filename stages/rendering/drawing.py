"""Drawing a posed, textured mesh: colour, silhouette, depth, normals, correspondence colours. Arrays in and out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.geometry.raster import Fragments, rasterise, vertex_normals
from stages.meshing.atlas import sample

KINDS = ("colour", "silhouette", "depth", "normals", "correspondence")
_LIGHT = np.array([-0.35, -0.55, -0.76])


@dataclass(frozen=True)
class Surface:
    """What is drawn: faces (F, 3), sRGB colour (V, 3), rest vertices (V, 3); texture (S, S, 3) uint8 and uv (V, 2)."""

    faces: np.ndarray
    colour: np.ndarray
    rest: np.ndarray
    texture: np.ndarray | None = None
    uv: np.ndarray | None = None


def correspondence_colour(rest: np.ndarray) -> np.ndarray:
    """(V, 3) in 0..1: a colour for each place on the rest shape; the same place has one colour in all frames."""
    low, high = rest.min(axis=0), rest.max(axis=0)
    unit = (rest - low) / np.maximum(high - low, 1e-9)
    waves = 0.5 + 0.5 * np.cos(2 * np.pi * 3 * unit)
    return np.clip(0.75 * unit + 0.25 * waves, 0, 1)


def draw(
    surface: Surface,
    vertices_camera: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    kind: str,
    background: np.ndarray,
    depth_range: tuple[float, float] = (1.0, 5.0),
    supersample: int = 2,
) -> np.ndarray:
    """One picture (H, W, 4) uint8, RGB and coverage.

    Args:
        vertices_camera: (V, 3) before the camera (OpenCV); size: height, width in pixels.
        kind: one of :data:`KINDS`. Normals are in the camera's frame, x right, y up, z towards it, as (n + 1) / 2;
            depth is grey, near bright, over `depth_range`.
        background: (3,) in 0..1 behind the object; silhouette and depth have black.
        supersample: rays a pixel along each side; depth and correspondence are never blended, so they take one.
    """
    factor = 1 if kind in ("depth", "correspondence") else supersample
    height, width = size[0] * factor, size[1] * factor
    k = np.diag([factor, factor, 1.0]) @ intrinsics
    fragments = rasterise(vertices_camera, surface.faces, k, height, width)
    pixels = fragments.pixels()
    picture: np.ndarray = np.zeros((height * width, 4), np.float32)
    picture[:, :3] = 0.0 if kind in ("silhouette", "depth") else background  # so that they can be read as data
    if len(pixels):
        picture[pixels, :3] = _values(surface, vertices_camera, fragments, pixels, kind, depth_range)
        picture[pixels, 3] = 1.0
    picture = picture.reshape(height, width, 4)
    if factor > 1:
        picture = cv2.resize(picture, (size[1], size[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(np.round(np.clip(picture, 0, 1) * 255), np.uint8)


def _values(
    surface: Surface,
    vertices: np.ndarray,
    fragments: Fragments,
    pixels: np.ndarray,
    kind: str,
    depth_range: tuple[float, float],
) -> np.ndarray:
    """(N, 3) colours in 0..1 of covered pixels."""
    at = fragments.at_pixels
    if kind == "silhouette":
        return np.ones((len(pixels), 3))
    if kind == "depth":
        near, far = depth_range
        depth = at(pixels, surface.faces, vertices[:, 2:3])
        return np.repeat(1 - 0.9 * np.clip((depth - near) / max(far - near, 1e-9), 0, 1), 3, axis=1)
    if kind == "correspondence":
        return np.asarray(at(pixels, surface.faces, correspondence_colour(surface.rest)))
    normal = at(pixels, surface.faces, vertex_normals(vertices, surface.faces))
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    if kind == "normals":
        return 0.5 + 0.5 * normal * np.array([1.0, -1.0, -1.0])
    colour = at(pixels, surface.faces, surface.colour)
    if surface.texture is not None and surface.uv is not None:
        colour = sample(surface.texture, at(pixels, surface.faces, surface.uv))
    lit = np.clip(normal @ _LIGHT, 0, 1)[:, None]
    return np.asarray(colour * (0.78 + 0.3 * lit))
