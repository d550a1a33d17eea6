"""What runs inside a Slurm job: one worker for each task, started, watched and stopped by submitit's process.

Traps of the cluster that this module answers:

* submitit's checkpoint hook runs inside a signal handler, on the first task only. The worker is a process of its own,
  so the hook can stop it and wait: it saves its own state, the hook returns nothing but the same request.
* A preempted job gets SIGTERM and some time of grace; one that ends in that time is finished as far as Slurm cares.
  So a worker that stopped although nobody cancelled the job makes this process ask for a requeue, and wait for it.
* The function that submitit pickles is a reference to a module that may have been edited since. The worker compares
  the fingerprint of the code in the request with its own and refuses to run other code under that key.
* Slurm's warning signal reaches every process of the job, the workers too: they take it as the wish to stop.
* Several tasks of a node see the same GPUs; each picks its own by LOCAL_RANK, as under torchrun.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from pipeline.definition import child_environment
from pipeline.errors import ExitCode
from pipeline.files import read_json
from pipeline.local import rank_environment

_REQUEUE_S = 600.0
_SAVE_S = 100.0


class RunRequest:
    """The callable that submitit carries to the node: two paths."""

    def __init__(self, request: str, log_path: str) -> None:
        self.request, self.log_path = request, log_path
        self._child: subprocess.Popen[bytes] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"request": self.request, "log_path": self.log_path, "_child": None}

    def __call__(self) -> int:
        """Run the worker of this task; raises when a rank is lost, so that Slurm ends the others."""
        request = read_json(Path(self.request))
        if not isinstance(request, dict):
            return ExitCode.DONE  # taken back before the job started
        rank = int(os.environ.get("SLURM_PROCID", "0"))
        self._child = self._start(request, rank)
        signal.signal(signal.SIGTERM, self._pass_on)
        code = self._child.wait()
        if rank == 0 and code == ExitCode.INTERRUPTED and not self._cancelled():
            self._requeue()
        if rank and code not in (ExitCode.DONE, ExitCode.INTERRUPTED):
            raise RuntimeError(f"rank {rank} ended with status {code}")
        return code

    def checkpoint(self) -> Any:
        """Time is up, or another job needs the place: let the worker save, and come again."""
        from submitit.helpers import DelayedSubmission

        if self._child is not None and self._child.poll() is None:
            self._pass_on()
            deadline = time.monotonic() + _SAVE_S
            while not _has_ended(self._child.pid) and time.monotonic() < deadline:
                time.sleep(0.05)
        return DelayedSubmission(RunRequest(self.request, self.log_path))

    # ------------------------------------------------------------------ inside

    def _start(self, request: dict[str, Any], rank: int) -> subprocess.Popen[bytes]:
        ranks = int(os.environ.get("SLURM_NTASKS", "1"))
        local = int(os.environ.get("SLURM_LOCALID", "0"))
        launch = f"{os.environ.get('SLURM_JOB_ID', '0')}-{os.environ.get('SLURM_RESTART_COUNT', '0')}"
        environment = child_environment(Path(request["package_dir"]))
        environment |= rank_environment(rank, ranks, local, launch, int(request["threads"]))
        log_path = Path(self.log_path)
        path = log_path if rank == 0 else log_path.with_suffix(f".rank-{rank}.txt")
        path.parent.mkdir(parents=True, exist_ok=True)
        if rank == 0:
            (Path(self.request).parent / "outcome.json").unlink(missing_ok=True)  # of a launch before the requeue
        with path.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-P", "-m", "pipeline.worker", self.request],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=Path(self.request).parent,
                env=environment,
                preexec_fn=_ignore_warnings,
            )

    def _pass_on(self, *_: object) -> None:
        if self._child is not None and self._child.poll() is None:
            self._child.terminate()

    def _cancelled(self) -> bool:
        """Whether somebody ended this job on purpose: the run that submitted it, or the user by scancel."""
        if (Path(self.request).parent / "stop").exists():
            return True
        # A preempted job still counts as running in its time of grace; a cancelled one is completing at once.
        return _job_facts(os.environ.get("SLURM_JOB_ID", "")) != "JobState=RUNNING"

    @staticmethod
    def _requeue() -> None:
        """Come again later; this process waits until Slurm ends it, because one that ends by itself is finished."""
        subprocess.run(["scontrol", "requeue", os.environ["SLURM_JOB_ID"]], timeout=60, check=False)
        time.sleep(_REQUEUE_S)


def _has_ended(pid: int) -> bool:
    """Whether a child has ended. Asked of the system: within a signal handler, `Popen` waits for what it interrupts."""
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:
        return True


def _ignore_warnings() -> None:
    """In a worker about to start: Slurm's warning goes to every process of the job, and would end one by default."""
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)


def _job_facts(job_id: str) -> str:
    """State of a job, from the controller."""
    try:
        done = subprocess.run(["scontrol", "show", "job", job_id], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.SubprocessError):
        return ""
    return next((word for word in done.stdout.split() if word.startswith("JobState=")), "")
