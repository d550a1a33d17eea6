"""Clocks that jump, and files whose times make no sense. Time may mislead people, never the store."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from pipeline import Results
from pipeline.videos import SourceDigests
from tests.engine.laboratory import Lab

YEAR_S = 365 * 86400.0


def shift(lab: Lab, seconds: float) -> None:
    """Make all that the runs so far wrote look as if the clock had been off by so much."""
    stamp = time.strftime("%Y-%m-%dT%H-%M-%S", time.localtime(time.time() + seconds))
    finished = time.strftime("%Y-%m-%dT%H:%M:%S.000Z", time.gmtime(time.time() + seconds))
    names = {}
    for i, run in enumerate(sorted((lab.workspace / "runs").iterdir())):
        names[run.name] = f"{stamp[:-1]}{i}-{run.name[-4:]}"
        run.rename(run.with_name(names[run.name]))
    for path in (lab.workspace / "actions").glob("*/*.json"):
        value = json.loads(path.read_text())
        path.write_text(json.dumps({**value, "started": finished, "finished": finished, "run": names[value["run"]]}))
    latest = lab.workspace / "latest"
    target = os.readlink(latest)
    latest.unlink()
    latest.symlink_to(target.replace(Path(target).parent.name, names[Path(target).parent.name]))
    for path in lab.workspace.rglob("*"):
        os.utime(path, (time.time() + seconds,) * 2, follow_symlinks=False)


@pytest.mark.parametrize("seconds", [-YEAR_S, 3600.0, YEAR_S], ids=["past", "in an hour", "future"])
def test_runs_before_and_after_a_jump(lab: Lab, seconds: float) -> None:
    few = ("--until", "upper", "--video", "cat")
    lab.run(*few)
    shift(lab, seconds)
    assert lab.pending(*few) == {}, "what is there serves, whenever it claims to have been made"
    assert lab.command("verify", "--deep").code == 0
    assert lab.run("--upper.mark", "?", *few).code == 0
    newest = Path(os.readlink(lab.workspace / "latest")).parent.name
    assert newest == max(p.name for p in (lab.workspace / "runs").iterdir()), "ids tell the order of the runs"
    text = (Results(lab.workspace).folder("upper", "cat") / "inner/000.txt").read_text()
    assert "?" in text and "!" not in text, "the newest run is the one that ran last"
    assert lab.command("gc", "--keep", "1", "--apply").code == 0
    assert lab.pending("--upper.mark", "?", *few) == {}
    assert lab.command("verify", "--deep").code == 0
    if seconds > 0:
        assert lab.pending(*few) == {}, "nothing from the future is old enough to go"


def test_a_jump_while_a_run_is_at_work(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """The planner's clock goes back and forth by days at every look; workers have the true one."""
    true, looks = time.time, [0]

    def drunken() -> float:
        looks[0] += 1
        return true() + (-1) ** looks[0] * 40 * 86400.0

    monkeypatch.setattr(time, "time", drunken)
    assert lab.run("--words.delay_s", "0.05").code == 0
    assert lab.pending("--words.delay_s", "0.05") == {}
    assert lab.command("gc", "--apply").code == 0
    monkeypatch.undo()
    assert lab.pending("--words.delay_s", "0.05") == {}
    assert lab.command("verify", "--deep").code == 0
    assert all(0 <= r.seconds < 3600 for r in lab.records().values()), "durations come from another clock"


def test_a_source_from_the_future_is_hashed_at_every_look(tmp_path: Path) -> None:
    """Its times cannot tell whether it was changed after we read it."""
    video, memo = tmp_path / "v.mp4", tmp_path / "memo.json"
    video.write_text("one")
    os.utime(video, (time.time() + YEAR_S,) * 2)
    digests = SourceDigests(memo)
    first = digests.of(video)
    digests.save()
    assert not memo.exists()
    video.write_text("two")
    os.utime(video, (time.time() + YEAR_S,) * 2)
    assert digests.of(video) != first
