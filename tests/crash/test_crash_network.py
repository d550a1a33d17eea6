"""Disks that several machines write to: leases that expire and may overlap, files that show up late.

The disk is a local one; that leases are of the other kind is written into the workspace. What another machine would
hold is played by a lease with a foreign host, and by a worker that is frozen.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import threading
import time
from pathlib import Path

import psutil
import pytest

from pipeline.locks import EXPIRING, KERNEL, Locks, Patience, on_network
from pipeline.workspace import Workspace
from tests.engine.laboratory import Lab, wait_for
from tests.engine.test_engine_share import another

FAR = ("--store.locks", "expiring", "--store.expire_s", "2")
FEW = ("--until", "upper", "--video", "cat")


def worker_of(child_pid: int) -> psutil.Process:
    found: list[psutil.Process] = []

    def look() -> bool:
        for process in psutil.Process(child_pid).children(True):
            with contextlib.suppress(psutil.Error):  # some come and go
                if "pipeline.worker" in process.cmdline():
                    found.append(process)
        return bool(found)

    wait_for(look)
    return found[0]


def test_a_run_with_leases_that_expire(lab: Lab) -> None:
    assert lab.run(*FEW, *FAR).code == 0
    assert Workspace(lab.workspace).locks == Locks(EXPIRING, 2.0)
    assert lab.pending(*FEW) == {}, "which locks are used does not count"
    assert not list((lab.workspace / "leases").glob("*.lock"))
    lab.run(*FEW)  # without the setting: by the file system
    assert Workspace(lab.workspace).locks.kind == KERNEL
    assert lab.command("verify", "--deep").code == 0


def test_several_runs_at_once_with_leases(lab: Lab) -> None:
    lab.run(*FEW, *FAR, "-n")
    children = [lab.spawn(*FAR, "--words.delay_s", "0.1") for _ in range(3)]
    results = [(child.communicate(timeout=300), child.returncode) for child in children]
    assert [code for _, code in results] == [0, 0, 0], results
    assert len(list((lab.workspace / "actions").glob("*/*.json"))) == 8
    assert lab.command("verify", "--deep").code == 0


def test_a_frozen_worker_is_overtaken_and_both_end_well(lab: Lab) -> None:
    """The rule of rule five: two make the same thing, both publish it, one folder and one record stay."""
    slow = (*FEW, "--until", "words", "--words.delay_s", "0.3", *FAR)
    first = lab.spawn(*slow)
    frozen = worker_of(first.pid)
    wait_for(lambda: list((lab.workspace / "tmp").glob("try-*/out/000.txt")))
    frozen.suspend()
    second = lab.spawn(*slow)
    out, err = second.communicate(timeout=300)
    assert second.returncode == 0, out + err
    assert "another run is making this" in out and first.poll() is None
    frozen.resume()
    out, err = first.communicate(timeout=300)
    assert first.returncode == 0, out + err
    assert len(list((lab.workspace / "actions" / "words").iterdir())) == 1
    assert len(list((lab.workspace / "objects" / "words").iterdir())) == 2, "one folder and its seal"
    assert lab.command("verify", "--deep").code == 0


def test_a_killed_holder_blocks_nobody(lab: Lab) -> None:
    slow = (*FEW, "--words.delay_s", "0.5", *FAR)
    child = lab.spawn(*slow)
    worker = worker_of(child.pid)
    wait_for(lambda: [p for p in (lab.workspace / "leases").glob("*.lease") if not p.name.startswith("run-")])
    child.kill()
    worker.kill()
    child.communicate()
    started = time.monotonic()
    assert lab.run(*FEW, *FAR).code == 0
    assert time.monotonic() - started < 120
    assert lab.command("gc", "--apply").code == 0


def test_a_lease_of_a_lost_machine_expires(tmp_path: Path) -> None:
    """Its holder cannot be asked; it is watched for as long as a lease lasts, by our own clock."""
    locks = Locks(EXPIRING, 0.5)
    mine = locks.at(tmp_path / "key")
    mine.acquire()
    marker = tmp_path / "key.lease"
    text = marker.read_text()
    mine.release()
    marker.write_text(re.sub("host=.*", "host=elsewhere", text))
    assert locks.held(tmp_path / "key"), "at once, nobody can tell"
    assert not locks.held(tmp_path / "key", patience_s=5.0)


def test_gc_waits_for_leases_of_the_living_and_not_of_the_dead(lab: Lab) -> None:
    lab.run(*FEW, *FAR)
    workspace = Workspace(lab.workspace)
    run = workspace.run_lock("2026-01-01T00-00-00-live")
    with run:
        assert workspace.live() == ["run-2026-01-01T00-00-00-live"]
    assert workspace.live() == []


# ---------------------------------------------------------------------- late files


def appear(hidden: Path, place: Path, after_s: float) -> threading.Timer:
    """A folder or file that shows up later."""
    timer = threading.Timer(after_s, lambda: os.rename(hidden, place))
    timer.start()
    return timer


def hide(path: Path, to: Path) -> Path:
    if path.is_dir():
        path.chmod(0o755)
    os.rename(path, to)
    return to


@pytest.mark.parametrize("what", ["folder", "seal"])
def test_a_folder_that_shows_up_after_its_record_is_waited_for(lab: Lab, what: str) -> None:
    lab.run(*FEW, *FAR)
    place = lab.object_path("words/cat")
    place = place if what == "folder" else place.with_name(place.name + ".sha256")
    timer = appear(hide(place, lab.root / "hidden"), place, 1.0)
    assert lab.pending(*FEW, *FAR, "--store.latency_s", "20") == {}
    timer.join()
    hide(place, lab.root / "hidden")
    assert lab.pending(*FEW, *FAR, "--store.latency_s", "0.2")["words/cat"] == ["damaged"], "patience ends"
    assert lab.run(*FEW, *FAR, "--store.latency_s", "0.2").code == 0


def test_damage_is_not_waited_for(lab: Lab) -> None:
    lab.run(*FEW, *FAR)
    path = lab.object_path("words/cat") / "000.txt"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[::-1])
    started = time.monotonic()
    assert lab.pending(*FEW, *FAR, "--store.latency_s", "600")["words/cat"] == ["damaged"]
    assert time.monotonic() - started < 120


def test_a_shared_store_whose_files_arrive_late(lab: Lab, tmp_path: Path) -> None:
    lab.run(*FEW)
    place = tmp_path / "nas"
    lab.command("push", str(place))
    file = place / "objects" / "words" / lab.records()["words/cat"].digest / "001.txt"
    hidden = tmp_path / "hidden"
    shutil.move(file, hidden)
    timer = appear(hidden, file, 1.0)
    outcome = another(lab).run(*FEW, "--store.shared", str(place))
    timer.join()
    assert outcome.code == 0 and "everything is up to date: 2 results" in outcome.out
    file.unlink()
    outcome = another(lab, "third").run(*FEW, "--store.shared", str(place), "--store.latency_s", "0.2")
    assert outcome.code == 0 and "1 done, 1 up to date" in outcome.out, "made here when it never comes"


def test_patience_is_used_up_once() -> None:
    patience, started = Patience(0.3), time.monotonic()
    assert not patience.until(lambda: False)
    for _ in range(1000):
        assert not patience.until(lambda: False)
    assert 0.3 <= time.monotonic() - started < 30
    assert patience.until(lambda: True)


def test_network_disks_are_known_by_their_file_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = "dev / ext4 rw 0 0\nnas:/x /mnt/lab nfs4 rw 0 0\nbox /mnt/lab/in\\040here tmpfs rw 0 0\n"
    real = Path.read_text
    monkeypatch.setattr(
        Path, "read_text", lambda self, *a, **k: table if str(self) == "/proc/self/mounts" else real(self, *a, **k)
    )
    assert on_network(Path("/mnt/lab/cats")) and on_network(Path("/mnt/lab"))
    assert not on_network(Path("/mnt/labs")) and not on_network(Path("/mnt/lab/in here/w")) and not on_network(tmp_path)
