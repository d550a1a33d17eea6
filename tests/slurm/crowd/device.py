"""clips -> device"""

from __future__ import annotations

import os
import time
from pathlib import Path

from pipeline import Resources, Run, Source, Video, stage


@stage(per=Video, needs=Resources(cpus=1, gpus=1))
def device(video: Source, out: Path, run: Run) -> None:
    """Which GPU of which node it was given, and when."""
    place = f"{os.environ['SLURMD_NODENAME']}:{os.environ['CUDA_VISIBLE_DEVICES']}"
    start = time.time()
    time.sleep(3.0)
    run.metric("place", place)
    run.metric("span", [start, time.time()])
    run.metric("array", os.environ.get("SLURM_ARRAY_JOB_ID", ""))
    (out / "text.txt").write_text(video.path.read_text())
