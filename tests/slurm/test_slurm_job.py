"""What runs inside a Slurm job, without Slurm."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from pipeline.errors import ExitCode
from pipeline.slurm_job import RunRequest

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
