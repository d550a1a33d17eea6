"""The whole product, through its real command line, on two tiny generated clips."""

from __future__ import annotations

import atexit
import functools
import hashlib
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from synthetic.clips import write_clips

ROOT = Path(__file__).resolve().parent.parent.parent


@functools.cache
def snapshot() -> Path:
    """A copy of the program, so that editing the checkout while the tests run changes nothing under them."""
    folder = Path(tempfile.mkdtemp(prefix="banmo-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy_program(ROOT, folder)
    return folder


def copy_program(source: Path, target: Path) -> None:
    """Copy what ``banmo`` consists of."""
    for package in ("pipeline", "stages", "workspace_template"):
        shutil.copytree(source / package, target / package, ignore=shutil.ignore_patterns("__pycache__"))


# A reconstruction in seconds: what it looks like is nobody's concern here.
TINY = (
    *("--fit.iterations=120", "--fit.voxel=0.07", "--fit.bones=6", "--fit.renew_at=0.5"),
    *("--correct.iterations=30", "--refine.iterations=60"),
    *(f"--{phase}.{key}" for phase in ("fit", "correct", "refine") for key in (
        "frames_per_step=4", "pixels_per_frame=24", "probe_samples=16", "fine_samples=4", "match_pixels=16"
    )),
    *("--export.resolution=48", "--export.faces=600", "--export.texture_px=128", "--export.video_side_px=96"),
    "--export.turntable_frames=6",
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: int
    out: str
    err: str
    cpu_s: float = 0.0

    @property
    def text(self) -> str:
        return self.out + self.err


Banmo = Callable[..., Outcome]


def environment() -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("BANMO_")}
    return kept | {"OMP_NUM_THREADS": "1", "GOMP_SPINCOUNT": "2000", "COLUMNS": "160"}


def run_banmo(
    *words: object,
    code: Path | None = None,
    python: tuple[str, ...] = (),
    before: tuple[str, ...] = (),
    timeout_s: float = 3000.0,
) -> Outcome:
    """Run ``banmo`` with the code in `code`, as a user would; `python` are options of the interpreter."""
    code = code or snapshot()
    command = [*before, sys.executable, *python, "-m", "pipeline.cli", *map(str, words)]
    variables = environment() | {"PYTHONPATH": str(code)}
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=timeout_s, env=variables, cwd=code, check=False
    )
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    return Outcome(done.returncode, done.stdout, done.stderr, cpu_s)


@pytest.fixture(scope="session")
def banmo() -> Banmo:
    return run_banmo


@pytest.fixture(scope="session")
def tiny() -> tuple[str, ...]:
    """Settings that make a whole run take seconds."""
    return TINY


@pytest.fixture(scope="session")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips with true masks and root poses beside them, read-only."""
    folder = tmp_path_factory.mktemp("clips")
    write_clips(folder, clips=2, frames=8, size=72, seed=3, truth=True)
    for path in folder.iterdir():
        path.chmod(0o444)
    return folder


@pytest.fixture(scope="session")
def contracts(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache of a workspace that has read the stages' contracts, which imports torch and takes seconds."""
    workspace = tmp_path_factory.mktemp("contracts") / "workspace"
    outcome = run_banmo("run", clips, "--workspace", workspace, "--until", "frames", "--dry-run")
    assert outcome.code == 0, outcome.text
    return workspace / "cache"


@pytest.fixture(scope="session")
def finished(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """A workspace in which everything has run once, undisturbed, and what the run said. Copy it before changing it."""
    workspace = tmp_path_factory.mktemp("finished") / "workspace"
    return workspace, run_banmo("run", clips, "--workspace", workspace, *TINY)


@pytest.fixture
def copy_of_finished(finished: tuple[Path, Outcome], tmp_path: Path) -> Path:
    """A workspace of one's own in which everything has run."""
    target = tmp_path / "copy"
    shutil.copytree(finished[0], target, symlinks=True)
    return target


@pytest.fixture
def untouched() -> Iterator[Callable[[Path], None]]:
    """Call it with a folder of the user: after the test, nothing in it may have changed."""
    before: dict[Path, dict[str, str]] = {}

    def watch(folder: Path) -> None:
        before[folder] = contents(folder)

    yield watch
    for folder, known in before.items():
        assert contents(folder) == known, f"{folder} was changed"


def contents(folder: Path) -> dict[str, str]:
    """Relative path -> kind, mode, time and digest of everything in a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        status = path.lstat()
        facts = f"{status.st_mode:o} {status.st_mtime_ns}"
        if path.is_file() and os.access(path, os.R_OK):
            facts += " " + hashlib.sha256(path.read_bytes()).hexdigest()
        found[str(path.relative_to(folder))] = facts
    return found


def check_store(workspace: Path) -> int:
    """Recompute every digest of the store without the engine's help; returns how many folders there are."""
    objects = workspace / "objects"
    count = 0
    for kind in sorted(objects.iterdir()) if objects.is_dir() else []:
        for folder in sorted(p for p in kind.iterdir() if p.is_dir()):
            manifest = kind / f"{folder.name}.sha256"
            assert manifest.is_file(), f"{folder} has no manifest: a partial object"
            text = manifest.read_bytes()
            assert hashlib.sha256(text).hexdigest() == folder.name
            listed = {}
            for line in text.decode().splitlines():
                digest, _, name = line.lstrip("\\").partition("  ")
                listed[name] = digest
            present = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
            assert set(present) == set(listed), f"{folder}: files differ from its manifest"
            for name, path in present.items():
                assert hashlib.sha256(path.read_bytes()).hexdigest() == listed[name], path
            count += 1
    return count


def view(workspace: Path) -> dict[str, str]:
    """What the last run shows: place in the view -> digest of the folder it links to."""
    root = (workspace / "latest").resolve()
    links = {}
    for current, folders, names in os.walk(root):
        for name in [*folders, *names]:
            path = Path(current) / name
            if path.is_symlink():
                links[str(path.relative_to(root))] = Path(os.readlink(path)).name
    return links
