"""Slurm for real: arrays, GPUs, several nodes, preemption, time limits, cancelling, going on after a dead launcher.

Traps of submitit and Slurm, and what holds each off: its local executor gives every job GPU 0 and cannot preempt (it is
not used; these tests run on Slurm); job states come from accounting that may be absent (this cluster has none);
preemption near the limit counts as a timeout (`_MOST_REQUEUES`); a requeue waits two minutes (`hasten`); the
checkpoint hook runs in a signal handler of the first task (`RunRequest.checkpoint`); a pickled function may meet edited
code (`test_code_edited_while_queued_is_refused`).
"""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest

from pipeline.ledger import Record
from tests.engine.laboratory import Lab, wait_for
from tests.slurm.cluster import Cluster

SLURM = ("--executor", "slurm")
TWO = ("--execution.ranks", "2", "--execution.nodes", "2")
SLOW = ("--train.steps", "40", "--train.delay_s", "0.4")
PATIENCE_S = 240.0


def train_of(lab: Lab) -> Record:
    return lab.records()["train"]


def losses(lab: Lab) -> list[float]:
    found: list[float] = json.loads((lab.object_path("train") / "losses.json").read_text())
    return found


def steps_done(lab: Lab) -> int:
    for path in (lab.workspace / "checkpoints").glob("*/state.json"):
        return int(json.loads(path.read_text())["step"])
    return 0


def starts(lab: Lab, rank: int = 0) -> list[int]:
    """Steps from which a rank of `train` has gone on, in order of time, as the kept logs say."""
    name = "train.txt" if rank == 0 else f"train.rank-{rank}.txt"
    paths = sorted(lab.workspace.glob(f"runs/*/logs/{name}"), key=lambda p: p.parent.parent.name)
    lines = [line for p in paths for line in p.read_text().splitlines() if "goes on from step" in line]
    return [int(line.rsplit(" ", 1)[1]) for line in lines]


def job_of_train(lab: Lab, cluster: Cluster) -> str:
    notes = [json.loads(p.read_text()) for p in (lab.workspace / "jobs").glob("*.json")]
    assert len(notes) == 1
    return str(notes[0]["job"])


def hasten(cluster: Cluster) -> None:
    """Slurm lets a requeued job wait for two minutes; not here."""
    for line in cluster.command("squeue", "-h", "-t", "pending", "-o", "%i %r").splitlines():
        if "BeginTime" in line:
            cluster.command("scontrol", "update", f"JobId={line.split()[0]}", "StartTime=now")


def finish(child: subprocess.Popen[str], cluster: Cluster) -> tuple[int, str]:
    deadline = time.monotonic() + PATIENCE_S
    while child.poll() is None:
        hasten(cluster)
        assert time.monotonic() < deadline, "it never ended"
        time.sleep(0.5)
    out, err = child.communicate()
    return child.returncode, out + err


@pytest.fixture(scope="module")
def alone() -> list[float]:
    """Losses of forty steps in one process, worked out by hand."""
    x, data, found = 10.0, range(8), []
    for _ in range(40):
        found.append(round(sum((x - d) ** 2 for d in data) / 8, 9))
        x -= 0.1 * sum(2 * (x - d) for d in data) / 8
    return found


def test_videos_fan_out_as_one_array_with_a_gpu_each(lab: Lab) -> None:
    for i in range(2, 5):
        (lab.clips / f"c{i}.mp4").write_text(f"clip {i}")
    outcome = lab.run(*SLURM, "--until", "device", "--device.delay_s", "3")
    assert outcome.code == 0, outcome.out + outcome.err
    records = list(lab.records().values())
    assert len(records) == 5 and len({r.metrics["array"] for r in records}) == 1 and records[0].metrics["array"]
    places = {r.metrics["place"] for r in records}
    assert places == {"n1:0", "n1:1", "n2:0", "n2:1"}, "four GPUs for five clips"
    for mine in records:
        (start, end), place = mine.metrics["span"], mine.metrics["place"]
        for other in records:
            s, e = other.metrics["span"]
            if other is not mine and other.metrics["place"] == place:
                assert e <= start or s >= end, "one GPU, two jobs at once"
    assert len(list(lab.workspace.glob("runs/*/logs/device-c*.txt"))) == 5
    assert not list((lab.workspace / "jobs").iterdir()) and not list((lab.workspace / "tmp").iterdir())
    again = lab.run("--until", "device", "--device.delay_s", "3")
    assert "up to date" in again.out, "what the cluster made is a hit on this machine"


