"""Pictures of a rigged mesh: a turntable, and each video's frames beside the posed mesh. Plain arrays in and out."""

from __future__ import annotations

import colorsys
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from stages.geometry.raster import project, rasterise, vertex_normals
from stages.meshing.atlas import sample

_LIGHT = np.array([-0.35, -0.55, -0.76], np.float32)  # camera frame: from above, left of and behind the camera
_PAPER = 0.93
_ELEVATION = np.radians(12)


@dataclass(frozen=True)
class Look:
    """What is drawn: faces (F, 3), sRGB colours (V, 3) in 0..1, colours of the skin weights (V, 3), tree (B,).

    With a `texture` (S, S, 3) uint8 and `corner_uv` (F, 3, 2) the colours come from there.
    """

    faces: np.ndarray
    colour: np.ndarray
    skin: np.ndarray
    parent: np.ndarray
    texture: np.ndarray | None = None
    corner_uv: np.ndarray | None = None


def joint_palette(count: int) -> np.ndarray:
    """(count, 3) sRGB colours in 0..1, neighbours in the list far apart in hue."""
    return np.array([colorsys.hsv_to_rgb((j * 0.61803) % 1.0, 0.55 + 0.3 * (j % 2), 0.95) for j in range(count)])


def scaled_size(width_px: int, height_px: int, side_px: int) -> tuple[int, int, float]:
    """Even width and height with the longer side about `side_px`, and the scale that leads there."""
    scale = side_px / max(width_px, height_px)
    return max(2, round(width_px * scale / 2) * 2), max(2, round(height_px * scale / 2) * 2), scale


def scaled_intrinsics(
    intrinsics: np.ndarray, width_px: int, height_px: int, new_width: int, new_height: int
) -> np.ndarray:
    """K of the same picture resized; pixel centres at half-integers make this a plain scaling of both rows."""
    return np.diag([new_width / width_px, new_height / height_px, 1.0]) @ intrinsics


