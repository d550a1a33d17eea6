"""device -> train: a mean by gradient descent, its data shared among the ranks"""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline import Folder, Resources, Run, Scene, stage


@dataclass(frozen=True)
class TrainSettings:
    """Settings of `train`."""

    steps: int = 20
    """How many steps."""
    delay_s: float = 0.0
    """Time a step takes."""
    lose_rank: int = -1
    """Rank that dies at the third step."""


@stage(per=Scene, needs=Resources(cpus=1, distributed=True))
def train(device: dict[str, Folder], settings: TrainSettings, out: Path, run: Run) -> None:
    """Losses of a small descent, and who took part."""
    import torch
    import torch.distributed as dist

    torch.set_num_threads(1)
    many = run.world_size > 1
    if many:
        dist.init_process_group("gloo")
    data = torch.arange(8, dtype=torch.float64)[run.rank :: run.world_size]
    state = run.checkpoint_dir / "state.json"
    saved = json.loads(state.read_text()) if state.exists() else {"step": 0, "x": 10.0, "losses": []}
    if many:
        dist.barrier()  # all have read the same
    run.log.info("rank %d of %d on %s goes on from step %d", run.rank, run.world_size, _node(), saved["step"])
    x = torch.tensor(saved["x"], dtype=torch.float64)
    for step in range(saved["step"], settings.steps):
        if step == 3 and run.rank == settings.lose_rank:
            os._exit(9)
        time.sleep(settings.delay_s)
        sums = torch.stack([((x - data) ** 2).sum(), 2 * (x - data).sum(), torch.tensor(float(run.stop_requested))])
        if many:
            dist.all_reduce(sums)
        saved["losses"].append(round(float(sums[0] / 8), 9))
        x = x - 0.1 * sums[1] / 8
        saved.update(step=step + 1, x=float(x))
        if run.rank == 0:
            temporary = state.with_suffix(".tmp")
            temporary.write_text(json.dumps(saved))
            temporary.rename(state)
        run.tick(step + 1, settings.steps)
        if sums[2] > 0:
            run.interrupt()
    nodes = [_node()]
    if many:
        found: list[str | None] = [None] * run.world_size
        dist.all_gather_object(found, _node())
        nodes = [str(n) for n in found]
        dist.destroy_process_group()
    run.metric("nodes", nodes)
    (out / "losses.json").write_text(json.dumps(saved["losses"]))
    (out / f"rank-{run.rank}.txt").write_text("only that of rank 0 is kept")


def _node() -> str:
    return os.environ.get("SLURMD_NODENAME", "here")
