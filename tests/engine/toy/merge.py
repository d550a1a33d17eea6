"""upper, measure -> merge, step by step, with checkpoints"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline import Folder, Resources, Run, Scene, stage


@dataclass(frozen=True)
class MergeSettings:
    """Settings of `merge`."""

    steps: int = 3
    """How many steps."""
    delay_s: float = 0.0
    """Time a step takes."""
    deaf: bool = False
    """Whether to ignore the wish to stop."""


@stage(per=Scene, needs=Resources(cpus="all", gpus=1))
def merge(upper: dict[str, Folder], measure: dict[str, Folder], settings: MergeSettings, out: Path, run: Run) -> None:
    """Everything together."""
    state = run.checkpoint_dir / "step.txt"
    first = int(state.read_text()) if state.exists() else 0
    run.log.info("first step %d, threads %s", first, os.environ["OMP_NUM_THREADS"])
    for step in range(first, settings.steps):
        time.sleep(settings.delay_s)
        temporary = state.with_suffix(".tmp")
        temporary.write_text(str(step + 1))
        temporary.rename(state)
        run.tick(step + 1, settings.steps, loss=1.0 / (step + 1))
        if run.stop_requested and not settings.deaf:
            run.interrupt()
    for name, folder in upper.items():
        loud = "".join(p.read_text() for p in sorted((folder / "inner").iterdir()))
        (out / f"{name}.txt").write_text(loud + (measure[name] / "sizes.txt").read_text())
    (out / "steps.txt").write_text(str(settings.steps))
