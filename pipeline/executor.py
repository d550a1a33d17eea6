"""Where actions run: what the scheduler asks of an executor, and what it gets back.

Every executor starts the same thing, ``python -m pipeline.worker REQUEST.json``, once for each rank of an action.
Progress comes as lines of ``events.jsonl`` in the attempt's folder, the end as its ``outcome.json``.

Ranks: a stage declared with ``Resources(distributed=True)`` may be started in several processes, as many as
``[execution] ranks`` says. Each finds torch's own variables in its environment (RANK, WORLD_SIZE, LOCAL_RANK,
MASTER_ADDR, MASTER_PORT) and the first two in ``Run.rank`` and ``Run.world_size``. Only rank 0 gets the ``out`` that is
published; the folders of the others are thrown away.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from pipeline.definition import StageInfo
from pipeline.events import EventReader
from pipeline.files import read_json
from pipeline.graph import Node

_STATUSES = ("done", "failed", "bad_input", "interrupted")


@dataclass(frozen=True)
class Grant:
    """What an action may use: `cpus` cores in all, these GPUs (by name; counted only on a cluster), so many ranks."""

    cpus: int
    gpus: tuple[str, ...] = ()
    ranks: int = 1

    @property
    def threads(self) -> int:
        """Threads of each rank."""
        return max(1, self.cpus // self.ranks)


@dataclass(frozen=True)
class Launch:
    """An attempt that is ready to start: `attempt` holds its ``request.json``."""

    node: Node
    attempt: Path
    request: dict[str, Any]
    log_path: Path
    grant: Grant


@dataclass
class Outcome:
    """How an attempt ended: done, failed, bad_input, interrupted."""

    status: str
    message: str = ""
    key: str | None = None
    warnings: tuple[str, ...] = ()


class Events(Protocol):
    """New events of an attempt."""

    def read(self) -> list[dict[str, Any]]:
        """What has come since the last call."""


@dataclass
class Watched:
    """What the scheduler remembers of a running attempt."""

    attempt: Path
    log_path: Path
    grant: Grant
    spent_s: float = 0.0
    started: float = field(default_factory=time.monotonic)
    last_sign: float = field(default_factory=time.monotonic)
    told_silent: bool = False

    @classmethod
    def of(cls, launch: Launch) -> Watched:
        """For a launch."""
        return cls(launch.attempt, launch.log_path, launch.grant, float(launch.request["spent_s"]))


class Job(Protocol):
    """A running attempt."""

    @property
    def watched(self) -> Watched:
        """What the scheduler remembers of it."""

    @property
    def events(self) -> Events:
        """Where its events are read."""

    def poll(self) -> Outcome | None:
        """How it ended; None while it runs or waits."""

    def ask_to_stop(self, grace_s: float) -> None:
        """Ask once to save and end; it is killed after `grace_s` seconds."""

    def kill(self) -> None:
        """End it at once."""


class Executor(Protocol):
    """A place where actions run."""

    survives: bool
    """Whether its jobs go on when the run that started them is gone."""

    def take(self, info: StageInfo) -> Grant | None:
        """Reserve what a stage needs; None when there is no room now."""

    def give_back(self, grant: Grant) -> None:
        """Return a grant."""

    def start(self, launches: list[Launch]) -> list[Job]:
        """Start attempts of one stage. Raises BadInput when the place refuses them."""

    def reattach(self, launch: Launch) -> Job | None:
        """The job of an earlier run that is at work on this very action still, or None."""


def read_outcome(attempt: Path) -> Outcome | None:
    """What a worker wrote when it ended, None while there is nothing, or nothing valid."""
    value = read_json(attempt / "outcome.json")
    if not isinstance(value, dict) or value.get("status") not in _STATUSES:
        return None
    warnings = value.get("warnings")
    key = value.get("record")
    return Outcome(
        value["status"],
        str(value.get("message", "")),
        key if isinstance(key, str) else None,
        tuple(str(w) for w in warnings) if isinstance(warnings, list) else (),
    )


def fault_of_a_rank(attempt: Path) -> str:
    """What a rank other than the first says of its failure; "" when none does."""
    for folder in sorted(attempt.glob("rank-*")):
        outcome = read_outcome(folder)
        if outcome is not None and outcome.status in ("failed", "bad_input"):
            return f"{folder.name.replace('-', ' ')}: {outcome.message}"
    return ""


def silent_after(job: Job) -> float:
    """Seconds since a job last gave a sign of life."""
    return time.monotonic() - job.watched.last_sign


def event_reader(attempt: Path) -> EventReader:
    """Reader of an attempt's events."""
    return EventReader(attempt / "events.jsonl")
