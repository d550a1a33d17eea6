"""What the accuracy benchmarks share: a workspace's clips as observations, the three phases in one process, scores.

Frames, masks, flow, features and root poses are what the product's own stages made of them; the phases start and end
as theirs do. Scores come from an evaluation script given by its path.
"""

from __future__ import annotations

import logging
import os
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

from pipeline import BadInput, Results, Run
from stages.collect import Collection, collect
from stages.fitting import initialise
from stages.fitting.gauge import settle
from stages.fitting.observations import Observations
from stages.fitting.surface import sample_volume
from stages.fitting.trainer import Trainer
from stages.geometry.rotations import rigid, so3_exp
from stages.model.banmo import Banmo, VideoFacts
from stages.optimise import CorrectSettings, FitSettings, RefineSettings, _first
from stages.registration.steadying import steady

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


def observe(workspace: Path, clips: int = 5, steps: tuple[int, ...] = FitSettings.flow_steps) -> Seen:
    """Read the first `clips` clips of a workspace whose stages up to `poses` have run.

    Raises BadInput when one of them has not, or when frames of a clip were left out.
    """
    results = Results(workspace)
    names = results.videos[:clips]
    frames, masks, flow, features = (
        {name: results.folder(stage, name) for name in names} for stage in ("frames", "masks", "flow", "features")
    )
    found = collect(frames, masks, flow, features, results.folder("poses"), steps, _quiet())
    for name, clip in found.clips.items():
        if len(clip) != len(clip.source_time_s):  # meshes are written, and scored, by the number of the frame
            raise BadInput(f"{name}: {len(clip)} of {len(clip.source_time_s)} frames were kept, all are scored")
    return Seen(found.observations, found.camera_from_object, found.intrinsics, found.videos)


def _quiet() -> Run:
    """A run that only warns: what a stage would log has no place between the rows of a table."""
    log = logging.getLogger(f"{__name__}.stage")
    log.setLevel(logging.WARNING)
    return Run(log=log)


def shaken(poses: Tensor, degrees: float, seed: int) -> Tensor:
    """Root poses (T, 4, 4) each turned about the object's centre by `degrees`, about an axis drawn evenly."""
    generator = torch.Generator().manual_seed(seed)
    axis = torch.nn.functional.normalize(torch.randn(len(poses), 3, generator=generator), dim=-1)
    turn = so3_exp(axis * float(np.deg2rad(degrees)))
    return rigid(poses[:, :3, :3] @ turn, poses[:, :3, 3])


def steadied(seen: Seen) -> Seen:
    """The same with root poses that have lost their jitter, as in the `poses` stage with ``poses.refine = true``."""
    tracks = [track.double().numpy() for track in seen.poses.split([len(video.time_s) for video in seen.videos])]
    made = steady(tracks, [np.array(video.time_s) for video in seen.videos]).tracks
    return replace(seen, poses=torch.from_numpy(np.concatenate(made)).float())


def reconstruct(
    seen: Seen, fit: FitSettings, correct: CorrectSettings, refine: RefineSettings, hold_roots: bool = True
) -> tuple[Banmo, float]:
    """The three phases one after the other; returns the model and the processor seconds that optimisation took.

    The first model, and what becomes of a model between phases, are the product's.
    """
    held = torch.full((len(seen.videos),), float(hold_roots))
    collection = Collection(seen.observations, seen.poses, seen.intrinsics, seen.videos, held, [], {})
    model = _first(collection, initialise.normalise(seen.observations, seen.poses, seen.intrinsics), fit, _quiet())
    start = time.process_time()
    for settings in (fit, correct, refine):
        if settings.iterations == 0:
            continue
        trainer = Trainer(model, seen.observations, settings)
        while not trainer.done:
            trainer.step()
        model = trainer.model
        if settings is fit and fit.settle_root and model.dense is None:
            settle(model)
        model = Banmo.restore(model.state_dict(), model.describe())
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
        command += ["--every", str(every), *more]
        # its linear algebra would take every core otherwise
        alone = {**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=alone)
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
