"""Workers that misbehave, many runs at once, `gc` among them: nothing wrong is stored, and the next run heals."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from pipeline.videos import SourceDigests
from tests.engine.laboratory import Lab, wait_for

PLACE = "    hint = given"
ONE = ("--until", "words", "--video", "cat")
MANY = int(os.environ.get("BANMO_FAULT_RUNS", "8"))
FULL_DISKS = int(os.environ.get("BANMO_FULL_DISKS", "4"))
GC_ROUNDS = int(os.environ.get("BANMO_GC_ROUNDS", "2"))


def sabotage(lab: Lab, *statements: str) -> None:
    """Statements that the worker of `words` runs before it works."""
    lab.edit("words.py", PLACE, "".join(f"    {s}\n" for s in statements) + PLACE)


def clean(lab: Lab) -> None:
    """Nothing wrong is stored and no scratch is left."""
    found = lab.command("verify", "--deep")
    assert found.code == 0, found.out
    assert not list((lab.workspace / "tmp").glob("try-*"))


STRANGE_ENDS = {
    "segfault": (["import ctypes", "ctypes.string_at(0)"], "crashed (SIGSEGV) in native code"),
    "abort": (["os.abort()"], "crashed (SIGABRT) in native code"),
    "out of memory": (["os.kill(os.getpid(), 9)"], "the machine ran out of memory"),  # as the kernel's killer does
    "no memory": (["import resource", "resource.setrlimit(resource.RLIMIT_AS, (1 << 28, 1 << 28))",
                   "bytearray(1 << 30)"], "MemoryError"),
    "silent exit": (["os._exit(0)"], "ended with status 0 without saying why"),
    "odd exit": (["sys.exit('enough')"], "SystemExit: enough"),
    "stopped by nobody": (["os._exit(75)"], "although nobody asked"),
    "forged outcome": (["Path('outcome.json').write_text('{\"status\": \"done\"}')", "os._exit(0)"], "left no record"),
    "garbage outcome": (["Path('outcome.json').write_bytes(os.urandom(500))", "os._exit(1)"], "without saying why"),
    "out is gone": (["import shutil", "shutil.rmtree(out)"], "No such file"),
    "endless nesting": (["f = lambda n: f(n + 1)", "f(0)"], "RecursionError"),
}  # fmt: skip


@pytest.mark.parametrize("name", STRANGE_ENDS)
def test_a_worker_that_ends_strangely_publishes_nothing(lab: Lab, name: str) -> None:
    statements, told = STRANGE_ENDS[name]
    sabotage(lab, *statements)
    outcome = lab.run(*ONE)
    assert outcome.code == 1 and told in outcome.err, outcome.out + outcome.err
    assert "Traceback" not in outcome.err and not list((lab.workspace / "objects").glob("*/*"))
    clean(lab)


def test_garbage_on_every_channel_changes_nothing(lab: Lab) -> None:
    """Standard output and error, the events, the meeting place of ranks, odd files in the scratch."""
    quiet = lab.root / "quiet"
    lab.command("run", "--definition", str(lab.package), *ONE, str(lab.clips))
    wanted = lab.digests()
    lab.workspace.rename(quiet)
    sabotage(
        lab,
        "sys.stdout.buffer.write(os.urandom(1 << 20)); sys.stdout.buffer.flush()",
        "sys.stderr.buffer.write(b'\\x1b[2J\\x00\\xff' * 1000); sys.stderr.buffer.flush()",
        "open('events.jsonl', 'ab').write(b'{torn\\n[]\\n7\\n\\xff\\xfe\\n' + b'[' * 100000 + b'\\n{\"event\": 7}\\n')",
        'open(\'events.jsonl\', \'ab\').write(b\'{"event": "progress", "done": "x", "total": []}\\n\')',
        'open(\'events.jsonl\', \'ab\').write(b\'{"event": "done"}\\n{"event": "launched", "label": 3}\\n\')',
        "Path('meet-alone.json').write_text('{')",
        "os.mkfifo('pipe'); os.chdir('/')",
    )
    outcome = lab.run(*ONE)
    assert outcome.code == 0, outcome.out + outcome.err
    assert "\x1b" not in outcome.out + outcome.err
    assert lab.digests() == wanted
    clean(lab)


def test_what_a_worker_leaves_running_ends_with_it(lab: Lab) -> None:
    mark = lab.root / "pid"
    start = f"Path({str(mark)!r}).write_text(str(subprocess.Popen(['sleep', '600']).pid))"
    sabotage(lab, "import subprocess", start)
    assert lab.run(*ONE).code == 0
    left = int(mark.read_text())
    wait_for(lambda: not psutil.pid_exists(left) or psutil.Process(left).status() == psutil.STATUS_ZOMBIE, 30)


def finish(child: subprocess.Popen[str]) -> tuple[int, str]:
    out, err = child.communicate(timeout=300)
    return child.returncode, out + err


@pytest.mark.parametrize("how", ["frozen", "deaf to SIGTERM"])
def test_a_worker_that_hangs_is_killed_after_the_grace_period(lab: Lab, how: str) -> None:
    mark = lab.root / "ready"
    deaf = "signal.signal(signal.SIGTERM, signal.SIG_IGN)"
    hang = "signal.raise_signal(signal.SIGSTOP)" if how == "frozen" else "time.sleep(600)"
    sabotage(lab, deaf, f"Path({str(mark)!r}).touch()", hang)
    child = lab.spawn(*ONE, "--execution.grace_s", "0.5")
    wait_for(mark.exists)
    started = time.monotonic()
    child.send_signal(signal.SIGTERM)
    code, told = finish(child)
    assert code == 75 and "did not stop in time" in told, told
    assert time.monotonic() - started < 60
    clean(lab)


def test_a_worker_without_a_sign_of_life_is_mentioned_once(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the user can know whether it hangs: it is told, and not killed."""
    monkeypatch.setattr("pipeline.scheduler._SILENT_S", 0.3)
    outcome = lab.run(*ONE, "--words.count", "1", "--words.delay_s", "2")
    assert outcome.code == 0
    assert outcome.out.count("banmo log words cat") == 1, outcome.out


