"""Executor for this machine: one subprocess a rank of an action, in a session of its own; tokens for cores and GPUs."""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

from pipeline.definition import StageInfo, child_environment
from pipeline.errors import FULL_STATUS, ExitCode, disk_full
from pipeline.executor import Grant, Job, Launch, Outcome, Watched, event_reader, fault_of_a_rank, read_outcome

_LAST_RANKS_S = 20.0


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


class LocalExecutor:
    """Runs actions on this machine. `ranks` are the processes of a stage that can be distributed."""

    survives = False

    def __init__(self, tokens: Tokens, ranks: int = 1) -> None:
        self._tokens, self._ranks = tokens, max(1, ranks)

    def take(self, info: StageInfo) -> Grant | None:
        """Cores and GPUs for a stage, None when they are busy."""
        ranks = self._ranks if info.distributed else 1
        taken = self._tokens.take(info.cpus, info.gpus * ranks)
        return Grant(taken[0], tuple(taken[1]), ranks) if taken else None

    def give_back(self, grant: Grant) -> None:
        """Return a grant."""
        self._tokens.give_back(grant.cpus, list(grant.gpus))

    def start(self, launches: list[Launch]) -> list[Job]:
        """Start each of them."""
        return [LocalJob(launch) for launch in launches]

    def reattach(self, launch: Launch) -> Job | None:
        """Never: local workers end with the run that started them."""
        return None


class LocalJob:
    """One running attempt: as many processes as ranks. All are waited for and none outlives it."""

    def __init__(self, launch: Launch) -> None:
        self.watched = Watched.of(launch)
        self.events = event_reader(launch.attempt)
        self._attempt = launch.attempt
        self._stop_by: float | None = None
        self._last_by: float | None = None
        self._killed = False
        self._processes: list[subprocess.Popen[bytes]] = []
        token = secrets.token_hex(4)
        try:
            for rank in range(launch.grant.ranks):
                self._processes.append(_start(launch, rank, token))
        except BaseException:
            self.kill()
            self._sweep()
            raise

    @property
    def pid(self) -> int:
        """Process (and session) id of rank 0."""
        return self._processes[0].pid

    def poll(self) -> Outcome | None:
        """None while it runs. Kills it when the time to stop has passed, or one of its ranks is lost."""
        ended = [_ended(p) for p in self._processes]
        if not all(ended):
            now = time.monotonic()
            if self._stop_by is not None and now > self._stop_by:
                self.kill()
            elif any(ended) and len(ended) > 1:
                self._mind_ranks(ended, now)
            return None
        codes = self._sweep()
        return read_outcome(self._attempt) or self._without_outcome(codes)

    def _mind_ranks(self, ended: list[bool], now: float) -> None:
        """The others wait for a lost rank for ever; those that outlive rank 0 have a moment to end."""
        if self._last_by is None:
            self._last_by = now + (_LAST_RANKS_S if ended[0] else 2.0)
        if now > self._last_by:
            self._send(signal.SIGKILL, group=True)

    def _without_outcome(self, codes: list[int]) -> Outcome:
        if self._stop_by is not None or codes[0] in (ExitCode.INTERRUPTED, -signal.SIGTERM):
            return Outcome("interrupted", "killed: it did not stop in time" if self._killed else "stopped")
        if FULL_STATUS in codes:
            return Outcome("bad_input", str(disk_full(self._attempt.parent.parent)))
        fault = fault_of_a_rank(self._attempt)
        if fault:
            return Outcome("failed", fault)
        for rank, code in reversed(list(enumerate(codes))):
            if rank and code < 0 and code != -signal.SIGKILL:
                return Outcome("failed", f"rank {rank}: {_said(code)}")
        return Outcome("failed", _said(codes[0]))

    def ask_to_stop(self, grace_s: float) -> None:
        """Ask once; after `grace_s` seconds it is killed."""
        if self._stop_by is None:
            self._stop_by = time.monotonic() + grace_s
            self._send(signal.SIGTERM, group=False)

    def kill(self) -> None:
        """Kill the workers and whatever they started."""
        self._killed = True
        if self._stop_by is None:
            self._stop_by = time.monotonic()
        self._send(signal.SIGKILL, group=True)

    def _sweep(self) -> list[int]:
        """End what the workers left behind in their sessions, close our ends of the pipes; their exit statuses."""
        self._send(signal.SIGKILL, group=True)
        codes = []
        for process in self._processes:
            if process.stdin is not None:
                with contextlib.suppress(OSError):
                    process.stdin.close()
            codes.append(process.wait())
        return codes

    def _send(self, number: signal.Signals, *, group: bool) -> None:
        for process in self._processes:
            try:
                if group:
                    os.killpg(process.pid, number)
                elif not _ended(process):
                    process.send_signal(number)
            except (ProcessLookupError, PermissionError):
                pass


def rank_environment(rank: int, ranks: int, local_rank: int, token: str, threads: int) -> dict[str, str]:
    """What tells a worker which rank it is; `token` is one for all ranks that are started together."""
    found = {name: str(threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    numbers = {"RANK": rank, "WORLD_SIZE": ranks, "LOCAL_RANK": local_rank}
    return found | {name: str(number) for name, number in numbers.items()} | {"BANMO_LAUNCH": token}


def _start(launch: Launch, rank: int, token: str) -> subprocess.Popen[bytes]:
    environment = child_environment(Path(launch.request["package_dir"]))
    environment |= rank_environment(rank, launch.grant.ranks, rank, token, launch.grant.threads)
    environment["CUDA_VISIBLE_DEVICES"] = ",".join(launch.grant.gpus)
    path = launch.log_path if rank == 0 else launch.log_path.with_suffix(f".rank-{rank}.txt")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "pipeline.worker", str(launch.attempt / "request.json")],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            cwd=launch.attempt,
            env=environment,
            start_new_session=True,
        )


def _ended(process: subprocess.Popen[bytes]) -> bool:
    """Whether it has ended; it is not reaped, so that its session id stays its own until it has been swept."""
    if process.returncode is not None:
        return True
    if not hasattr(os, "waitid"):
        return process.poll() is not None
    return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _said(code: int) -> str:
    """An exit status without an outcome, in words."""
    if code == -signal.SIGKILL:
        return "killed from outside by SIGKILL; most often the machine ran out of memory"
    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        return f"crashed ({name}) in native code"
    return f"ended with status {code} without saying why"
