"""The real `fit` over two nodes, started through the engine under Slurm, against the same fit in one process."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.ledger import Ledger, Record
from synthetic.clips import write_clips
from tests.slurm.cluster import Cluster
from tests.slurm.test_slurm import SLURM, TWO

ROOT = Path(__file__).resolve().parent.parent.parent
STEPS = 40
# Nine frames a step do not halve: the nodes' shares differ.
FIT = (
    f"--fit.iterations={STEPS}", "--fit.voxel=0.07", "--fit.bones=6", "--fit.frames_per_step=9",
    "--fit.pixels_per_frame=24", "--fit.probe_samples=16", "--fit.fine_samples=4", "--fit.match_pixels=16",
)  # fmt: skip


def banmo(cluster: Cluster, workspace: Path, clips: Path, *words: str) -> str:
    """``banmo run`` as a user types it; what it said."""
    command = [sys.executable, "-m", "pipeline.cli", "run", str(clips), "--workspace", str(workspace), *FIT, *words]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, env={**os.environ, **cluster.environment}, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def fit_of(workspace: Path) -> tuple[Record, list[dict[str, float]]]:
    """Record and losses of the one fit there."""
    (record,) = Ledger(workspace / "actions").all("fit")
    lines = (workspace / "objects" / "fit" / record.digest / "metrics.jsonl").read_text().splitlines()
    return record, [json.loads(line) for line in lines]


def test_fit_on_two_nodes_loses_what_it_loses_in_one_process(
    cluster: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clips = tmp_path / "clips"
    write_clips(clips, clips=2, frames=6, size=64, seed=3, truth=True)
    one, two = tmp_path / "one", tmp_path / "two"
    banmo(cluster, one, clips, "--until", "poses")
    shutil.copytree(one, two, symlinks=True)
    banmo(cluster, one, clips, "--until", "fit", "--execution.cpus", "1")
    told = banmo(cluster, two, clips, "--until", "fit", *SLURM, *TWO, "--execution.gpus", "0", "--execution.cpus", "1")
    assert "Slurm job" in told

    (alone, wanted), (together, found) = fit_of(one), fit_of(two)
    assert together.key == alone.key, "on how many machines it runs does not count"
    assert [row["step"] for row in found] == [row["step"] for row in wanted] == list(range(10, STEPS + 1, 10))
    apart = {
        name: max(abs(a[name] - b[name]) / max(abs(b[name]), 1e-6) for a, b in zip(found, wanted, strict=True))
        for name in wanted[0]
    }
    with capsys.disabled():
        totals = " ".join(f"{a['total']:.6f}/{b['total']:.6f}" for a, b in zip(found, wanted, strict=True))
        sys.stdout.write(f"\ntotal loss, two nodes / one process: {totals}; {max(apart.values()):.1e} apart at most\n")
    # Sums in another order, and Adam divides by the size of tiny gradients: digits are lost step by step.
    for ours, theirs in zip(found, wanted, strict=True):
        assert ours == pytest.approx(theirs, rel=2e-3, abs=1e-6), apart
    logs = [p.read_text() for p in sorted(two.glob("runs/*/logs/fit*.txt"))]
    places = [line.split("rank ")[1] for text in logs for line in text.splitlines() if " rank " in line]
    assert sorted(places) == ["0 of 2 on n1", "1 of 2 on n2"]
    assert list(two.glob("runs/*/slurm/*/*.out")), "Slurm's own logs are kept"
