"""What the export measures on the frames: how well the posed mesh fills the masks, and the colour of its texture."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline import Run
from stages.export_files import ExportedVideo, Texture
from stages.geometry.raster import rasterise, vertex_normals
from stages.meshing import atlas, pictures, quality
from stages.meshing.rig import Animatable, PosedClip, Rig, field_colour

_QUALITY_SIDE_PX = 256
_BAKED_FRAMES = 120  # of all videos together
_CANDIDATES = 2  # frames looked at for each one baked: the sharpest of them is taken


def bake(
    model: Animatable, rig: Rig, inputs: list[ExportedVideo], clips: list[PosedClip], most_px: int, run: Run
) -> Texture:
    """Colour the texture from the sharpest of frames spread over all videos; its side is `most_px` at most."""
    areas = [float(np.quantile(v.facts.area, 0.9)) * v.clip.width * v.clip.height for v in inputs]
    size_px = atlas.fitting_side_px(max(areas), most_px)
    charts = atlas.unwrap(rig.mesh, size_px)
    texels = atlas.texels_of(charts, size_px)
    points = texels.spread(rig.mesh.faces, rig.mesh.vertices)
    baker = atlas.Baker(rig.mesh, texels, field_colour(model, points, len(inputs)))
    per_video = max(1, _BAKED_FRAMES // len(inputs))
    for video, posed in zip(inputs, clips, strict=True):
        usable = [i for i in range(len(video.clip)) if "missing" not in video.facts.flags[i]]
        sharp: list[float] = []
        groups = np.array_split(usable, min(per_video, max(len(usable), 1)))
        chosen = [_sharpest(video, group, sharp) for group in groups if len(group)]
        usual = float(np.median(sharp)) if sharp else 1.0
        for i, sharpness in run.progress(zip(chosen, sharp, strict=True), len(chosen), "texture"):
            pose = posed.camera_from_object[video.clip.source_idx[i]]
            points = posed.vertices[video.clip.source_idx[i]] @ pose[:3, :3].T + pose[:3, 3]
            width, height = video.clip.width, video.clip.height
            fragments = rasterise(points, rig.mesh.faces, posed.intrinsics, height, width)
            mask = video.mask(i, width, height)
            trust = float(np.clip(sharpness / max(usual, 1e-9), 0.1, 2.0))
            slack = 0.01 * rig.mesh.length
            baker.add(points, posed.intrinsics, fragments, video.clip.image(i), mask, slack, trust)
        baker.end_clip()
    picture, from_frames = baker.picture()
    return Texture(charts, picture, from_frames)


def _sharpest(video: ExportedVideo, group: np.ndarray, sharp: list[float]) -> int:
    """The frame of a group with the most detail on the object; its sharpness is added to `sharp`."""
    looked_at = group[np.unique(np.linspace(0, len(group) - 1, min(_CANDIDATES, len(group))).round().astype(int))]
    best, most = int(looked_at[0]), -1.0
    for i in looked_at.tolist():
        image = video.clip.image(i)
        mask = video.mask(i, video.clip.width, video.clip.height)
        inner = cv2.erode(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        detail = np.abs(cv2.Laplacian(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_32F))
        found = float(detail[inner].mean()) if inner.any() else 0.0
        if found > most:
            best, most = i, found
    sharp.append(most)
    return best


def measure(video: ExportedVideo, rig: Rig, posed: PosedClip, views: np.ndarray, run: Run) -> quality.ClipQuality:
    """Compare the posed mesh with every kept frame's mask; counts in `views` which vertices were seen."""
    clip = video.clip
    side = min(_QUALITY_SIDE_PX, max(clip.width, clip.height))
    width, height, _ = pictures.scaled_size(clip.width, clip.height, side)
    intrinsics = pictures.scaled_intrinsics(posed.intrinsics, clip.width, clip.height, width, height)
    slack = 0.02 * rig.mesh.length
    iou, missing, extra = np.full((3, len(clip)), np.nan)
    area = np.zeros(len(clip))
    for i, source in enumerate(run.progress(clip.source_idx, label=f"quality {video.name}")):
        if "missing" in video.facts.flags[i]:
            continue
        pose = posed.camera_from_object[source]
        points = posed.vertices[source] @ pose[:3, :3].T + pose[:3, 3]
        fragments = rasterise(points, rig.mesh.faces, intrinsics, height, width)
        mask = video.mask(i, width, height)
        if not mask.any():
            continue
        area[i] = float(mask.sum())
        iou[i] = quality.mask_iou(fragments.covered, mask)
        missing[i], extra[i] = quality.mask_misfit(fragments.covered, mask)
        normals = vertex_normals(points, rig.mesh.faces)
        views += quality.visible_vertices(points, normals, intrinsics, fragments, mask, slack)
    return quality.ClipQuality(
        video.name,
        clip.source_idx,
        iou,
        missing,
        extra,
        video.root_confidence,
        video.facts.confidence,
        video.facts.flags,
        len(clip.source_time_s),
        posed.skinning_error[8],
        posed.skinning_error[4],
        area,
    )
