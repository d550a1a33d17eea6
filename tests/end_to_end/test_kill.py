"""kill -9 at random moments, then run again: the same folders as if nothing had happened.

``make soak`` does it twenty times (BANMO_SOAK); BANMO_SOAK_SEED draws other moments.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

from tests.end_to_end.conftest import TINY, Outcome, check_store, environment, run_banmo, snapshot, view

KILLS = int(os.environ.get("BANMO_SOAK", "4"))
SEED = int(os.environ.get("BANMO_SOAK_SEED", "1"))


def start(clips: Path, workspace: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "pipeline.cli", "run", str(clips), "--workspace", str(workspace), *TINY]
    return subprocess.Popen(
        command, env=environment() | {"PYTHONPATH": str(snapshot())}, cwd=snapshot(), start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def kill_all(run: subprocess.Popen[bytes]) -> None:
    """SIGKILL to the process group and to every descendant at once, as when the machine dies."""
    try:
        doomed = psutil.Process(run.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        doomed = []
    with contextlib.suppress(ProcessLookupError):
        os.killpg(run.pid, signal.SIGKILL)
    for process in doomed:
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue
    run.wait()
    psutil.wait_procs(doomed, timeout=30)


def test_killed_runs_end_as_undisturbed_ones(finished: tuple[Path, Outcome], clips: Path, tmp_path: Path) -> None:
    reference = view(finished[0])
    assert finished[1].code == 0, finished[1].text
    chance = random.Random(SEED)
    killed = rounds = 0
    while killed < KILLS:
        rounds += 1
        workspace = tmp_path / f"round-{rounds}"
        before = killed
        while killed < KILLS:
            run = start(clips, workspace)
            # Short and long waits alike: most of a run's moments are start-up, planning, publishing or fitting.
            deadline = time.monotonic() + chance.choice([chance.uniform(0.2, 3.0), chance.uniform(1.0, 25.0)])
            while run.poll() is None and time.monotonic() < deadline:
                time.sleep(0.02)
            if run.poll() is not None:
                assert run.returncode == 0
                break
            kill_all(run)
            killed += 1
            check_store(workspace)
            if (workspace / "FORMAT").is_file():
                verified = run_banmo("verify", "--deep", "--workspace", workspace)
                assert verified.code == 0, verified.text
        ended = run_banmo("run", clips, "--workspace", workspace, *TINY)
        assert ended.code == 0, ended.text
        assert view(workspace) == reference, f"after {killed - before} kills (BANMO_SOAK_SEED={SEED})"
        assert (workspace / "exports" / "model.glb").read_bytes() == (
            finished[0] / "exports" / "model.glb"
        ).read_bytes()
        assert run_banmo("verify", "--deep", "--workspace", workspace).code == 0
        assert not list((workspace / "checkpoints").glob("*")), "finished work leaves no checkpoint"
    assert killed == KILLS
