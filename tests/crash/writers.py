"""Several processes that make the same actions at once, for being killed: the store alone, without stages.

Each writer goes through all actions in an order of its own: takes the lease, looks whether a sound result is there,
makes the folder if not, publishes it, writes the record. Writers are forked, so that a kill and a new start cost
milliseconds, and a soak of hundreds of kills fits into a minute.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from filelock import Timeout

from pipeline.action import Action, action
from pipeline.files import unique
from pipeline.ledger import Record
from pipeline.workspace import Workspace

FILES = 6
_STAMP = "2026-01-01T00:00:00.000Z"


@dataclass(frozen=True)
class Work:
    """One action of the soak: its number says everything it writes."""

    number: int

    @property
    def action(self) -> Action:
        """Its canonical text."""
        code = f"{self.number:064x}"
        return action(stage="soak", version=1, code=code, settings={"number": self.number}, inputs={})

    def fill(self, out: Path) -> None:
        """Write its files: some kilobytes each, one below a folder."""
        chance = random.Random(self.number)
        (out / "inner").mkdir(parents=True)
        for i in range(FILES):
            place = out / ("inner" if i % 2 else ".") / f"{i}.bin"
            place.write_bytes(chance.randbytes(chance.randrange(1, 40_000)))


def make(workspace: Workspace, work: Work) -> None:
    """Make one action as a worker does."""
    key = work.action.key
    lease = workspace.lease(key)
    try:
        lease.acquire(timeout=5.0)
    except Timeout:
        return
    try:
        found = workspace.ledger.find("soak", key)
        if found is not None and workspace.objects.sound("soak", found.digest):
            return
        out = workspace.tmp / f"soak-{unique()}" / "out"
        work.fill(out)
        stored = workspace.objects.publish("soak", out)
        workspace.ledger.write(
            Record(
                key=key,
                stage="soak",
                video=None,
                action=work.action.text,
                modules={},
                digest=stored.digest,
                files=stored.files,
                bytes=stored.bytes,
                seconds=0.1,
                started=_STAMP,
                finished=_STAMP,
                run="soak",
            )
        )
    finally:
        lease.release()


def start_writer(root: Path, works: list[Work], seed: int) -> int:
    """Fork a writer that goes through `works` in its own order; returns its process id."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        random.Random(seed).shuffle(works)
        for work in works:
            make(Workspace(root), work)
        status = 0
    except BaseException as error:
        sys.stderr.write(f"writer: {type(error).__name__}: {error}\n")
    finally:
        os._exit(status)


@dataclass
class Tally:
    """What a soak saw."""

    kills: int = 0
    finished: int = 0
    failures: int = 0
    rounds: int = 0
    checks: int = 0


def soak(
    root: Path,
    works: list[Work],
    *,
    kills: int,
    writers: int,
    seed: int,
    deadline: float,
    check: Callable[[Path, bool], None],
) -> Tally:
    """Keep `writers` at work in fresh stores below `root`, and kill them at random moments.

    `check(store, done)` is called on every store: between kills (`done` false) and when all its actions are made.
    """
    chance = random.Random(seed)
    tally = Tally()
    while tally.kills < kills and time.monotonic() < deadline:
        store = root / f"round-{tally.rounds}"
        store.mkdir(parents=True)
        tally.rounds += 1
        alive: set[int] = set()
        complete = 0
        while complete < writers and time.monotonic() < deadline:
            while len(alive) < writers:
                alive.add(start_writer(store, list(works), chance.randrange(1 << 30)))
            time.sleep(chance.uniform(0.0, 0.02) if chance.random() < 0.7 else chance.uniform(0.0, 0.2))
            for pid in list(alive):
                done, status = os.waitpid(pid, os.WNOHANG)
                if done:
                    alive.discard(pid)
                    tally.finished += status == 0
                    tally.failures += status != 0
                    complete += status == 0
            if alive and tally.kills < kills:
                victim = chance.choice(sorted(alive))
                os.kill(victim, signal.SIGKILL)
                _, status = os.waitpid(victim, 0)
                alive.discard(victim)
                tally.kills += os.WIFSIGNALED(status)
            if tally.kills % 25 == 0:
                tally.checks += 1
                check(store, False)
        for pid in alive:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        check(store, complete >= writers)
        tally.checks += 1
    return tally