def test_two_nodes_give_the_losses_of_one_process(lab: Lab, alone: list[float]) -> None:
    assert lab.run("--until", "device").code == 0
    outcome = lab.run(*SLURM, *TWO, "--train.steps", "40")
    assert outcome.code == 0, outcome.out + outcome.err
    assert train_of(lab).metrics["nodes"] == ["n1", "n2"]
    assert losses(lab) == pytest.approx(alone, rel=1e-9)
    assert sorted(p.name for p in lab.object_path("train").iterdir()) == ["losses.json", "rank-0.txt"]
    assert starts(lab) == [0] and starts(lab, 1) == [0], "the logs of both ranks are kept"


def test_a_lost_rank_fails_the_action(lab: Lab) -> None:
    assert lab.run("--until", "device").code == 0
    outcome = lab.run(*SLURM, *TWO, "--train.lose_rank", "1")
    assert outcome.code == 1 and "train failed" in outcome.err, outcome.out + outcome.err
    assert not list((lab.workspace / "jobs").iterdir())
    assert lab.command("verify", "--deep").code == 0
    assert lab.run(*SLURM, *TWO).code == 0, "and the next run makes it"


def test_a_preempted_job_comes_again_and_goes_on(lab: Lab, cluster: Cluster, alone: list[float]) -> None:
    assert lab.run("--until", "device").code == 0
    child = lab.spawn(*SLURM, *TWO, *SLOW)
    wait_for(lambda: steps_done(lab) >= 3, PATIENCE_S)
    job = job_of_train(lab, cluster)
    urgent = cluster.command("sbatch", "--parsable", "-p", "urgent", "-N2", "--exclusive", "--wrap", "srun sleep 3",
                             "-o", "/dev/null").strip()  # fmt: skip
    assert urgent
    wait_for(lambda: "PENDING" in cluster.command("squeue", "-h", "-j", job, "-o", "%T"), PATIENCE_S)
    reached = steps_done(lab)
    assert 3 <= reached < 40, "it was saved before it had to go"
    code, told = finish(child, cluster)
    assert code == 0, told
    assert losses(lab) == pytest.approx(alone, rel=1e-9), "the same as if nothing had happened"
    assert starts(lab)[0] == 0 and starts(lab)[-1] == reached == starts(lab, 1)[-1]


def test_a_job_at_its_time_limit_comes_again(lab: Lab, cluster: Cluster, alone: list[float]) -> None:
    """Slurm's warning signal, sent by hand: limits are whole minutes."""
    assert lab.run("--until", "device").code == 0
    child = lab.spawn(*SLURM, *TWO, *SLOW)
    wait_for(lambda: steps_done(lab) >= 3, PATIENCE_S)
    job = job_of_train(lab, cluster)
    cluster.command("scancel", "--signal=USR2", job)
    wait_for(lambda: "PENDING" in cluster.command("squeue", "-h", "-j", job, "-o", "%T"), PATIENCE_S)
    code, told = finish(child, cluster)
    assert code == 0, told
    assert losses(lab) == pytest.approx(alone, rel=1e-9)
    assert starts(lab)[-1] >= 3


