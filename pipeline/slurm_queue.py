"""What Slurm's queue says: one ``squeue`` for all jobs, asked at most every few seconds; and the two ways to end a job.

``sacct`` is not asked: without accounting it knows nothing, and a job that has left the queue has left its outcome on
disk. Job ids are digits, or digits_digits for an element of an array.
"""

from __future__ import annotations

import subprocess
import time
from dataclasses import dataclass

_INTERVAL_S = 2.0
_ENDED = frozenset(
    ["BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "REVOKED", "TIMEOUT"]
)


@dataclass(frozen=True)
class JobState:
    """State of a job, as ``squeue`` names it, and why it waits."""

    name: str
    reason: str = ""

    @property
    def ended(self) -> bool:
        """Whether it will not run (again)."""
        return self.name in _ENDED

    @property
    def may_return(self) -> bool:
        """Whether it may still come again: a job that is being requeued shows as failed for a moment."""
        return self.name != "CANCELLED"


class Queue:
    """The user's jobs. When the controller does not answer, what it said last stands."""

    def __init__(self, interval_s: float = _INTERVAL_S) -> None:
        self._interval_s = interval_s
        self._asked = -1e9
        self._answered = False
        self._states: dict[str, JobState] = {}

    def state(self, job_id: str) -> JobState | None:
        """State of a job; None when the queue does not know it (any more)."""
        if time.monotonic() - self._asked >= self._interval_s:
            self._ask()
        found = self._states.get(job_id)
        if found is None and not self._answered:
            return JobState("UNKNOWN", "the controller does not answer")
        return found

    def is_there(self, job_id: str) -> bool:
        """Whether the job still waits or runs."""
        state = self.state(job_id)
        return state is not None and not state.ended

    def cancel(self, job_id: str) -> None:
        """End a job, waiting or running."""
        self._command("scancel", job_id)
        self._asked = -1e9

    def signal(self, job_id: str, name: str) -> None:
        """Send a signal to every process of a running job."""
        self._command("scancel", f"--signal={name}", job_id)

    def _ask(self) -> None:
        self._asked = time.monotonic()
        # -r: one line for each element of an array that waits; %F_%K names it as submitit does.
        answer = self._command("squeue", "-h", "-r", "--me", "-t", "all", "-o", "%i|%T|%r")
        self._answered = answer is not None or self._answered
        if answer is not None:
            self._states = parse_squeue(answer)

    @staticmethod
    def _command(*words: str) -> str | None:
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL)
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout if done.returncode == 0 else None


def parse_squeue(text: str) -> dict[str, JobState]:
    """Job id -> state, from lines of ``id|state|reason``."""
    found = {}
    for line in text.splitlines():
        job_id, _, rest = line.strip().partition("|")
        name, _, reason = rest.partition("|")
        if job_id and name:
            found[job_id] = JobState(name, "" if reason == "None" else reason)
    return found
