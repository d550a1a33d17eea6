"""Executor for this machine: one subprocess an action, in a session of its own, with tokens for cores and GPUs."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.definition import child_environment
from pipeline.errors import ExitCode
from pipeline.events import EventReader
from pipeline.files import read_json


class Tokens:
    """Cores and GPUs that are free now."""

    def __init__(self, cpus: int, gpus: list[str]) -> None:
        self.total_cpus = max(1, cpus)
        self.free_cpus = self.total_cpus
        self.total_gpus = len(gpus)
        self.free_gpus = list(gpus)

    def take(self, cpus: int, gpus: int) -> tuple[int, list[str]] | None:
        """Take `cpus` cores (0 = all) and up to `gpus` GPUs as far as the machine has them; None when busy."""
        cores = self.total_cpus if cpus == 0 else min(cpus, self.total_cpus)
        devices = min(gpus, self.total_gpus)
        if cores > self.free_cpus or devices > len(self.free_gpus):
            return None
        self.free_cpus -= cores
        granted, self.free_gpus = self.free_gpus[:devices], self.free_gpus[devices:]
        return cores, granted

    def give_back(self, cpus: int, gpus: list[str]) -> None:
        """Return what `take` granted."""
        self.free_cpus += cpus
        self.free_gpus += gpus


def machine_cpus() -> int:
    """Cores this process may use: affinity and the cgroup's quota counted."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        if quota != "max":
            count = min(count, max(1, round(int(quota) / int(period))))
    except (OSError, ValueError):
        pass
    return count


def machine_gpus() -> list[str]:
    """Names that CUDA_VISIBLE_DEVICES understands, of the GPUs this process may use."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return [d.strip() for d in visible.split(",") if d.strip() and d.strip() != "-1"]
    if not (Path("/proc/driver/nvidia").exists() or Path("/dev/nvidia0").exists()):
        return []
    try:
        listing = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=20, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    return [str(i) for i, line in enumerate(n for n in listing.splitlines() if n.startswith("GPU "))]


@dataclass
class Outcome:
    """How an attempt ended: done, failed, bad_input, interrupted."""

    status: str
    message: str = ""
    key: str | None = None
    warnings: tuple[str, ...] = ()


class Job:
    """One running attempt."""

    def __init__(self, attempt: Path, request: dict[str, Any], log_path: Path, cpus: int, gpus: list[str]) -> None:
        self.attempt, self.cpus, self.gpus, self.log_path = attempt, cpus, gpus, log_path
        self.events = EventReader(attempt / "events.jsonl")
        self.started = time.monotonic()
        self.last_sign = self.started
        self.told_silent = False
        self.spent_s = float(request["spent_s"])
        self._stop_by: float | None = None
        self._killed = False
        environment = child_environment(Path(request["package_dir"]))
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            environment[name] = str(cpus)
        environment["CUDA_VISIBLE_DEVICES"] = ",".join(gpus)
        log_path.parent.mkdir(parents=True, exist_ok=True)
        with log_path.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "pipeline.worker", str(attempt / "request.json")],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=attempt,
                env=environment,
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """Process (and session) id."""
        return self._process.pid

    def poll(self) -> Outcome | None:
        """None while it runs. Kills it when the time to stop has passed."""
        if not self._ended():
            if self._stop_by is not None and time.monotonic() > self._stop_by:
                self.kill()
            return None
        self._sweep()
        self._process.wait()
        value = read_json(self.attempt / "outcome.json")
        if isinstance(value, dict) and value.get("status") in ("done", "failed", "bad_input", "interrupted"):
            return Outcome(value["status"], value["message"], value["record"], tuple(value["warnings"]))
        return self._without_outcome(self._process.returncode)

    def _ended(self) -> bool:
        """Whether it has ended; it is not reaped, so that its session id stays its own until `_sweep` has been."""
        if not hasattr(os, "waitid"):
            return self._process.poll() is not None
        return os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def _without_outcome(self, code: int) -> Outcome:
        if self._stop_by is not None or code in (ExitCode.INTERRUPTED, -signal.SIGTERM):
            return Outcome("interrupted", "killed: it did not stop in time" if self._killed else "stopped")
        if code == -signal.SIGKILL:
            return Outcome("failed", "killed from outside by SIGKILL; most often the machine ran out of memory")
        if code < 0:
            try:
                name = signal.Signals(-code).name
            except ValueError:
                name = f"signal {-code}"
            return Outcome("failed", f"crashed ({name}) in native code")
        return Outcome("failed", f"ended with status {code} without saying why")

    def ask_to_stop(self, grace_s: float) -> None:
        """Ask once; after `grace_s` seconds it is killed."""
        if self._stop_by is None:
            self._stop_by = time.monotonic() + grace_s
            self._send(signal.SIGTERM, group=False)

    def kill(self) -> None:
        """Kill the worker and whatever it started."""
        self._killed = True
        if self._stop_by is None:
            self._stop_by = time.monotonic()
        self._send(signal.SIGKILL, group=True)

    def _sweep(self) -> None:
        """End what the worker left behind in its session, and close our end of the pipe."""
        self._send(signal.SIGKILL, group=True)
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def _send(self, number: signal.Signals, *, group: bool) -> None:
        try:
            if group:
                os.killpg(self._process.pid, number)
            else:
                self._process.send_signal(number)
        except (ProcessLookupError, PermissionError):
            pass
