"""How fast perception is: masks + features, and flow at every step both ways, in frames a second on two cores.

``python -m benchmarks.perception [--frames 75 --size 256 --clips 2 --seed 0]``

Runs the stages themselves, as the engine does: one clip a process, two processes at once. Prints frames a second of
processor time as well, since a busy machine slows the clock but not that, and where masks spend it.
"""

from __future__ import annotations

import cProfile
import logging
import multiprocessing
import os
import pstats
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tyro

log = logging.getLogger(__name__)
CORES = 2
PARTS = {"masks + features": ("masks", "features"), "flow": ("flow",)}
WANTED = {"masks + features": 8.0, "flow": 10.0}


def prepare(root: Path, clip: int, frames: int, size: int, seed: int) -> Path:
    """Frames of one generated clip as the `frames` stage writes them."""
    from stages.formats import Clip, write_clip_info, write_image
    from synthetic.clips import film, make_subject

    made = film(make_subject(seed, "cat"), clip, 3, frames, size, seed)
    folder = root / f"frames-{clip}"
    folder.mkdir(parents=True)
    info = Clip(folder, size, size, np.arange(frames), np.arange(frames) / made.fps)
    for name, image in zip(info.names, made.images, strict=True):
        write_image(folder / name, image)
    write_clip_info(info, folder, {"source_width": size, "source_height": size})
    return folder


def run_stage(name: str, frames: Path, root: Path) -> None:
    """One stage with its default settings on one clip; its folder is `root/name`."""
    from pipeline import Folder, Given, Run
    from stages.features import FeatureSettings, features
    from stages.flow import FlowSettings, flow
    from stages.masks import MaskSettings, masks

    out = root / name
    out.mkdir(parents=True)
    common = {"frames": Folder(frames), "given": Given(), "out": out, "run": Run()}
    if name == "masks":
        masks(settings=MaskSettings(), **common)
    elif name == "flow":
        flow(settings=FlowSettings(), **common)
    else:
        features(settings=FeatureSettings(), masks=Folder(root / "masks"), **common)


def _work(names: tuple[str, ...], frames: Path, root: Path, seconds: list[float], slot: int) -> None:
    from stages import features, flow, masks  # noqa: F401  what the imports take is no work of the stage's

    started = time.process_time()
    for name in names:
        run_stage(name, frames, root)
    seconds[slot] = time.process_time() - started


def measure(names: tuple[str, ...], folders: list[Path], root: Path) -> tuple[float, float]:
    """Wall and processor seconds of some stages on all clips, `CORES` at a time."""
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager:
        seconds = manager.list([0.0] * len(folders))
        started = time.monotonic()
        for at in range(0, len(folders), CORES):
            jobs = [
                context.Process(target=_work, args=(names, folders[i], root / f"clip-{i}", seconds, i))
                for i in range(at, min(at + CORES, len(folders)))
            ]
            for job in jobs:
                job.start()
            for job in jobs:
                job.join()
                if job.exitcode:
                    raise RuntimeError(f"{' and '.join(names)} failed")
        return time.monotonic() - started, float(sum(seconds))


def slowest(work: Callable[[], None], most: int = 12) -> list[str]:
    """Lines naming the functions in which most of the time goes."""
    profile = cProfile.Profile()
    profile.runcall(work)
    rows = [(own, where) for where, (_, _, own, _, _) in pstats.Stats(profile).stats.items()]  # type: ignore[attr-defined]
    total = sum(own for own, _ in rows)
    rows.sort(reverse=True)
    return [f"{own / total:5.0%}  {Path(file).name}:{line} {name}" for own, (file, line, name) in rows[:most]]


def main(frames: int = 75, size: int = 256, clips: int = 2, seed: int = 0, profile: bool = False) -> None:
    """Print the table; with `profile` also where masks spend their time."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
    with tempfile.TemporaryDirectory(prefix="banmo-perception-") as scratch:
        root = Path(scratch)
        folders = [prepare(root, clip, frames, size, seed) for clip in range(clips)]
        log.info("%d clips of %d frames of %d x %d, %d at once", clips, frames, size, size, min(clips, CORES))
        log.info("%-18s %12s %22s %8s", "", "frames/s", "by processor time, /s", "wanted")
        for label, names in PARTS.items():
            wall_s, work_s = measure(names, folders, root)
            count = frames * clips
            cores = min(CORES, clips)
            log.info("%-18s %12.1f %22.1f %8.0f", label, count / wall_s, cores * count / work_s, WANTED[label])
        if profile:
            log.info("masks, by function:")
            for line in slowest(lambda: run_stage("masks", folders[0], root / "profile")):
                log.info("  %s", line)


if __name__ == "__main__":
    tyro.cli(main)
