"""Contact sheets of root poses: what the estimate claims, drawn over the frames."""

from __future__ import annotations

import cv2
import numpy as np

_AXES = (((1.0, 0, 0), (230, 60, 60)), ((0, 1.0, 0), (70, 210, 70)), ((0, 0, 1.0), (80, 140, 255)))
_RING = (255, 205, 60)
_SUPERSAMPLE = 2


def draw_pose(image: np.ndarray, intrinsics: np.ndarray, object_to_camera: np.ndarray) -> np.ndarray:
    """One frame (H, W, 3) uint8 with the object's frame drawn over it; returns a new picture of the same size.

    A yellow ring of radius 1 lies in the object's horizontal plane, its near half thick; arrows are the object's x (its
    left, red), y (up, green) and z (front, blue), 0.6 units long. Two pictures in which the object stands alike to its
    arrows agree.
    """
    factor = _SUPERSAMPLE
    canvas = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
    thick = max(2, round(min(canvas.shape[:2]) / 130))

    def pixels(points: np.ndarray) -> np.ndarray:
        camera = points @ object_to_camera[:3, :3].T + object_to_camera[:3, 3]
        camera[:, 2] = np.maximum(camera[:, 2], 1e-2)
        flat = camera @ intrinsics.T
        return np.clip(flat[:, :2] / flat[:, 2:] * factor, -1e4, 1e4).astype(np.int32)

    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], 1)
    depth = ring @ object_to_camera[2, :3]
    place = pixels(ring)
    for i in range(48):
        near = depth[i] + depth[i + 1] < 0
        cv2.line(canvas, place[i], place[i + 1], _RING, thick if near else 1, cv2.LINE_AA)
    order = sorted(_AXES, key=lambda axis: -float(np.dot(object_to_camera[2, :3], axis[0])))  # far ones first
    for direction, colour in order:
        ends = pixels(np.array([[0.0, 0, 0], 0.6 * np.array(direction)]))
        cv2.arrowedLine(canvas, ends[0], ends[1], colour, thick, cv2.LINE_AA, tipLength=0.25)
    return cv2.resize(canvas, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_AREA)


def draw_surface(
    image: np.ndarray, intrinsics: np.ndarray, object_to_camera: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """One frame (H, W, 3) uint8 with a canonical surface drawn over it in the pose; a new picture of the same size.

    `vertices` (V, 3) in object space, `faces` (F, 3). The front is blue, the back grey, the object's left reddish, so
    that a reversed or mirrored pose is seen at a glance.
    """
    camera = vertices @ object_to_camera[:3, :3].T + object_to_camera[:3, 3]
    if (camera[:, 2] < 1e-2).any():
        return image.copy()
    flat = camera @ intrinsics.T
    corners = (flat[:, :2] / flat[:, 2:])[faces]
    normal = np.cross(camera[faces[:, 1]] - camera[faces[:, 0]], camera[faces[:, 2]] - camera[faces[:, 0]])
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
    shade = 0.35 + 0.65 * np.abs(normal[:, 2]) / length
    middle = vertices[faces].mean(axis=1)
    ahead = 1 / (1 + np.exp(-6 * middle[:, 2] / np.abs(vertices[:, 2]).max()))
    aside = np.clip(middle[:, 0] / np.abs(vertices[:, 0]).max() * 2, -1, 1)
    colour = np.stack([150 + 80 * aside - 70 * ahead, 150 - 40 * ahead - 30 * np.abs(aside), 120 + 135 * ahead], 1)
    drawn = image.copy()
    shift = 4  # corners to a sixteenth of a pixel
    fixed = np.clip(np.round((corners - 0.5) * (1 << shift)), -(1 << 24), 1 << 24).astype(np.int32)
    for k in np.argsort(-camera[faces].mean(axis=1)[:, 2]):
        cv2.fillConvexPoly(drawn, fixed[k], [float(c) for c in colour[k] * shade[k]], cv2.LINE_8, shift)
    return np.asarray(cv2.addWeighted(image, 0.4, drawn, 0.6, 0))


def pose_sheet(rows: list[tuple[str, list[np.ndarray], np.ndarray]], height: int = 150, columns: int = 9) -> np.ndarray:
    """One row of drawn frames a clip, RGB uint8.

    Args:
        rows: a clip's title, its drawn frames (H, W, 3), and their confidence (T,), shown as a bar from red to green.
        height: of a frame in the sheet, pixels.
        columns: most frames a row, evenly spread.
    """
    lines = []
    for title, frames, confidence in rows:
        pick = np.unique(np.round(np.linspace(0, len(frames) - 1, min(columns, len(frames)))).astype(int))
        tiles = []
        for i in pick:
            frame = frames[i]
            width = max(1, round(frame.shape[1] * height / frame.shape[0]))
            tile = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
            level = float(np.clip(confidence[i], 0, 1))
            colour = (int(255 * (1 - level)), int(200 * level), 40)
            cv2.rectangle(tile, (0, height - 5), (max(1, round(width * level)), height - 1), colour, -1)
            tiles.append(tile)
        line = np.concatenate(tiles, 1)
        banner = np.full((18, line.shape[1], 3), 24, np.uint8)
        cv2.putText(banner, title, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
        lines.append(np.concatenate([banner, line]))
    widest = max(line.shape[1] for line in lines)
    return np.concatenate([np.pad(line, ((0, 0), (0, widest - line.shape[1]), (0, 0))) for line in lines])
