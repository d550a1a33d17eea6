"""Stopping, resuming, and several commands at once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import psutil

from tests.engine.laboratory import Lab, wait_for

SLOW = ("--merge.steps", "12", "--merge.delay_s", "0.25")


def steps_done(lab: Lab) -> int:
    files = list((lab.workspace / "checkpoints").glob("*/step.txt"))
    return int(files[0].read_text()) if files else 0


def finish(child: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = child.communicate(timeout=120)
    return child.returncode, out, err


def merged_first_step(lab: Lab) -> int:
    """Where the last merge went on from, as its log says."""
    logs = sorted(lab.workspace.glob("runs/*/logs/merge.txt"), key=lambda p: p.stat().st_mtime_ns)
    return int(logs[-1].read_text().split("first step ")[1].split(",")[0])


def test_ctrl_c_checkpoints_and_the_next_run_goes_on(lab: Lab) -> None:
    child = lab.spawn(*SLOW)
    wait_for(lambda: steps_done(lab) >= 2)
    assert "running" in lab.command("status").out
    child.send_signal(signal.SIGINT)
    code, out, err = finish(child)
    assert code == 130, out + err
    assert "stopped; the same command goes on from here" in err
    assert "1 stopped" in out
    reached = steps_done(lab)
    assert 2 <= reached < 12
    status = lab.command("status", *SLOW, "--json").json["nodes"]
    assert [s["state"] for s in status if s["stage"] == "merge"] == ["stopped"]
    assert lab.command("verify", "--deep").code == 0
    assert lab.run(*SLOW).code == 0
    assert merged_first_step(lab) == reached
    assert not list((lab.workspace / "checkpoints").iterdir()), "success empties the checkpoints"
    assert "12" in (lab.workspace / "exports" / "parts" / "steps.txt").read_text()


def test_sigterm_ends_with_75(lab: Lab) -> None:
    child = lab.spawn(*SLOW)
    wait_for(lambda: steps_done(lab) >= 1)
    child.terminate()
    assert finish(child)[0] == 75


def test_a_second_ctrl_c_kills_a_deaf_worker(lab: Lab) -> None:
    child = lab.spawn(*SLOW, "--merge.deaf", "true")
    wait_for(lambda: steps_done(lab) >= 1)
    started = time.monotonic()
    child.send_signal(signal.SIGINT)
    time.sleep(0.3)
    child.send_signal(signal.SIGINT)
    assert finish(child)[0] == 130
    assert time.monotonic() - started < 30, "the grace period is 60 s"
    assert steps_done(lab) < 12


def test_a_deaf_worker_is_killed_after_the_grace_period(lab: Lab) -> None:
    child = lab.spawn("--merge.steps", "1000", "--merge.delay_s", "0.1", "--merge.deaf", "--execution.grace_s", "0.5")
    wait_for(lambda: steps_done(lab) >= 1)
    child.send_signal(signal.SIGINT)
    code, out, _ = finish(child)
    assert code == 130 and "did not stop in time" in out


def test_workers_stop_when_their_parent_dies(lab: Lab) -> None:
    child = lab.spawn(*SLOW)
    wait_for(lambda: steps_done(lab) >= 1)
    workers = psutil.Process(child.pid).children(recursive=True)
    assert workers
    os.kill(child.pid, signal.SIGKILL)
    child.communicate()
    _, alive = psutil.wait_procs(workers, timeout=30)
    assert not alive
    assert steps_done(lab) < 12, "it stopped at a checkpoint"
    assert "running" not in lab.command("status", *SLOW).out
    assert lab.run(*SLOW).code == 0
    assert merged_first_step(lab) >= 1
    assert not list((lab.workspace / "tmp").iterdir()), "the dead run's scratch is gone"


def test_a_deaf_worker_leaves_when_its_parent_dies(lab: Lab) -> None:
    child = lab.spawn("--merge.steps", "1000", "--merge.delay_s", "0.1", "--merge.deaf", "--execution.grace_s", "0.5")
    wait_for(lambda: steps_done(lab) >= 1)
    workers = psutil.Process(child.pid).children(recursive=True)
    os.kill(child.pid, signal.SIGKILL)
    child.communicate()
    assert not psutil.wait_procs(workers, timeout=30)[1]


def test_a_worker_killed_from_outside_is_a_failure_that_says_so(lab: Lab) -> None:
    child = lab.spawn(*SLOW)
    wait_for(lambda: steps_done(lab) >= 1)
    for worker in psutil.Process(child.pid).children(recursive=True):
        worker.kill()
    code, _, err = finish(child)
    assert code == 1 and "most often the machine ran out of memory" in err
    assert lab.run(*SLOW).code == 0


def test_two_runs_at_once_make_everything_once(lab: Lab) -> None:
    children = [lab.spawn("--merge.steps", "4", "--merge.delay_s", "0.2", "--words.delay_s", "0.1") for _ in range(2)]
    results = [finish(c) for c in children]
    assert [r[0] for r in results] == [0, 0], results
    ledger = list((lab.workspace / "actions").glob("*/*.json"))
    assert len(ledger) == 8
    assert lab.command("verify", "--deep").code == 0
    assert lab.pending("--merge.steps", "4", "--merge.delay_s", "0.2", "--words.delay_s", "0.1") == {}


def test_two_videos_with_equal_bytes_share_their_work(lab: Lab) -> None:
    (lab.clips / "dog.MOV").write_bytes((lab.clips / "cat.mp4").read_bytes())
    outcome = lab.run()
    assert outcome.code == 0
    assert "5 done, 3 up to date" in outcome.out


def test_gc_refuses_while_a_run_is_at_work(lab: Lab) -> None:
    lab.run("--until", "words", "--words.count", "7")
    for path in [*lab.workspace.glob("actions/*/*"), *lab.workspace.glob("objects/*/*"), *lab.workspace.glob("runs/*")]:
        os.utime(path, (1, 1), follow_symlinks=False)
    child = lab.spawn(*SLOW)
    wait_for(lambda: steps_done(lab) >= 1)
    refused = lab.command("gc", "--keep", "1", "--apply")
    repair = lab.command("verify", "--repair")
    child.send_signal(signal.SIGINT)
    finish(child)
    assert refused.code == 2 and "a run is at work" in refused.err
    assert repair.code == 2


def age(lab: Lab, seconds: float = 2 * 86400) -> None:
    """Make everything in the store look older."""
    then = time.time() - seconds
    for place in ("actions/*/*", "objects/*/*", "runs/*", "checkpoints/*", "tmp/*"):
        for path in lab.workspace.glob(place):
            os.utime(path, (then, then), follow_symlinks=False)


def test_gc_keeps_what_is_needed_and_pins(lab: Lab) -> None:
    lab.run()
    first = sorted(p.name for p in (lab.workspace / "runs").iterdir())[0]
    time.sleep(1.1)  # run ids count seconds
    lab.run("--upper.mark", "?")
    assert lab.command("gc", "--keep", "1", "--json").json["objects"] == [], "younger than a day"
    age(lab)
    lab.command("pin", first, "paper")
    assert "pinned as paper" in lab.command("pin").out
    assert lab.command("gc", "--keep", "1", "--json").json["objects"] == []
    assert lab.command("pin", "--remove", "papre").code == 2
    lab.command("pin", "--remove", "paper")
    dry = lab.command("gc", "--keep", "1", "--json").json
    assert len(dry["objects"]) == 4 and len(dry["records"]) == 4 and f"runs/{first}" in dry["folders"]
    assert "would go" in lab.command("gc", "--keep", "1").out
    assert lab.command("gc", "--keep", "5", "--json").json["objects"] == []
    assert lab.command("gc", "--keep", "1", "--apply").code == 0
    assert lab.command("verify", "--deep").code == 0
    assert lab.pending("--upper.mark", "?") == {}
    assert set(lab.pending()) == {"upper/cat", "upper/dog", "merge", "final"}


def test_gc_takes_orphans_and_abandoned_checkpoints(lab: Lab) -> None:
    lab.run()
    orphan = lab.workspace / "checkpoints" / ("0" * 64)
    orphan.mkdir(parents=True)
    (orphan / "x").write_text("x")
    folder = lab.object_path("final")
    for path in (lab.workspace / "actions" / "final").iterdir():
        path.unlink()
    age(lab)
    assert lab.command("gc", "--apply").code == 0
    assert not orphan.exists() and not folder.exists()
    assert lab.run().code == 0


def test_status_graph_inspect_log_and_doctor(lab: Lab) -> None:
    lab.run()
    rows = lab.command("status", "--json").json["nodes"]
    assert {r["state"] for r in rows} == {"ok"} and len(rows) == 8
    assert "words --> upper" in lab.command("graph").out
    assert "upper -> merge" in lab.command("graph", "--dot").out
    facts = lab.command("inspect", "upper", "cat", "--json").json[0]
    assert facts["contents"] == {"inner/*.txt": {"files": 3, "bytes": facts["bytes"]}}
    assert Path(facts["sheet"]).read_bytes().startswith(b"\x89PNG 3")
    assert "count     3" in lab.command("inspect", "words", "cat").out
    assert "an earlier result" in lab.command("inspect", "words", "cat", "--words.count", "4").out
    assert "threads 2" in lab.command("log", "merge").out or "threads 1" in lab.command("log", "merge").out
    assert lab.command("doctor").code == 0
    settings = lab.command("settings", "words")
    assert "How many files to make." in settings.out
    assert json.loads(lab.command("settings", "--json").out)["words"]["count"] == 3
    target = lab.root / "copy"
    assert lab.command("export", "--to", str(target)).code == 0
    assert (target / "final.txt").is_file()
    (lab.root / "full").mkdir()
    (lab.root / "full" / "x").write_text("x")
    assert lab.command("export", "--to", str(lab.root / "full")).code == 2


def test_later_commands_see_the_last_run(lab: Lab) -> None:
    lab.run("--upper.mark", "?")
    states = {r["state"] for r in lab.command("status", "--json").json["nodes"]}
    assert states == {"ok"}, "with the settings of the last run"
    assert "settings  mark  ! -> ?" not in lab.command("why", "upper").out


def test_settings_of_a_run_can_be_passed_back(lab: Lab) -> None:
    lab.run("--upper.mark", '?"\\', "--words.count", "4")
    written = next(iter(lab.workspace.glob("runs/*/settings.toml"))).read_text()
    (lab.workspace / "pipeline.toml").write_text(written)
    assert lab.pending() == {}
