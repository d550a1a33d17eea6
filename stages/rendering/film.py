"""Taking the pictures of a shot of a rigged GLB."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from stages.animating.glb import Animation, Glb
from stages.animating.playing import CV_FROM_GL, Player
from stages.rendering.drawing import Surface, draw
from stages.rendering.paths import Shot, circle, fitting_distance, pinhole


def surface_of(player: Player) -> Surface:
    """What of a file is drawn: its texture where it has one that can be read, else its vertex colours."""
    uv, picture = player.glb.attribute("TEXCOORD_0"), player.glb.picture()
    texture = None
    if uv is not None and picture is not None:
        image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
        if image is not None and image.shape[0] == image.shape[1]:
            texture = np.ascontiguousarray(image[:, :, ::-1])
    coordinates = None if texture is None or uv is None else uv.astype(np.float64)
    return Surface(player.faces, player.colour, player.vertices, texture, coordinates)


def extent(player: Player, animation: Animation | None, samples: int = 12) -> np.ndarray:
    """Points (N, 3), object space, that the surface reaches at rest or in an animation."""
    times = np.zeros(1) if animation is None else np.linspace(0, float(animation.time_s[-1]), samples)
    return player.surface(player.scene(animation, times, root_motion=False)).reshape(-1, 3)


def turntable(
    points: np.ndarray,
    size: tuple[int, int],
    seconds: float,
    fps: float,
    elevation_deg: float,
    turns: float,
    moment_s: float | None,
    length_s: float,
    start_deg: float = 35.0,
) -> Shot:
    """Cameras round the object while a clip of `length_s` plays on, over and over, or stands still at `moment_s`."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    count = max(1, round(seconds * fps))
    intrinsics = pinhole(size[1], size[0], 28.0)
    poses = circle(centre, fitting_distance(points, centre, intrinsics), elevation_deg, turns, start_deg, count)
    at = np.arange(count) / fps
    shown = np.full(count, moment_s) if moment_s is not None else at % max(length_s, 1e-9)
    return Shot(poses, shown, np.repeat(intrinsics[None], count, axis=0), at)


def as_filmed(glb: Glb, animation: Animation, size: tuple[int, int] | None) -> tuple[Shot, tuple[int, int]]:
    """Through the clip's own camera, at its own times; the picture's size (height, width) is the clip's unless given.

    The object carries the motion, so the cameras stand still at the origin. Raises KeyError where the file has no
    camera of that clip.
    """
    record = next(c for c in glb.document.get("cameras", []) if c.get("name") == f"camera_{animation.name}")
    facts = record["extras"]
    height, width = int(facts["height_px"]), int(facts["width_px"])
    shape = size or (height, width)
    k = np.diag([shape[1] / width, shape[0] / height, 1.0]) @ np.array(facts["K"], np.float64)
    times = animation.time_s
    poses, ks = (np.repeat(m[None], len(times), axis=0) for m in (np.eye(4), k))
    return Shot(poses, times, ks, times - times[0]), shape


def pictures(
    player: Player,
    animation: Animation | None,
    shot: Shot,
    size: tuple[int, int],
    kinds: list[str],
    background: np.ndarray,
    filmed: bool = False,
) -> Iterator[list[np.ndarray]]:
    """For each camera of the shot one picture (H, W, 4) uint8 a kind. `filmed`: the root motion carries the object."""
    surface = surface_of(player)
    turn = CV_FROM_GL[:3, :3]
    for pose, moment, k in zip(shot.camera_from_object, shot.time_s, shot.intrinsics, strict=True):
        scene = player.scene(animation, np.array([moment]), root_motion=filmed)
        vertices = player.surface(scene)[0]
        camera = vertices @ turn if filmed else vertices @ pose[:3, :3].T + pose[:3, 3]
        camera[:, 2] = np.where(np.abs(camera[:, 2]) < 1e-6, 1e-6, camera[:, 2])
        middle = float(np.median(camera[:, 2]))
        reach = float(np.linalg.norm(surface.rest.max(axis=0) - surface.rest.min(axis=0))) / 2
        yield [draw(surface, camera, k, size, kind, background, (middle - reach, middle + reach)) for kind in kinds]