def paint(
    look: Look,
    vertices_camera: np.ndarray,
    sticks_camera: np.ndarray,
    intrinsics: np.ndarray,
    background: np.ndarray,
    supersample: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Two pictures of the mesh before a camera: in its colour over `background`, and in its skin colours with bones.

    Args:
        vertices_camera: (V, 3); sticks_camera: (B, 2, 3), joint and centre of each bone; camera frame.
        intrinsics: (3, 3) for pictures of the background's size.
        background: (H, W, 3) in 0..1.
        supersample: rays per pixel along each side.

    Returns:
        Two (H, W, 3) uint8 pictures.
    """
    height, width = background.shape[:2]
    k = np.diag([supersample, supersample, 1.0]) @ intrinsics
    fragments = rasterise(vertices_camera, look.faces, k, height * supersample, width * supersample)
    attribute = np.concatenate([look.colour, look.skin, vertex_normals(vertices_camera, look.faces)], axis=1)
    pixels = fragments.pixels()
    values = fragments.at_pixels(pixels, look.faces, attribute)
    if look.texture is not None and look.corner_uv is not None:
        weight = fragments.barycentric.reshape(-1, 3)[pixels]
        uv = np.einsum("pk,pkc->pc", weight, look.corner_uv[fragments.face_idx.reshape(-1)[pixels]])
        values[:, :3] = sample(look.texture, uv)
    length = np.sqrt(np.einsum("pc,pc->p", values[:, 6:], values[:, 6:]))
    lit = np.clip(values[:, 6:] @ _LIGHT / np.maximum(length, 1e-6), 0, 1)[:, None]
    layers = np.zeros((height * supersample, width * supersample, 7), np.float32)
    layers.reshape(-1, 7)[pixels] = np.concatenate(
        [values[:, :3] * (0.72 + 0.33 * lit), values[:, 3:6] * (0.5 + 0.55 * lit), np.ones_like(lit)], axis=1
    )
    if supersample > 1:
        layers = cv2.resize(layers, (width, height), interpolation=cv2.INTER_AREA)
    alpha = layers[..., 6:]
    coloured = np.clip(layers[..., :3] + (1 - alpha) * background, 0, 1)
    skinned = np.clip(layers[..., 3:6] + (1 - alpha) * _PAPER, 0, 1)
    pictures = [(p * 255 + 0.5).astype(np.uint8) for p in (coloured, skinned)]
    _draw_bones(pictures[1], sticks_camera, look.parent, intrinsics)
    return pictures[0], pictures[1]


def _draw_bones(picture: np.ndarray, sticks_camera: np.ndarray, parent: np.ndarray, intrinsics: np.ndarray) -> None:
    if (sticks_camera[..., 2] < 0.05).any():
        return
    pixel = project(sticks_camera.reshape(-1, 3), intrinsics).reshape(-1, 2, 2)
    pixel = np.clip(pixel * 16, -1e6, 1e6).astype(int)  # cv2 draws with four fractional bits
    for (joint, centre), p in zip(pixel.tolist(), parent.tolist(), strict=True):
        cv2.line(picture, joint, centre, (40, 40, 40), 1, cv2.LINE_AA, 4)
        if p >= 0:
            cv2.line(picture, pixel[p, 1].tolist(), joint, (40, 40, 40), 1, cv2.LINE_AA, 4)
    for joint, _ in pixel.tolist():
        cv2.circle(picture, joint, 36, (20, 20, 20), -1, cv2.LINE_AA, 4)


def orbit(azimuth: float, elevation: float, centre: np.ndarray, distance: float) -> np.ndarray:
    """Camera_from_object (4, 4), OpenCV, of a camera that looks at `centre`; azimuth 0 sees the front (+z), y up."""
    direction = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    forward = -direction
    right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ (centre + direction * distance)
    return pose


def turntable(look: Look, vertices: np.ndarray, sticks: np.ndarray, frames: int, side_px: int) -> Iterator[np.ndarray]:
    """One turn about the rest pose, (side, 2 side, 3) uint8 pictures: in colour, and in skin colours with bones."""
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    focal = 1.6 * side_px
    intrinsics = np.array([[focal, 0, side_px / 2], [0, focal, side_px / 2], [0, 0, 1]])
    azimuths = 2 * np.pi * np.arange(frames) / frames
    distance = _fitting_distance(vertices, centre, azimuths, intrinsics)
    background = np.full((side_px, side_px, 3), _PAPER, np.float32)
    for azimuth in azimuths:
        pose = orbit(azimuth, _ELEVATION, centre, distance)
        points = vertices @ pose[:3, :3].T + pose[:3, 3]
        bones = sticks @ pose[:3, :3].T + pose[:3, 3]
        yield np.concatenate(paint(look, points, bones, intrinsics, background, supersample=2), axis=1)


def _fitting_distance(vertices: np.ndarray, centre: np.ndarray, azimuths: np.ndarray, intrinsics: np.ndarray) -> float:
    """The nearest distance at which the object fills 92 % of the picture at most, from every azimuth."""
    needed = 0.0
    for azimuth in azimuths:
        rotation = orbit(azimuth, _ELEVATION, centre, 1.0)[:3, :3]
        relative = (vertices - centre) @ rotation.T
        # |f x / (d + z)| <= 0.46 S, and the same for y
        reach = np.abs(relative[:, :2]).max(axis=1) * intrinsics[0, 0] / (0.92 * intrinsics[0, 2]) - relative[:, 2]
        needed = max(needed, float(reach.max()))
    return needed


def overlay(
    look: Look, vertices_camera: np.ndarray, sticks_camera: np.ndarray, intrinsics: np.ndarray, frame: np.ndarray
) -> np.ndarray:
    """A frame (H, W, 3) uint8, the mesh in its place over the paled frame, and its bones: (H, 3 W, 3) uint8."""
    grey = frame.astype(np.float32).mean(axis=-1, keepdims=True) / 255
    pale = np.repeat(0.55 + 0.4 * grey, 3, axis=-1)
    return np.concatenate([frame, *paint(look, vertices_camera, sticks_camera, intrinsics, pale)], axis=1)