def test_ctrl_c_cancels_and_the_next_run_goes_on(lab: Lab, cluster: Cluster, alone: list[float]) -> None:
    assert lab.run("--until", "device").code == 0
    child = lab.spawn(*SLURM, *TWO, *SLOW)
    wait_for(lambda: steps_done(lab) >= 3, PATIENCE_S)
    child.send_signal(signal.SIGINT)
    code, told = finish(child, cluster)
    assert code == 130 and "the same command goes on from here" in told
    wait_for(lambda: not cluster.command("squeue", "-h").strip(), PATIENCE_S)
    reached = steps_done(lab)
    assert not list((lab.workspace / "jobs").iterdir())
    assert lab.run(*SLOW).code == 0, "on this machine, in one process"
    assert starts(lab)[-1] == reached >= 3
    assert losses(lab) == pytest.approx(alone, rel=1e-9)


def test_the_next_run_goes_on_with_jobs_of_a_dead_one(lab: Lab, cluster: Cluster) -> None:
    assert lab.run("--until", "device").code == 0
    first = lab.spawn(*SLURM, *TWO, *SLOW)
    wait_for(lambda: steps_done(lab) >= 2, PATIENCE_S)
    job = job_of_train(lab, cluster)
    first.kill()
    first.communicate()
    second = lab.spawn(*SLURM, *TWO, *SLOW)
    code, told = finish(second, cluster)
    assert code == 0, told
    assert f"Slurm job {job}" in told and starts(lab) == [0], "one job, started once"
    assert not list((lab.workspace / "jobs").iterdir()) and not list((lab.workspace / "tmp").iterdir())


def test_a_closed_terminal_leaves_the_jobs_at_work(lab: Lab, cluster: Cluster) -> None:
    assert lab.run("--until", "device").code == 0
    first = lab.spawn(*SLURM, *SLOW)
    wait_for(lambda: steps_done(lab) >= 2, PATIENCE_S)
    first.send_signal(signal.SIGHUP)
    assert first.wait(timeout=60) == 75
    assert job_of_train(lab, cluster) in cluster.command("squeue", "-h", "-o", "%i")
    wait_for(lambda: "train" in lab.records(), PATIENCE_S)
    outcome = lab.run(*SLURM, *SLOW)
    assert outcome.code == 0 and "up to date" in outcome.out, "it ended while nobody watched"


def test_scancel_by_hand_is_told_and_not_undone(lab: Lab, cluster: Cluster) -> None:
    assert lab.run("--until", "device").code == 0
    child = lab.spawn(*SLURM, *SLOW)
    wait_for(lambda: steps_done(lab) >= 2, PATIENCE_S)
    cluster.command("scancel", job_of_train(lab, cluster))
    code, told = finish(child, cluster)
    assert code == 1 and ("although nobody asked" in told or "CANCELLED" in told), told
    assert not cluster.command("squeue", "-h").strip()


def test_code_edited_while_queued_is_refused(lab: Lab, cluster: Cluster) -> None:
    assert lab.run("--until", "device").code == 0
    blocker = cluster.command("sbatch", "--parsable", "-N2", "--exclusive", "--wrap", "sleep 300", "-o", "/dev/null")
    wait_for(lambda: cluster.idle() == 0, PATIENCE_S)
    child = lab.spawn(*SLURM)
    wait_for(lambda: cluster.command("squeue", "-h", "-t", "pending"), PATIENCE_S)
    lab.edit("train.py", "10.0", "11.0")
    cluster.command("scancel", blocker.strip())
    code, told = finish(child, cluster)
    assert code == 1 and "the code changed after the run was planned" in told, told


def test_what_slurm_refuses_is_one_sentence(lab: Lab) -> None:
    outcome = lab.run(*SLURM, "--execution.slurm_partition", "nowhere", "--until", "device")
    assert outcome.code == 2 and "Slurm refused device" in outcome.err and "partition" in outcome.err
    assert outcome.err.count("\n") == 1
    assert not list((lab.workspace / "tmp").iterdir())


def test_logs_of_the_cluster_are_kept(lab: Lab) -> None:
    assert lab.run("--until", "device", "--video", "c0", *SLURM).code == 0
    logs = [p for p in lab.workspace.glob("runs/*/slurm/*/*.out")]
    assert logs and all(isinstance(p, Path) for p in logs)
    assert lab.command("log", "device", "c0").code == 0
