"""How fast a step of the optimiser is, against a plain version of the paper's and against its own parts.

``python -m benchmarks.optimiser [--device cuda] [--threads 2] [--steps 8] [--frames 100 1000 10000]``
``python -m benchmarks.optimiser --workspace W --data DATA/fox --evaluate evaluate.py --minutes 2 5``

Needs torch, numpy, scipy and scikit-image alone unless --data is given. The first table renders the same rays with the
same number of samples: *ours* finds the surface with a probe without gradient and spends gradients near it; *plain*
is the paper's network, 8 x 256, 32-bit, every sample with gradient. The second lets the number of frames grow. With
--data both learn one object, as a workspace has it (see ``benchmarks.ablations``), for the same processor time.
"""

from __future__ import annotations

import argparse
import logging
import math
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from stages.fitting import initialise
from stages.fitting.observations import Observations
from stages.fitting.schedule import PhaseSettings
from stages.fitting.trainer import Trainer
from stages.geometry.rotations import rigid, so3_exp
from stages.model.banmo import Architecture, Banmo, VideoFacts

if TYPE_CHECKING:  # what --data alone needs is imported where it is used
    from benchmarks.trials import Phases, Seen

log = logging.getLogger(__name__)

SIDE_PX = 128
FOCAL_PX = 150.0
RADII = (0.9, 0.4, 0.5)
FPS = 20


