"""Hundreds of kills over concurrent writers: nothing lost, nothing corrupt, the folders those of a calm run.

``make soak`` kills 500 times (BANMO_SOAK_KILLS) within BANMO_SOAK_MINUTES, and prints what it saw;
BANMO_SOAK_SEED draws other moments.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from pipeline.upkeep import verify
from pipeline.workspace import Workspace
from tests.crash.writers import Work, make, soak

KILLS = int(os.environ.get("BANMO_SOAK_KILLS", "40"))
MINUTES = float(os.environ.get("BANMO_SOAK_MINUTES", "10"))
SEED = int(os.environ.get("BANMO_SOAK_SEED", "0"))
WRITERS = 4


def digests(root: Path) -> dict[str, str]:
    ledger = Workspace(root).ledger
    return {r.key: r.digest for r in ledger.all("soak")}


def test_writers_killed_at_random_moments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    works = [Work(i) for i in range(12)]
    for work in works:
        make(Workspace(tmp_path / "calm"), work)
    wanted = digests(tmp_path / "calm")
    assert len(wanted) == len(works)

    corrupt: list[str] = []
    lost: list[str] = []

    def check(store: Path, done: bool) -> None:
        found = verify(Workspace(store), deep=True)
        corrupt.extend(found.faults)
        now = digests(store)
        if done:
            lost.extend(sorted(wanted.keys() - now.keys()))
        corrupt.extend(f"{k}: another folder" for k, d in now.items() if wanted[k] != d)

    clock = time.monotonic()
    tally = soak(
        tmp_path / "soak", works, kills=KILLS, writers=WRITERS, seed=SEED, deadline=clock + 60 * MINUTES, check=check
    )
    with capsys.disabled():
        if "BANMO_SOAK_KILLS" in os.environ:
            sys.stdout.write(
                f"\nwriters {WRITERS}  kills {tally.kills}  rounds {tally.rounds}  finished writers {tally.finished}  "
                f"deep checks {tally.checks}  lost {len(lost)}  corrupt {len(corrupt)}  "
                f"seconds {time.monotonic() - clock:.0f}\n"
            )
    assert not corrupt and not lost
    assert tally.failures == 0 and tally.kills >= min(KILLS, 10)
