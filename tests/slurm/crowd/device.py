"""clips -> device"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline import Resources, Run, Source, Video, stage


@dataclass(frozen=True)
class DeviceSettings:
    """Settings of `device`."""

    delay_s: float = 0.0
    """Time it holds the GPU."""


@stage(per=Video, needs=Resources(cpus=1, gpus=1))
def device(video: Source, settings: DeviceSettings, out: Path, run: Run) -> None:
    """Which GPU of which node it was given, and when."""
    place = f"{os.environ.get('SLURMD_NODENAME', 'here')}:{os.environ.get('CUDA_VISIBLE_DEVICES', '')}"
    start = time.time()
    time.sleep(settings.delay_s)
    run.metric("place", place)
    run.metric("span", [start, time.time()])
    run.metric("array", os.environ.get("SLURM_ARRAY_JOB_ID", ""))
    (out / "text.txt").write_text(video.path.read_text())
