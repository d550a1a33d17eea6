"""A sheet that shows a fitted model beside its clips: frame, rendered colour, silhouette, normals, bones.

``python -m benchmarks.sheets --model WORKSPACE/latest/refine --videos DATA/fox/clean/videos --out sheet.png``

One row a clip, at a moment that moves on from row to row. The model's folder holds ``model.safetensors`` and
``model.json``; clips are matched to it by name.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import av
import numpy as np
import torch
import tyro

from stages import formats
from stages.fitting.surface import sample_volume
from stages.geometry.cameras import project, transform
from stages.geometry.raster import rasterise, vertex_normals
from stages.model.banmo import Banmo

log = logging.getLogger(__name__)


def frame_at(video: Path, time_s: float) -> np.ndarray:
    """The picture (H, W, 3) shown at `time_s`."""
    with av.open(str(video)) as container:
        picture = None
        for frame in container.decode(video=0):
            picture = frame
            if frame.time is not None and frame.time >= time_s - 1e-3:
                break
        if picture is None:
            raise ValueError(f"{video} has no pictures")
        return np.asarray(picture.to_ndarray(format="rgb24"))


def draw_bones(image: np.ndarray, joints: np.ndarray, parents: np.ndarray) -> None:
    """Draw the tree of bones: lines to the parents, a dot at each, joints (B, 2) in pixels of `image`."""
    import cv2

    for bone, parent in enumerate(parents):
        a, b = (tuple(int(v * 16) for v in joints[k]) for k in (bone, parent))
        cv2.line(image, a, b, (40, 90, 200), 1, cv2.LINE_AA, 4)
    for joint in joints:
        cv2.circle(image, tuple(int(v * 16) for v in joint), 32, (200, 40, 40), -1, cv2.LINE_AA, 4)


def row(
    model: Banmo, points: torch.Tensor, faces: np.ndarray, video: int, time_s: float, frame: np.ndarray
) -> np.ndarray:
    """Frame, colour, silhouette, normals, bones of one moment, side by side, cropped to the object (H, 5 W, 3)."""
    moment = torch.tensor([time_s], dtype=torch.float64)
    pose = model.root_poses(video, moment)[0]
    camera = transform(pose, model.forward_warp(points, video, moment)[0]).numpy()
    k = model.intrinsics(video)
    height, width = frame.shape[:2]
    seen = rasterise(camera, faces, k.numpy(), height, width, cull_back=False)
    hit = seen.face_idx >= 0
    corners, weight = faces[seen.face_idx[hit]], seen.barycentric[hit][..., None]
    normal = (vertex_normals(camera, faces)[corners] * weight).sum(1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-9
    at = float(model.normalised_time(video, moment)[0])
    colour = (model.colour(points, video, at).numpy()[corners] * weight).sum(1)
    pictures = [frame.copy()]
    for value in (colour * 255, np.array([60.0, 60, 60]), (0.5 - 0.5 * normal) * 255):
        picture = np.full(frame.shape, 255, np.uint8)
        picture[hit] = np.clip(value, 0, 255).astype(np.uint8)
        pictures.append(picture)
    bones = model.bone_transforms(video, moment)[0]
    centres = (bones[:, :3, :3] @ model.bone_centres[..., None])[..., 0] + bones[:, :3, 3]
    faint = (0.35 * frame + 0.65 * 255).astype(np.uint8)
    draw_bones(faint, project(k, transform(pose, centres)).numpy(), model.bone_parents.numpy())
    pictures.append(faint)
    rows, columns = np.nonzero(hit)
    half = 0.62 * max(int(np.ptp(rows)), int(np.ptp(columns)), 16)
    middle = np.array([(rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2])
    top, left = np.clip(middle - half, 0, None).astype(int)
    bottom, right = np.minimum(middle + half, (height, width)).astype(int)
    return np.concatenate([p[top:bottom, left:right] for p in pictures], 1)


def sheet(model: Banmo, videos: list[Path], width_px: int = 640) -> np.ndarray:
    """One row a clip; RGB uint8."""
    from skimage.measure import marching_cubes
    from skimage.transform import resize

    volume, low, spacing = sample_volume(model, 128)
    vertices, faces, _, _ = marching_cubes(volume, 0.0, spacing=tuple(float(s) for s in spacing))
    points = torch.from_numpy(vertices.astype(np.float32)) + low
    rows = []
    for v, path in enumerate(videos):
        times = model.videos[v].time_s
        time_s = times[round((0.1 + 0.8 * v / max(1, len(videos) - 1)) * (len(times) - 1))]
        wide = row(model, points, faces, v, time_s, frame_at(path, time_s))
        size = (round(wide.shape[0] * width_px / wide.shape[1]), width_px)
        rows.append(np.round(resize(wide / 255, size, order=1, anti_aliasing=True) * 255).astype(np.uint8))
    return np.concatenate(rows)


def main(model: Path, videos: Path, out: Path) -> None:
    """Draw the sheet.

    Args:
        model: Folder of a fit, correct or refine result.
        videos: Folder of the clips that it was made from.
        out: The picture to write.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    known = Banmo.restore(*formats.read_model(model))
    paths = [videos / f"{name}.mp4" for name in known.video_names]
    missing = [p for p in paths if not p.is_file()]
    if missing:
        log.error("no clip %s", missing[0])
        sys.exit(2)
    formats.write_image(out, sheet(known, paths))
    log.info("%s: %d clips", out, len(paths))


if __name__ == "__main__":
    tyro.cli(main)
