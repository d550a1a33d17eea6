"""A closed-form stand-in for the fitted model: a chain of capsules that bends, seen by a turning camera."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from stages import formats
from stages.geometry.raster import rasterise


class Chain:
    """`bones` capsules along x, from -1 to 1, radius 0.25; each joint bends about z with its own phase."""

    radius = 0.25

    def __init__(self, video_names: list[str], bones: int = 3, focal_px: float = 110.0, size_px: int = 96) -> None:
        self.video_names = video_names
        self.count, self.focal_px, self.size_px = bones, focal_px, size_px
        self.knots = torch.linspace(-0.75, 0.75, bones + 1)
        self.bounds = torch.tensor([[-1.3, -0.6, -0.6], [1.3, 0.6, 0.6]])

    @property
    def bone_centres(self) -> Tensor:
        centres = torch.zeros(self.count, 3)
        centres[:, 0] = (self.knots[1:] + self.knots[:-1]) / 2
        return centres

    @property
    def bone_parents(self) -> Tensor | None:
        return None

    @property
    def bone_orientations(self) -> Tensor:
        angle = torch.linspace(0.1, 0.9, self.count)  # any frame will do: the rig must not care
        c, s, zero, one = angle.cos(), angle.sin(), torch.zeros(self.count), torch.ones(self.count)
        return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).view(-1, 3, 3)

    @property
    def bone_scales(self) -> Tensor:
        return torch.full((self.count, 3), 0.2)

    def sdf(self, points: Tensor) -> Tensor:
        along = points[:, 0].clamp(-0.75, 0.75)
        nearest = torch.stack([along, torch.zeros_like(along), torch.zeros_like(along)], -1)
        return (points - nearest).norm(dim=-1) - self.radius

    def colour(self, points: Tensor, video_idx: int = 0, time: float = 0.0) -> Tensor:
        return (0.5 + 0.4 * torch.sin(points * 4 + torch.tensor([0.0, 1.0, 2.0])) + 0.02 * video_idx).clamp(0, 1)

    def rest_weights(self, points: Tensor) -> Tensor:
        distance = (points[:, None, 0] - self.bone_centres[None, :, 0]) / (0.8 / self.count)
        return torch.softmax(-(distance**2), dim=-1)

    def bone_transforms(self, video_idx: int, time_s: Tensor) -> Tensor:
        transforms = [torch.eye(4, dtype=torch.float64).expand(len(time_s), 4, 4)]
        for b in range(1, self.count):
            angle = 0.5 * torch.sin(3 * time_s.double() + b + video_idx)
            bend = torch.eye(4, dtype=torch.float64).repeat(len(time_s), 1, 1)
            bend[:, 0, 0] = bend[:, 1, 1] = angle.cos()
            bend[:, 0, 1], bend[:, 1, 0] = -angle.sin(), angle.sin()
            knot = torch.tensor([float(self.knots[b]), 0, 0], dtype=torch.float64)
            bend[:, :3, 3] = knot - bend[:, :3, :3] @ knot
            transforms.append(transforms[-1] @ bend)
        return torch.stack(transforms, 1).float()

    def forward_warp(self, points: Tensor, video_idx: int, time_s: Tensor) -> Tensor:
        moved = torch.einsum("tbij,nj->tbni", self.bone_transforms(video_idx, time_s)[..., :3, :3], points)
        moved = moved + self.bone_transforms(video_idx, time_s)[:, :, None, :3, 3]
        return torch.einsum("nb,tbni->tni", self.rest_weights(points), moved)

    def root_poses(self, video_idx: int, time_s: Tensor) -> Tensor:
        angle = 0.8 * time_s.double() + 1.5 * video_idx
        poses = torch.eye(4, dtype=torch.float64).repeat(len(time_s), 1, 1)
        poses[:, 0, 0], poses[:, 0, 2] = angle.cos(), angle.sin()
        poses[:, 2, 0], poses[:, 2, 2] = -angle.sin(), angle.cos()
        poses = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)) @ poses
        poses[:, 2, 3] = 3.0
        return poses.float()

    def intrinsics(self, video_idx: int) -> Tensor:
        half = self.size_px / 2
        return torch.tensor([[self.focal_px, 0, half], [0, self.focal_px, half], [0, 0, 1.0]])


def write_inputs(
    model: Chain, root: Path, times: int = 6, dropped: tuple[int, ...] = (2,)
) -> dict[str, dict[str, Path]]:
    """The folders of the stages before, as the model itself would be filmed: {"frames": {video: path}, ...}."""
    from stages.meshing.surface import extract

    mesh = extract(model.sdf, model.bounds.numpy(), 32)
    folders: dict[str, dict[str, Path]] = {"frames": {}, "masks": {}, "features": {}}
    poses_root, refine_root = root / "poses", root / "refine"
    (refine_root / "poses").mkdir(parents=True)
    poses_root.mkdir()
    for k, name in enumerate(model.video_names):
        frames_root, masks_root, features_root = (root / kind / str(k) for kind in ("frames", "masks", "features"))
        for folder in (frames_root, masks_root, features_root):
            folder.mkdir(parents=True)
        formats.write_json(features_root / "features.json", {"category": "other"})
        time_s = np.arange(times) * 0.1 + 0.05 * k
        kept = np.array([i for i in range(times) if i not in dropped])
        clip = formats.Clip(frames_root, model.size_px, model.size_px, kept, time_s)
        formats.write_clip_info(clip, frames_root)
        seconds = torch.from_numpy(clip.time_s)
        poses = model.root_poses(k, seconds).double().numpy()
        posed = model.forward_warp(torch.from_numpy(mesh.vertices).float(), k, seconds).numpy()
        boxes = []
        for i, file in enumerate(clip.names):
            points = posed[i] @ poses[i, :3, :3].T + poses[i, :3, 3]
            covered = rasterise(points, mesh.faces, model.intrinsics(k).numpy(), model.size_px, model.size_px).covered
            formats.write_image(masks_root / file, covered.astype(np.uint8) * 255)
            image = np.full((model.size_px, model.size_px, 3), (90, 120, 90), np.uint8)
            image[covered] = (200, 150, 90)
            formats.write_image(frames_root / file, cv2.GaussianBlur(image, (3, 3), 0))
            rows, columns = np.nonzero(covered)
            boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        count = len(kept)
        facts = formats.MaskFacts("given", np.array(boxes, float), np.full(count, 0.1), np.ones(count), [[]] * count)
        formats.write_mask_facts(masks_root, facts, clip)
        track = formats.PoseTrack(model.intrinsics(k).double().numpy(), poses, np.ones(count), ["given"] * count)
        formats.write_poses(refine_root / "poses" / f"{name}.json", track, clip)
        folders["frames"][name], folders["masks"][name] = frames_root, masks_root
        folders["features"][name] = features_root
    formats.write_json(poses_root / "poses.json", {"trust": 0.9, "advice": ""})
    return folders


def rotation_y(angle: float) -> np.ndarray:
    """(3, 3) turn about y."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
