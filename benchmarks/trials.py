"""What the accuracy benchmarks share: an evaluation data set as observations, the three phases in one process, scores.

No workspace is involved: clips, true masks and root poses are read straight from the data set, flow is computed as
the `flow` stage does, and features are left out. Scores come from an evaluation script given by its path.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.fitting import initialise
from stages.fitting.gauge import settle
from stages.fitting.observations import ObservationBuilder, Observations
from stages.fitting.surface import sample_volume
from stages.fitting.trainer import Trainer
from stages.geometry.rotations import rigid, so3_exp
from stages.model.banmo import Architecture, Banmo, VideoFacts
from stages.optimise import CorrectSettings, FitSettings, RefineSettings

HULL_VOXEL = 0.032
ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Seen:
    """Everything an optimisation reads."""

    observations: Observations
    poses: Tensor  # (T, 4, 4) camera_from_object
    intrinsics: Tensor  # (T, 3, 3)
    videos: list[VideoFacts]


@dataclass(frozen=True)
class Score:
    """What the evaluation script says of all frames; distances in cm, F-scores in percent."""

    chamfer: float
    to_truth: float
    from_truth: float
    f1: float
    f2: float
    f5: float


def observe(data: Path, look: str = "clean", clips: int = 5, steps: tuple[int, ...] = (1, 4)) -> Seen:
    """Read the first `clips` clips of one object of the data set."""
    import cv2

    from stages.perception.optical_flow import Matcher, confidence
    from stages.video_io import read_pictures

    matcher, signed = Matcher("medium"), tuple(s * sign for s in steps for sign in (1, -1))
    builder = ObservationBuilder(steps=signed)
    poses, intrinsics, videos = [], [], []
    for v, path in enumerate(sorted((data / look / "videos").glob("*.mp4"))[:clips]):
        truth = json.loads((data / look / "gt" / f"{path.stem}.json").read_text(encoding="utf-8"))
        packed = np.load(data / look / "gt" / f"{path.stem}-mask.npz")
        shape = tuple(packed["shape"])
        masks = np.unpackbits(packed["packed"])[: np.prod(shape)].reshape(shape)
        images = read_pictures(path, len(masks))
        grey = [cv2.cvtColor(i, cv2.COLOR_RGB2GRAY) for i in images]
        flows: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        for s in steps:
            for i in range(len(images) - s):
                forward, backward = matcher(grey[i], grey[i + s]), matcher(grey[i + s], grey[i])
                flows[i, s] = forward, confidence(forward, backward)
                flows[i + s, -s] = backward, confidence(backward, forward)
        for i, image in enumerate(images):
            mine = {s: flows[i, s] for s in signed if (i, s) in flows}
            builder.add(v, image, (masks[i] * 255).astype(np.uint8), mine, 1.0)
        k = np.array(truth["K"])
        poses.append(np.array(truth["object_to_camera"])[: len(images)])
        intrinsics += [k] * len(images)
        times = tuple(float(t) for t in np.arange(len(images)) / 20)
        height, width = images[0].shape[:2]
        focal, centre = (float(k[0, 0]), float(k[1, 1])), (float(k[0, 2]), float(k[1, 2]))
        videos.append(VideoFacts(path.stem, times, width, height, focal, centre))
    return Seen(
        builder.finish(),
        torch.from_numpy(np.concatenate(poses)).float(),
        torch.from_numpy(np.stack(intrinsics)).float(),
        videos,
    )


def shaken(poses: Tensor, degrees: float, seed: int) -> Tensor:
    """Root poses (T, 4, 4) each turned about the object's centre by `degrees`, about an axis drawn evenly."""
    generator = torch.Generator().manual_seed(seed)
    axis = torch.nn.functional.normalize(torch.randn(len(poses), 3, generator=generator), dim=-1)
    turn = so3_exp(axis * float(np.deg2rad(degrees)))
    return rigid(poses[:, :3, :3] @ turn, poses[:, :3, 3])


