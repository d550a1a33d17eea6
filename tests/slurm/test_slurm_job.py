"""What runs inside a Slurm job, without Slurm."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from pipeline.errors import ExitCode
from pipeline.executor import Grant, Watched
from pipeline.slurm import SlurmJob
from pipeline.slurm_job import RunRequest
from pipeline.slurm_queue import JobState, Queue

WORKER = """
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
print("ready", flush=True)
time.sleep(600)
"""


def test_the_checkpoint_hook_returns_as_soon_as_the_worker_has_saved() -> None:
    """It runs in a signal handler that interrupts the wait for that very worker."""
    pytest.importorskip("submitit", reason="the extra `slurm` is not installed")
    took_s: list[float] = []
    with subprocess.Popen([sys.executable, "-c", WORKER], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stdout.readline() == b"ready\n"
        request = RunRequest("request.json", "log.txt")
        request._child = child

        def hook(*_: object) -> None:
            started = time.monotonic()
            request.checkpoint()
            took_s.append(time.monotonic() - started)

        before = signal.signal(signal.SIGUSR2, hook)
        try:
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGUSR2)).start()
            assert child.wait() == ExitCode.INTERRUPTED
        finally:
            signal.signal(signal.SIGUSR2, before)
    assert len(took_s) == 1 and took_s[0] < 30, "the grace that Slurm gives is not waited out"


class Told(Queue):
    """A queue that says what it is told to say."""

    now: JobState | None = None

    def state(self, job_id: str) -> JobState | None:
        return self.now


def stopped_job(root: Path, queue: Told) -> SlurmJob:
    """A job whose worker has saved and stopped, although the run did not ask for it."""
    (root / "outcome.json").write_text(json.dumps({"status": "interrupted", "message": "stopped on request"}))
    note = root / "note.json"
    note.touch()
    return SlurmJob(Watched(root, root / "log.txt", Grant(1)), "7", note, queue)


def test_a_job_that_fails_for_a_moment_while_it_is_requeued_goes_on(tmp_path: Path) -> None:
    queue = Told()
    job = stopped_job(tmp_path, queue)
    for state in ("RUNNING", "FAILED", "COMPLETING", "FAILED", "PENDING", "RUNNING"):
        queue.now = JobState(state)
        assert job.poll() is None, state
    assert (tmp_path / "note.json").exists()


@pytest.mark.parametrize("state", [JobState("CANCELLED"), None])
def test_a_job_that_does_not_come_again_has_ended(tmp_path: Path, state: JobState | None) -> None:
    queue = Told()
    job = stopped_job(tmp_path, queue)
    queue.now = state
    outcome = job.poll()
    assert outcome is not None and outcome.status == "interrupted"
    assert not (tmp_path / "note.json").exists()
