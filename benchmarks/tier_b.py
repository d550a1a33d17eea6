"""Root poses that are wrong by some degrees a frame, and what the fit makes of them.

``python -m benchmarks.tier_b --data DATA/fox --evaluate evaluate.py --degrees 20 50 [--seed 0] [--scale 1]``

True masks; each frame's root rotation is turned by the given angle about an axis drawn evenly (seeded). Prints, for
zero and each angle, the rotation error before and after (one global rotation removed) and the mesh scores.
"""

from __future__ import annotations

import logging
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from benchmarks.trials import Seen, judge, observe, presets, reconstruct, shaken, write_meshes
from stages.geometry.rotations import so3_log
from stages.registration.steadying import steady

log = logging.getLogger(__name__)


def rotation_error_deg(found: Tensor, truth: Tensor) -> tuple[float, float]:
    """Mean and standard deviation (degrees) of the angle between rotations (T, 3, 3), after one global rotation.

    The global rotation is the one that brings ``found`` nearest to ``truth`` from the right (chordal distance): which
    way canonical space is turned is free.
    """
    u, _, vt = torch.linalg.svd((found.double().transpose(1, 2) @ truth.double()).mean(0))
    flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vt).sign())], dtype=torch.float64))
    rest = (found.double() @ (u @ flip @ vt)).transpose(1, 2) @ truth.double()
    angle = so3_log(rest).norm(dim=-1).rad2deg()
    return float(angle.mean()), float(angle.std())


def steadied(seen: Seen) -> Tensor:
    """Root poses (T, 4, 4) without their jitter, clip by clip."""
    lengths = [len(video.time_s) for video in seen.videos]
    tracks = [track.double().numpy() for track in seen.poses.split(lengths)]
    made, _, _ = steady(tracks, [np.array(video.time_s) for video in seen.videos])
    return torch.from_numpy(np.concatenate(made)).float()


def main(
    data: Path, evaluate: Path, degrees: tuple[float, ...] = (20.0, 50.0), preset: str = "preview", seed: int = 0,
    scale: float = 1.0,
) -> None:  # fmt: skip
    """Reconstruct with root poses perturbed by the given angles.

    Args:
        data: Folder of one object of the evaluation data set.
        evaluate: Path of the evaluation script.
        degrees: Angles of the perturbation.
        preset: Whose settings are used.
        seed: Of perturbation and fit.
        scale: Multiplies every phase's number of steps.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(2)
    seen = observe(data)
    settings = presets(preset, scale, seed)
    log.info("| turned by | error before | after | CD cm | pred>gt | gt>pred | F@1 | F@2 | F@5 | s |")
    log.info("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for angle in (0.0, *degrees):
        wrong = replace(seen, poses=shaken(seen.poses, angle, seed))
        before = rotation_error_deg(wrong.poses[:, :3, :3], seen.poses[:, :3, :3])
        if angle:  # as the poses stage does with poses.refine = true
            wrong = replace(wrong, poses=steadied(wrong))
        model, seconds = reconstruct(wrong, *settings, hold_roots=angle == 0)
        with torch.no_grad():
            after = rotation_error_deg(
                model.frames(torch.arange(len(seen.poses))).camera_from_object[:, :3, :3], seen.poses[:, :3, :3]
            )
        with tempfile.TemporaryDirectory(prefix="tier-b-") as folder:
            write_meshes(model, Path(folder))
            s = judge(evaluate, data, Path(folder))
        log.info(
            "| %.0f deg | %.1f +- %.1f | %.1f +- %.1f | %.2f | %.2f | %.2f | %.1f | %.1f | %.1f | %.0f |",
            *(angle, *before, *after, s.chamfer, s.to_truth, s.from_truth, s.f1, s.f2, s.f5, seconds),
        )
    if not np.isfinite(s.chamfer):
        sys.exit(1)


if __name__ == "__main__":
    tyro.cli(main)