# ---------------------------------------------------------------------- many at once


def test_eight_runs_at_once(lab: Lab) -> None:
    """Half of them with another setting, all in one workspace from the very start: none fails, all is made."""
    ways: tuple[tuple[str, ...], ...] = ((), ("--upper.mark", "?"))
    children = [lab.spawn("--words.delay_s", "0.02", *ways[i % 2]) for i in range(MANY)]
    results = [finish(child) for child in children]
    assert [code for code, _ in results] == [0] * MANY, results
    assert len({p.name for p in (lab.workspace / "runs").iterdir()}) == MANY
    for way in ways:
        assert lab.pending("--words.delay_s", "0.02", *way) == {}
    made = {p.parent.name: 0 for p in (lab.workspace / "actions").glob("*/*.json")}
    for path in (lab.workspace / "actions").glob("*/*.json"):
        made[path.parent.name] += 1
    assert made == {"words": 2, "measure": 2, "upper": 4, "merge": 2, "final": 2}
    clean(lab)


def age(lab: Lab) -> None:
    then = time.time() - 2 * 86400
    for place in ("actions/*/*", "objects/*/*", "runs/*", "checkpoints/*", "tmp/*"):
        for path in lab.workspace.glob(place):
            with contextlib.suppress(FileNotFoundError):
                os.utime(path, (then, then), follow_symlinks=False)


def test_gc_among_runs_takes_nothing_that_they_read(lab: Lab) -> None:
    """Old results that a starting run has planned with are not collected under it, or it plans anew."""
    lab.run("--upper.mark", "a")
    lab.run("--upper.mark", "b")
    for i in range(GC_ROUNDS):
        mark = "ab"[i % 2]
        for path in (lab.workspace / "actions" / "final").iterdir():
            path.unlink()  # so that there is something to do, with old results
        age(lab)
        child = lab.spawn("--upper.mark", mark)
        while child.poll() is None:
            age(lab)
            assert lab.command("gc", "--keep", "1", "--apply").code in (0, 2)
        code, told = finish(child)
        assert code == 0, told
        clean(lab)