def synthetic(frames: int, rows: int = 1500, seed: int = 0) -> tuple[Observations, Tensor, list[VideoFacts]]:
    """An ellipsoid seen by a camera that goes round it: packed rows of `frames` frames, poses, and one clip.

    Masks have a closed form; colours and flow are noise, as only time is measured.
    """
    generator = torch.Generator().manual_seed(seed)
    angle = torch.arange(frames) * 0.05
    zero = torch.zeros(frames)
    upright = torch.diag(torch.tensor([1.0, -1, -1]))
    poses = rigid(upright @ so3_exp(torch.stack([zero, angle, zero], 1)), torch.tensor([0.0, 0, 3]).expand(frames, 3))
    xy = torch.randint(0, SIDE_PX, (frames, rows, 2), generator=generator)
    directions = torch.cat([(xy + 0.5 - SIDE_PX / 2) / FOCAL_PX, torch.ones(frames, rows, 1)], -1) @ poses[:, :3, :3]
    origins = -(poses[:, :3, :3].transpose(1, 2) @ poses[:, :3, 3:]).transpose(1, 2)
    radii = torch.tensor(RADII)
    o, d = origins / radii, directions / radii
    inside = ((d * o).sum(-1) ** 2 - (d * d).sum(-1) * ((o * o).sum(-1) - 1)) > 0
    small = torch.zeros(frames, 64, 64, dtype=torch.uint8)
    small[:, 16:48, 16:48] = 255
    steps = (1, -1)
    index = torch.arange(frames)
    partner = {s: torch.where((index + s >= 0) & (index + s < frames), index + s, -1) for s in steps}
    count = frames * rows
    observations = Observations(
        video_idx=torch.zeros(frames, dtype=torch.int64),
        frame_weight=torch.ones(frames),
        offsets=torch.arange(frames + 1) * rows,
        edge_count=torch.full((frames,), rows // 4),
        xy=xy.reshape(-1, 2).to(torch.int16),
        rgb=torch.randint(0, 256, (count, 3), generator=generator, dtype=torch.uint8),
        mask=inside.reshape(-1).to(torch.uint8) * 255,
        silhouettes=small,
        silhouette_scale=torch.full((frames,), 0.5),
        image_size=torch.full((frames, 2), float(SIDE_PX)),
        flow={s: torch.zeros(count, 2, dtype=torch.float16) for s in steps},
        flow_confidence={s: torch.full((count,), 200, dtype=torch.uint8) for s in steps},
        partner=partner,
        beside=torch.zeros_like(small),
    )
    times = tuple(i / FPS for i in range(frames))
    centre = (SIDE_PX / 2, SIDE_PX / 2)
    return observations, poses, [VideoFacts("clip", times, SIDE_PX, SIDE_PX, (FOCAL_PX, FOCAL_PX), centre)]


def model_of(poses: Tensor, videos: list[VideoFacts], representation: str, device: str) -> Banmo:
    """An ellipsoid with 25 bones, as grids or as the paper's networks."""
    nodes = initialise.lattice(0.04, 1.0).reshape(-1, 3)
    solid = nodes[(nodes / torch.tensor(RADII)).square().sum(-1) < 1]
    octaves = initialise.octaves(videos, 0.25)
    architecture = Architecture(representation=representation, octaves=octaves)
    return initialise.build(architecture, videos, poses, solid, 0.04, 25, 0, 0.2).to(device)


def step_seconds(trainer: Trainer, steps: int) -> float:
    """Median time of a step, the first left out."""
    times = []
    for _ in range(steps + 1):
        if trainer.device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        trainer.step()
        if trainer.device.type == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return float(np.median(times[1:]))


def peak_flops(device: str, seconds: float = 0.5) -> float:
    """Multiply-adds of large 32-bit matrix products a second, times two."""
    a = torch.randn(1536, 1536, device=device)
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        a @ a
        if device == "cuda":
            torch.cuda.synchronize()
        count += 1
    return 2 * 1536**3 * count / (time.perf_counter() - start)


def step_flops(trainer: Trainer) -> float:
    """Floating point operations of a step that torch can count: matrix products, forward and backward."""
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter:
        trainer.step()
    return float(counter.get_total_flops())


def speed(device: str, steps: int) -> float:
    """Print the table of speeds; returns how many times as many rays a second ours renders."""
    observations, poses, videos = synthetic(100)
    ours = PhaseSettings(iterations=1000)
    samples = ours.probe_samples + ours.fine_samples
    # The plain one gets fewer rays a step, as a whole batch would take minutes; its cost a ray does not depend on it.
    plain = replace(ours, frames_per_step=8, pixels_per_frame=32, probe_samples=1, fine_samples=samples, match_every=99)
    peak = peak_flops(device)
    log.info("| version | rays a step | samples a ray | s a step | rays a second | samples a second | of peak |")
    log.info("| --- | --- | --- | --- | --- | --- | --- |")
    rates = {}
    for name, kind, settings in (
        ("ours: grids, probe and near samples", "grid", ours),
        ("grids, every sample with gradient", "grid", replace(ours, probe_samples=1, fine_samples=samples)),
        ("plain: 8 x 256, every sample with gradient", "mlp", plain),
    ):
        trainer = Trainer(model_of(poses, videos, kind, device), observations, settings)
        each = step_seconds(trainer, steps)
        rays = settings.frames_per_step * settings.pixels_per_frame
        rates[kind if name.startswith(("ours", "plain")) else "all"] = rays / each
        share = step_flops(trainer) / each / peak
        log.info(
            "| %s | %d | %d | %.3f | %.0f | %.2e | %.1f %% |",
            *(name, rays, samples, each, rays / each, rays * samples / each, 100 * share),
        )
    ratio = rates["grid"] / rates["mlp"]
    log.info("ours renders %.1f times as many rays a second as the plain version", ratio)
    log.info("memory of the process at most %.0f MB", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return ratio


def scale(device: str, steps: int, counts: tuple[int, ...]) -> None:
    """Print what a step costs as frames grow."""
    log.info("| frames | s a step | relative | rows MB |")
    log.info("| --- | --- | --- | --- |")
    first = math.nan
    for frames in counts:
        observations, poses, videos = synthetic(frames)
        # No surface is extracted anew in between: that is once in two hundred steps, whatever the frames.
        trainer = Trainer(model_of(poses, videos, "grid", device), observations, PhaseSettings(iterations=1000))
        each = step_seconds(trainer, steps)
        first = each if math.isnan(first) else first
        rows = sum(t.numel() * t.element_size() for t in (observations.xy, observations.rgb, observations.mask))
        rows += sum(t.numel() * 2 + t.numel() // 2 for t in observations.flow.values())
        log.info("| %d | %.3f | %.2f | %.0f |", frames, each, each / first, rows / 1e6)


def _cost(seen: Seen, settings: Phases, few: int = 20, more: int = 80) -> tuple[float, float]:
    """Processor seconds that a reconstruction takes before its first step, and each step's; two short ones tell."""
    from benchmarks.trials import reconstruct

    fit, correct, refine = settings
    phases = 2 if refine.iterations else 1

    def spent(steps: int) -> float:
        last = replace(refine, iterations=steps if refine.iterations else 0)
        return reconstruct(seen, replace(fit, iterations=steps), correct, last)[1]

    short, long = spent(few), spent(more)
    each = (long - short) / (phases * (more - few))
    return max(0.0, short - phases * few * each), each


def accuracy(
    workspace: Path, data: Path, evaluate: Path, minutes: tuple[float, ...], seed: int, versions: tuple[str, ...]
) -> None:
    """Print what each of `versions` ("ours", "plain") reaches after equal processor time."""
    from benchmarks.trials import judge, observe, presets, reconstruct, write_meshes

    seen = observe(workspace)
    fit, correct, refine = presets("preview", seed=seed)
    skipped = replace(correct, iterations=0)
    plain = replace(
        fit, representation="mlp", start="sphere", lr_sdf=5e-4, lr_colour=5e-4, lr_motion=5e-4, beta_start=0.1,
        probe_samples=1, fine_samples=56, frames_per_step=8, pixels_per_frame=32, motion_spacing_s=0.0,
    )  # fmt: skip
    log.info("| version | CPU minutes | steps | CD cm | F@1 | F@2 | F@5 |")
    log.info("| --- | --- | --- | --- | --- | --- | --- |")
    for wanted in minutes:
        for name, first, last in (("ours", fit, refine), ("plain", plain, replace(refine, iterations=0))):
            if name not in versions:
                continue
            # How many steps the time buys is measured; the shares of the phases stay those of the preset.
            start, each = _cost(seen, (first, skipped, last))
            total = (wanted * 60 - start) / each
            share = first.iterations / (first.iterations + last.iterations)
            steps = round(total * share), round(total * (1 - share))
            settings = replace(first, iterations=steps[0]), skipped, replace(last, iterations=steps[1])
            model, spent = reconstruct(seen, *settings)
            with tempfile.TemporaryDirectory(prefix="equal-") as folder:
                write_meshes(model, Path(folder))
                s = judge(evaluate, data, Path(folder))
            log.info(
                "| %s | %.1f | %d | %.2f | %.1f | %.1f | %.1f |",
                *(name, spent / 60, sum(steps), s.chamfer, s.f1, s.f2, s.f5),
            )


def main() -> None:
    """Read the command line and print the tables asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--steps", type=int, default=8, help="timed steps; the median counts")
    parser.add_argument("--frames", type=int, nargs="*", default=(100, 1000, 10_000))
    parser.add_argument("--data", type=Path, help="one object of the evaluation data set: compare at equal time")
    parser.add_argument("--workspace", type=Path, help="where the stages up to poses made something of it")
    parser.add_argument("--evaluate", type=Path, help="the evaluation script")
    parser.add_argument("--minutes", type=float, nargs="*", default=(2.0, 5.0, 10.0))
    parser.add_argument("--versions", nargs="*", default=("ours", "plain"), choices=("ours", "plain"))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    torch.set_num_threads(args.threads)
    if args.data is not None:
        if args.evaluate is None or args.workspace is None:
            parser.error("--data needs --workspace and --evaluate")
        accuracy(args.workspace, args.data, args.evaluate, tuple(args.minutes), args.seed, tuple(args.versions))
        return
    speed(args.device, args.steps)
    if args.frames:
        scale(args.device, args.steps, tuple(args.frames))


if __name__ == "__main__":
    main()