def reconstruct(
    seen: Seen, fit: FitSettings, correct: CorrectSettings, refine: RefineSettings, hold_roots: bool = True
) -> tuple[Banmo, float]:
    """The three phases one after the other; returns the model and the processor seconds that optimisation took."""
    normal = initialise.normalise(seen.observations, seen.poses, seen.intrinsics)
    room = None
    if fit.start == "sphere":
        generator = torch.Generator().manual_seed(fit.seed)
        solid = torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator), dim=-1)
        solid = solid * 0.5 * torch.rand(4000, 1, generator=generator) ** (1 / 3)
    else:
        poses, k = normal.camera_from_canonical, seen.intrinsics
        hull = initialise.rigid_hull(seen.observations, poses, k, HULL_VOXEL)
        solid, room = hull.nodes[hull.solid], initialise.swept(hull, fit.bones_share)
    architecture = Architecture(
        representation=fit.representation,
        voxel=fit.voxel,
        mlp_depth=fit.mlp_depth,
        mlp_width=fit.mlp_width,
        pose_code=fit.pose_code,
        octaves=initialise.octaves(seen.videos, fit.motion_period_s),
        splines=initialise.splines(seen.videos, fit.motion_spacing_s),
        blending=fit.blending,
        deformation=fit.deformation,
    )
    model = initialise.build(
        architecture,
        seen.videos,
        normal.camera_from_canonical,
        solid,
        HULL_VOXEL,
        fit.bones,
        fit.seed,
        fit.margin,
        room,
    )
    if hold_roots:
        model.root_free.zero_()
    start = time.process_time()
    for settings in (fit, correct, refine):
        if settings.iterations == 0:
            continue
        trainer = Trainer(model, seen.observations, settings)
        while not trainer.done:
            trainer.step()
        model = trainer.model
        if settings is fit and fit.settle_root and not hold_roots and model.dense is None:
            settle(model)
    return model, time.process_time() - start


def write_meshes(model: Banmo, out: Path, every: int = 5, resolution: int = 128) -> None:
    """The posed surface of every few frames, as the evaluation script reads it: ``out/<video>/00042.ply``."""
    import trimesh
    from skimage.measure import marching_cubes

    volume, low, spacing = sample_volume(model, resolution)
    vertices, faces, _, _ = marching_cubes(volume, 0.0, spacing=tuple(float(s) for s in spacing))
    whole = trimesh.Trimesh(vertices + low.numpy(), faces, process=False)
    body = max(whole.split(only_watertight=False), key=lambda part: len(part.faces))
    points = torch.from_numpy(np.asarray(body.vertices)).float()
    for v, video in enumerate(model.videos):
        folder = out / video.name
        folder.mkdir(parents=True, exist_ok=True)
        for i in range(0, len(video.time_s), every):
            moment = torch.tensor([video.time_s[i]], dtype=torch.float64)
            posed = model.forward_warp(points, v, moment)[0].numpy()
            trimesh.Trimesh(posed, body.faces, process=False).export(folder / f"{i:05d}.ply")


def judge(evaluate: Path, data: Path, meshes: Path, every: int = 5, clips: int = 5) -> Score:
    """What the evaluation script says of `meshes`; raises RuntimeError with its words if it fails.

    With fewer than all clips it is the mean over those clips, as a clip that is missing would count as zero.
    """
    folders = sorted(p for p in meshes.iterdir() if p.is_dir())
    asked: list[list[str]] = [["--pred", str(meshes)]]
    if clips < 5:
        asked = [["--pred", str(folder), "--video", folder.name] for folder in folders[:clips]]
    rows = []
    for more in asked:
        command = [sys.executable, str(evaluate), "mesh", "--gt", str(data / "gt" / "meshes.npz")]
        done = subprocess.run([*command, "--every", str(every), *more], capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr.strip() or done.stdout.strip())
        rows.append(read_score(done.stdout))
    return Score(*(float(np.mean([getattr(r, f) for r in rows])) for f in Score.__dataclass_fields__))


def read_score(text: str) -> Score:
    """The row of all frames in what ``evaluate.py mesh`` prints."""
    rows = [line for line in text.splitlines() if re.match(r"^\s*(ALL|all)\b", line)]
    if not rows:
        raise RuntimeError(f"no row for all frames in: {text[:300]}")
    return Score(*[float(x) for x in re.findall(r"-?\d+\.\d+", rows[-1])][:6])


Phases = tuple[FitSettings, CorrectSettings, RefineSettings]


def presets(name: str, scale: float = 1.0, seed: int = 0) -> Phases:
    """The settings of a preset, its steps multiplied by `scale`."""
    table: dict[str, Any] = tomllib.loads((ROOT / "stages" / "presets.toml").read_text(encoding="utf-8"))[name]

    def of(kind: type, section: str) -> Any:
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in table.get(section, {}).items()}
        settings = kind(**{**values, "seed": seed})
        return replace(settings, iterations=max(1, round(settings.iterations * scale)))

    return of(FitSettings, "fit"), of(CorrectSettings, "correct"), of(RefineSettings, "refine")
