"""From a posed body, its coat and a room to a picture, with the exact mask, depth and flow.

Cameras are OpenCV's (x right, y down, z forward); `camera_from_object` is the root pose. Pictures are drawn at
`supersample` times their size and averaged, so edges are soft as a camera's; masks come from the same coverage.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.geometry.raster import Fragments, rasterise, vertex_normals
from synthetic.bodies import Body
from synthetic.coats import Coat
from synthetic.rooms import Room, cast_shadow, draw_room


@dataclass(frozen=True)
class Camera:
    """Where one frame is seen from."""

    intrinsics: np.ndarray  # (3, 3) pixels
    camera_from_room: np.ndarray  # (4, 4) rigid


@dataclass(frozen=True)
class Look:
    """How light and the sensor treat a clip."""

    sun: float = 0.62
    sky: float = 0.55
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise: float = 0.008


def look_at(eye: np.ndarray, target: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """camera_from_room (4, 4) of a camera at `eye` that looks at `target`, rolled by `roll` radians."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.stack([c * right + s * down, -s * right + c * down, forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
    return matrix


def draw(
    body: Body,
    posed: np.ndarray,
    room_from_object: np.ndarray,
    coat: Coat,
    room: Room | None,
    camera: Camera,
    size_px: tuple[int, int],
    look: Look,
    rng: np.random.Generator,
    supersample: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """One frame: (H, W, 3) uint8 sRGB and the object's coverage (H, W) float32 in 0..1.

    Args:
        posed: (V, 3) vertices in object space.
        size_px: height and width.
        room: None gives a plain light grey background.
    """
    height, width = size_px[0] * supersample, size_px[1] * supersample
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2] *= supersample
    in_room = posed @ room_from_object[:3, :3].T + room_from_object[:3, 3]
    in_camera = in_room @ camera.camera_from_room[:3, :3].T + camera.camera_from_room[:3, 3]
    fragments = rasterise(in_camera, body.faces, intrinsics, height, width)
    if room is None:
        image: np.ndarray = np.full((height, width, 3), 0.8, np.float32)
        light = np.array([0.3, 0.9, 0.3]) / np.linalg.norm([0.3, 0.9, 0.3])
    else:
        room_from_camera = np.linalg.inv(camera.camera_from_room)
        image = draw_room(room, room_from_camera, intrinsics, height, width, cast_shadow(room, in_room))
        light = room.light
    _paint(image, fragments, body, in_room, coat, light, look)
    coverage: np.ndarray = fragments.covered.astype(np.float32)
    if supersample > 1:
        shape = (size_px[1], size_px[0])
        image = cv2.resize(image, shape, interpolation=cv2.INTER_AREA)
        coverage = cv2.resize(coverage, shape, interpolation=cv2.INTER_AREA)
    image = image * np.array(look.gain, np.float32)
    image = image + rng.normal(0, look.noise, image.shape).astype(np.float32)
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8), coverage


def _paint(
    image: np.ndarray, fragments: Fragments, body: Body, in_room: np.ndarray, coat: Coat, light: np.ndarray, look: Look
) -> None:
    """Shade the animal's pixels into `image` (in place)."""
    rows, columns = np.nonzero(fragments.covered)
    if not len(rows):
        return
    corners = body.faces[fragments.face_idx[rows, columns]]
    weight = fragments.barycentric[rows, columns][:, :, None]

    def spread(attribute: np.ndarray) -> np.ndarray:
        return (attribute.astype(np.float32)[corners] * weight).sum(1)

    normal = spread(vertex_normals(in_room, body.faces))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    colour = spread(coat.vertex_colours)
    rest = spread(body.vertices)
    for mark in coat.marks:
        distance = np.linalg.norm(rest - mark.centre.astype(np.float32), axis=1)
        amount = np.clip((mark.radius - distance) / (0.12 * mark.radius) + 0.5, 0, 1)[:, None]
        colour = colour + (mark.colour.astype(np.float32) - colour) * amount
    sun = np.clip((normal @ light.astype(np.float32) + 0.15) / 1.15, 0, 1)
    height = spread(in_room[:, 1:2])[:, 0]
    sky = 0.5 + 0.5 * normal[:, 1]
    sky = sky * (0.75 + 0.25 * np.clip(height / 0.5, 0, 1)) + 0.15
    shade = look.sun * sun + look.sky * sky
    linear = np.clip(colour, 0, 1) ** 2.2 * shade[:, None]
    image[rows, columns] = np.clip(linear, 0, 1) ** (1 / 2.2)


def flow_between(
    body: Body,
    posed_from: np.ndarray,
    posed_to: np.ndarray,
    camera_from_object_from: np.ndarray,
    camera_from_object_to: np.ndarray,
    intrinsics: np.ndarray,
    size_px: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Exact flow of the object's pixels from one moment to another.

    Returns (H, W, 2) float32 pixels (zero off the object) and (H, W) bool: on the object and still in sight after.
    """

    def seen(posed: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, Fragments]:
        points = posed @ pose[:3, :3].T + pose[:3, 3]
        return points, rasterise(points, body.faces, intrinsics, *size_px)

    _before, fragments = seen(posed_from, camera_from_object_from)
    after, later = seen(posed_to, camera_from_object_to)
    rows, columns = np.nonzero(fragments.covered)
    corners = body.faces[fragments.face_idx[rows, columns]]
    weight = fragments.barycentric[rows, columns].astype(np.float64)[:, :, None]
    target = (after[corners] * weight).sum(1)
    pixel = target @ intrinsics.T
    pixel = pixel[:, :2] / pixel[:, 2:]
    flow = np.zeros((*size_px, 2), np.float32)
    flow[rows, columns] = pixel - np.stack([columns + 0.5, rows + 0.5], 1)
    visible = np.zeros(size_px, bool)
    column, row = np.floor(pixel).astype(int).T
    inside = (column >= 0) & (column < size_px[1]) & (row >= 0) & (row < size_px[0])
    depth = np.full(len(rows), -np.inf)
    depth[inside] = later.depth[row[inside], column[inside]]
    visible[rows, columns] = inside & np.isfinite(depth) & (target[:, 2] < depth + 0.03)
    return flow, visible
