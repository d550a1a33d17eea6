"""Power cuts: at every step of publishing, and at random moments of a whole run."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

import psutil
import pytest

from tests.engine.laboratory import Lab

FAILPOINTS = (
    "before_publish",
    "after_manifest",
    "after_seal",
    "after_sync",
    "after_rename",
    "before_record",
    "after_record",
)
KILLS = int(os.environ.get("BANMO_RUN_KILLS", "5"))
SEED = int(os.environ.get("BANMO_SOAK_SEED", "0"))
BUSY = ("--words.delay_s", "0.02", "--merge.steps", "5", "--merge.delay_s", "0.05")


def undisturbed(lab: Lab, *words: str) -> dict[str, str]:
    """Digests of a run that nobody disturbs, in a workspace of its own."""
    calm = Lab(lab.root / "calm", lab.capture)
    calm.root.mkdir()
    shutil.copytree(lab.package, calm.package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(lab.clips, calm.clips)
    assert calm.run(*words).code == 0
    return calm.digests()


@pytest.mark.parametrize("name", FAILPOINTS)
def test_a_power_cut_while_publishing(lab: Lab, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    (lab.clips / "dog.MOV").unlink()
    monkeypatch.setenv("BANMO_FAILPOINT", name)
    outcome = lab.run("--until", "words")
    assert outcome.code == 1 and "SIGKILL" in outcome.err, "every worker dies there"
    clean = lab.command("verify", "--deep")
    assert clean.code == 0, clean.out
    monkeypatch.delenv("BANMO_FAILPOINT")
    assert lab.run("--until", "words").code == 0
    assert lab.digests() == undisturbed(lab, "--until", "words")
    assert lab.command("verify", "--deep").code == 0
    assert not list((lab.workspace / "tmp").iterdir())
    assert len(list((lab.workspace / "objects" / "words").iterdir())) == 2, "one folder and its seal"


def kill_everything(child: subprocess.Popen[str], *, workers_too: bool) -> None:
    """SIGKILL the process group, and the workers' own sessions as a machine that loses power would."""
    family = psutil.Process(child.pid).children(recursive=True) if workers_too else []
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    for process in family:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    child.communicate()


def test_kills_at_random_moments(lab: Lab) -> None:
    """However often it dies, what is there is whole, and in the end the folders are those of a calm run."""
    chance = random.Random(SEED)
    started = time.monotonic()
    wanted = undisturbed(lab, *BUSY)
    calm_s = time.monotonic() - started
    done = 0
    for kill in range(KILLS):
        child = lab.spawn(*BUSY)
        deadline = time.monotonic() + chance.uniform(0.05, max(1.0, 0.7 * calm_s))
        while child.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        if child.poll() is None:
            kill_everything(child, workers_too=chance.random() < 0.7)
            done += 1
        else:
            child.communicate()
        if lab.workspace.exists() and (lab.workspace / "FORMAT").exists():
            found = lab.command("verify", "--deep")
            assert found.code == 0, f"after kill {kill}: {found.out}"
        if lab.digests() == wanted:
            shutil.move(lab.workspace, lab.root / f"finished-{kill}")  # start over, to have something to kill
    assert done >= KILLS // 2
    outcome = lab.run(*BUSY)
    assert outcome.code == 0, outcome.err
    assert lab.digests() == wanted
    assert lab.command("verify", "--deep").code == 0


def test_a_full_disk_is_said_and_leaves_nothing_behind(lab: Lab) -> None:
    """A file-size limit stands in for a full disk."""
    lab.edit("words.py", "    run.metric", '    (out / "big.bin").write_bytes(bytes(30_000_000))\n    run.metric')
    lab.edit("words.py", "import os\n", "import os\nimport resource\n")
    lab.edit(
        "words.py",
        "    hint = given",
        "    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000_000, 10_000_000))\n"
        "    hint = given",
    )
    outcome = lab.run("--until", "words", "--video", "cat")
    assert outcome.code == 1 and "File too large" in outcome.err
    assert not list((lab.workspace / "objects").glob("*/*"))
    assert not list((lab.workspace / "tmp").iterdir())
    lab.edit(
        "words.py",
        "resource.setrlimit(resource.RLIMIT_FSIZE, (10_000_000, 10_000_000))",
        "raise OSError(28, 'No space')",
    )
    outcome = lab.run("--until", "words", "--video", "cat")
    assert outcome.code == 2 and "the disk is full" in outcome.err and outcome.err.count("\n") == 1
    assert lab.command("verify", "--deep").code == 0


def test_a_read_only_store_still_serves(lab: Lab) -> None:
    """Nothing needs to be written to find that everything is there."""
    if os.geteuid() == 0:
        pytest.skip("the superuser may write everywhere")
    lab.run()
    for folder in [lab.workspace, *(p for p in lab.workspace.rglob("*") if p.is_dir() and not p.is_symlink())]:
        folder.chmod(0o555)
    outcome = lab.run()
    for folder in [lab.workspace, *(p for p in lab.workspace.rglob("*") if p.is_dir() and not p.is_symlink())]:
        folder.chmod(0o755)
    assert outcome.code == 0, outcome.err


def test_a_power_cut_while_exports_are_swapped_loses_no_file_of_the_user(lab: Lab) -> None:
    assert lab.run().code == 0
    own = lab.workspace / "exports" / "my notes.txt"
    own.write_text("mine")
    child = lab.spawn("--merge.steps", "5", env={"BANMO_FAILPOINT": "between_renames"})
    child.communicate()
    assert child.returncode == -signal.SIGKILL and not own.exists(), "it died between the two renames"
    assert lab.run("--merge.steps", "5").code == 0
    assert own.read_text() == "mine" and (lab.workspace / "exports/parts/steps.txt").read_text() == "5"
    assert not list(lab.workspace.glob(".exports-retired-*"))


def test_memos_torn_by_a_crash_do_no_harm(lab: Lab) -> None:
    lab.run()
    for path in (lab.workspace / "cache").rglob("*.json"):
        path.write_text('{"torn": ')
    (lab.workspace / "inputs.json").write_text("{")
    (lab.workspace / "leases" / "x.lock").write_text("")
    outcome = lab.run()
    assert outcome.code == 0 and "everything is up to date" in outcome.out


def test_scratch_of_the_dead_is_cleared_and_of_the_living_is_not(lab: Lab) -> None:
    lab.run("--until", "words")
    dead = lab.workspace / "tmp" / "try-2020-01-01T00-00-00-dead-00000000"
    dead.mkdir()
    other = lab.workspace / "tmp" / "damaged-words-1"
    other.mkdir()
    from pipeline.workspace import Workspace

    workspace = Workspace(lab.workspace)
    alive = lab.workspace / "tmp" / "try-2020-01-01T00-00-00-live-00000000"
    alive.mkdir()
    with workspace.run_lock("2020-01-01T00-00-00-live"):
        lab.run("--until", "upper")
        assert alive.exists()
    assert not dead.exists() and other.exists()


def test_a_store_that_was_copied_elsewhere_is_whole(lab: Lab, tmp_path: Path) -> None:
    """File times differ after a plain copy: everything is hashed once, nothing is made again."""
    lab.run()
    copy = tmp_path / "copied"
    shutil.copytree(lab.workspace, copy, symlinks=True, copy_function=shutil.copyfile)
    moved = Lab(tmp_path, lab.capture)
    shutil.move(lab.workspace, tmp_path / "original")
    shutil.move(copy, moved.workspace)
    assert moved.pending() == {}
    assert moved.command("verify", "--deep").code == 0
