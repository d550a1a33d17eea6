"""How good is the texture? The GLB seen from the videos' own cameras, against their frames.

``python -m benchmarks.texture --workspace WORKSPACE [--exports DIR] [--frames 8] [--sheet look.png]``

Over the pixels that the mask and the posed surface both cover: PSNR of the textured GLB, of its vertex colours, and of
the model's colour field on the same surface, in the light of each frame's own video. The texture is one for all
videos and must come within 1 dB of the field; exit 1 if it does not.
"""

from __future__ import annotations

import logging
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
import tyro

from pipeline import Results
from stages import formats
from stages.geometry.raster import rasterise
from stages.meshing.atlas import sample
from stages.model.banmo import Banmo

log = logging.getLogger(__name__)

MOST_LOSS_DB = 1.0


@dataclass
class Errors:
    """Squared errors of one way to colour the surface, in 0..1: sums and counts of each frame."""

    total: list[float] = field(default_factory=list)
    count: list[int] = field(default_factory=list)

    def add(self, drawn: np.ndarray, shown: np.ndarray) -> None:
        """Colours (P, 3) drawn and shown, in 0..1."""
        self.total.append(float(((np.clip(drawn, 0, 1) - shown) ** 2).sum()))
        self.count.append(drawn.size)

    @property
    def psnr_db(self) -> float:
        """Over all pixels of all frames."""
        return float(-10 * np.log10(max(sum(self.total) / max(sum(self.count), 1), 1e-12)))


@dataclass(frozen=True)
class Textured:
    """What the GLB holds: vertices (V, 3) at rest, faces (F, 3), uv (V, 2) v downward, picture, colours (V, 3) sRGB."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    picture: np.ndarray
    colour: np.ndarray


def read_textured(exports: Path) -> Textured:
    """The surface of ``model.glb`` with its texture, and the vertex colours of ``rest.ply`` at the same places."""
    mesh: Any = trimesh.load(exports / "model.glb", process=False, force="mesh")
    rest: Any = trimesh.load(exports / "rest.ply", process=False)
    picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    uv = np.asarray(mesh.visual.uv) * [1, -1] + [0, 1]  # trimesh turns v upward
    _, nearest = trimesh.proximity.cKDTree(np.asarray(rest.vertices)).query(np.asarray(mesh.vertices))
    colour = np.asarray(rest.visual.vertex_colors)[nearest, :3] / 255
    return Textured(np.asarray(mesh.vertices), np.asarray(mesh.faces), uv, picture, colour)


def measure(results: Results, exports: Path, per_video: int) -> tuple[dict[str, Errors], list[np.ndarray]]:
    """Errors of ``texture``, ``vertex colours`` and ``field``; and a row of pictures a video, to look at."""
    model = Banmo.restore(*formats.read_model(results.folder("refine").path))
    glb = read_textured(exports)
    points = torch.from_numpy(glb.vertices.astype(np.float32))
    errors = {name: Errors() for name in ("texture", "vertex colours", "field")}
    rows = []
    for k, name in enumerate(model.video_names):
        clip = formats.read_clip(results.folder("frames", name).path)
        masks = results.folder("masks", name)
        track = formats.read_poses(exports / "cameras" / f"{name}.json")
        chosen = np.unique(np.linspace(0, len(clip) - 1, per_video + 2).round().astype(int))[1:-1]
        posed = model.forward_warp(points, k, torch.from_numpy(clip.time_s[chosen])).double().numpy()
        for i, vertices in zip(chosen.tolist(), posed, strict=True):
            pose = track.object_to_camera[clip.source_idx[i]]
            camera = vertices @ pose[:3, :3].T + pose[:3, 3]
            seen = rasterise(camera, glb.faces, track.intrinsics, clip.height, clip.width)
            mask = formats.read_grey(masks / clip.names[i]) > 127
            pixels = np.flatnonzero(seen.covered & mask)
            if not len(pixels):
                continue
            image = clip.image(i)
            shown = image.reshape(-1, 3)[pixels] / 255
            spots = torch.from_numpy(seen.at_pixels(pixels, glb.faces, glb.vertices))
            moment = float(model.normalised_time(k, torch.tensor([clip.time_s[i]]))[0])
            drawn = {
                "texture": sample(glb.picture, seen.at_pixels(pixels, glb.faces, glb.uv)),
                "vertex colours": seen.at_pixels(pixels, glb.faces, glb.colour),
                "field": model.colour(spots, k, moment).numpy(),
            }
            for way, colours in drawn.items():
                errors[way].add(colours, shown)
            if i == chosen[len(chosen) // 2]:
                rows.append(_row(image, mask, pixels, [drawn["texture"], drawn["vertex colours"], drawn["field"]]))
    return errors, rows


def _row(image: np.ndarray, mask: np.ndarray, pixels: np.ndarray, colours: list[np.ndarray]) -> np.ndarray:
    """Frame, texture, vertex colours, field, cut to the object, 300 px high."""
    rows, columns = np.nonzero(mask)
    part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    tiles = [image[part]]
    for colour in colours:
        tile = np.full_like(image, 235)
        tile.reshape(-1, 3)[pixels] = np.round(np.clip(colour, 0, 1) * 255)
        tiles.append(tile[part])
    scale = 300 / tiles[0].shape[0]
    width = max(1, round(tiles[0].shape[1] * scale))
    return np.concatenate([cv2.resize(t, (width, 300), interpolation=cv2.INTER_CUBIC) for t in tiles], axis=1)


def main(
    workspace: Path = Path("workspace"), exports: Path | None = None, frames: int = 8, sheet: Path | None = None
) -> None:
    """Compare the texture of a GLB with the frames it was made from.

    Args:
        workspace: A finished workspace.
        exports: Folder with model.glb, rest.ply and cameras/; default: the workspace's export.
        frames: Frames of each video to compare with.
        sheet: Write pictures here: frame, texture, vertex colours, field.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    results = Results(workspace)
    errors, rows = measure(results, exports or results.folder("export").path, frames)
    for way, found in errors.items():
        log.info("%-15s %.2f dB over %d frames", way, found.psnr_db, len(found.count))
    if sheet is not None:
        width = max(row.shape[1] for row in rows)
        padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
        formats.write_image(sheet, np.concatenate(padded))
    loss = errors["field"].psnr_db - errors["texture"].psnr_db
    if loss > MOST_LOSS_DB:
        log.error("the texture is %.2f dB below the colour field", loss)
        sys.exit(1)


if __name__ == "__main__":
    tyro.cli(main)