def test_gc_between_plan_and_start_is_planned_anew(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """The narrow place of the test above, hit for sure: old results that this plan stands on go before it starts."""
    few = ("--until", "upper", "--video", "cat")
    lab.run(*few)
    lab.run(*few, "--words.count", "2")
    age(lab)
    save, collected = SourceDigests.save, []

    def save_and_collect(self: SourceDigests) -> None:
        save(self)
        if not collected:
            collected.append(lab.command("gc", "--keep", "1", "--apply").code)

    monkeypatch.setattr(SourceDigests, "save", save_and_collect)
    outcome = lab.run(*few, "--upper.mark", "?")
    assert collected == [0] and outcome.code == 0, outcome.out + outcome.err
    assert "words/cat: done" in outcome.out, "planned as there, made again after all"
    assert lab.pending(*few, "--upper.mark", "?") == {}
    assert all((p / "plan.json").is_file() for p in (lab.workspace / "runs").iterdir())
    clean(lab)


def test_gc_refuses_while_a_worker_outlives_its_run(lab: Lab) -> None:
    lab.run("--until", "words")
    child = lab.spawn("--merge.steps", "1000", "--merge.delay_s", "0.1", "--merge.deaf", "--execution.grace_s", "600")
    wait_for(lambda: list((lab.workspace / "checkpoints").glob("*/step.txt")))
    workers = psutil.Process(child.pid).children(recursive=True)
    child.kill()
    child.communicate()
    age(lab)
    refused = lab.command("gc", "--keep", "1", "--apply")
    for worker in workers:
        with contextlib.suppress(psutil.NoSuchProcess):
            worker.kill()
    assert refused.code == 2 and "at work" in refused.err
    psutil.wait_procs(workers, timeout=30)
    assert lab.command("gc", "--keep", "1", "--apply").code == 0, "the kernel let go of the dead one's lease"
    clean_store = lab.command("verify", "--deep")
    assert clean_store.code == 0, clean_store.out


def test_gc_spares_what_a_job_in_the_queue_will_need(lab: Lab) -> None:
    """A cluster may let a job wait for days, and nobody holds anything meanwhile."""
    lab.run(*ONE)
    key = "a" * 64
    attempt = lab.workspace / "tmp" / "try-2026-01-01T00-00-00-abcd-01234567"
    unfinished = lab.workspace / "checkpoints" / key
    for folder in (attempt, unfinished):
        folder.mkdir(parents=True)
        (folder / "x").write_text("x")
    note = lab.workspace / "jobs" / f"{key}.json"
    note.parent.mkdir()
    note.write_text(json.dumps({"job": "7", "attempt": attempt.name, "log": "x"}))
    age(lab)
    assert lab.command("gc", "--apply").code == 0
    assert attempt.exists() and unfinished.exists()
    note.unlink()
    assert lab.command("gc", "--apply").code == 0
    assert not attempt.exists() and not unfinished.exists()


# ---------------------------------------------------------------------- disks that are read-only or full


def mounted(*words: str) -> None:
    """Run ``mount``; skips the test where that is not permitted."""
    try:
        done = subprocess.run(["mount", *words], capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("there is no mount here")
    if done.returncode:
        pytest.skip(f"mounting is not permitted here ({done.stderr.strip()})")


@pytest.fixture
def read_only(lab: Lab) -> Iterator[Lab]:
    """A finished workspace on a disk that can only be read, by the superuser too."""
    assert lab.run().code == 0
    place = str(lab.workspace)
    mounted("--bind", place, place)
    try:
        mounted("-o", "remount,ro,bind", place)
        yield lab
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def test_a_read_only_disk_still_serves(read_only: Lab) -> None:
    outcome = read_only.run()
    assert outcome.code == 0 and "everything is up to date: 8 results" in outcome.out, outcome.err
    for words in (("status",), ("why", "final"), ("verify", "--deep"), ("inspect", "upper", "cat"), ("gc",)):
        outcome = read_only.command(*words)
        assert outcome.code == 0, (words, outcome.err)
    outcome = read_only.run("--upper.mark", "?")
    assert outcome.code == 2 and outcome.err.count("\n") == 1 and "Read-only" in outcome.err, outcome.err


@pytest.fixture
def small_disk(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The workspace on a file system of its own that holds two megabytes, which nobody is told beforehand."""
    monkeypatch.setattr("pipeline.commands.run.check_disk", lambda *_: None)
    lab.workspace.mkdir()
    mounted("-t", "tmpfs", "-o", "size=2m", "banmo-test", str(lab.workspace))
    yield lab.workspace
    subprocess.run(["umount", "-l", str(lab.workspace)], check=True)


def leave(workspace: Path, room: int) -> None:
    """Fill the disk until only `room` bytes are left."""
    status = os.statvfs(workspace)
    with (workspace / "ballast").open("wb") as file:
        file.write(bytes(max(0, status.f_bavail * status.f_frsize - room)))


@pytest.mark.parametrize("room", [4096 * i for i in range(0, 32, max(1, 32 // FULL_DISKS))])
def test_a_disk_that_fills_up_anywhere_is_survived(lab: Lab, small_disk: Path, room: int) -> None:
    """With more and more room the disk fills up at later and later steps. Never a half result, never a traceback."""
    few = ("--until", "upper", "--video", "cat")
    assert lab.run(*few, "--words.count", "2").code == 0, "contracts are cached, one set of results is there"
    before = lab.digests()
    leave(small_disk, room)
    outcome = lab.run(*few)
    assert "Traceback" not in outcome.err
    if outcome.code:
        assert outcome.code == 2 and "the disk is full; free some space" in outcome.err, outcome.err
    sound = lab.command("verify", "--deep")
    assert sound.code == 0, sound.out
    (small_disk / "ballast").unlink()
    assert lab.run(*few).code == 0
    assert set(lab.digests()) == {"words/cat", "upper/cat"} and before
    assert lab.pending(*few) == {} == lab.pending(*few, "--words.count", "2")
    clean(lab)
