"""A workspace on disk: where everything lies, and who may touch it.

::

    pipeline.toml          the settings
    latest -> runs/…/view  what the last run looks at
    exports/               real copies of the last stage's files
    runs/<id>/             plan.json settings.toml events.jsonl logs/ view/
    objects/ actions/      the store and its ledger
    checkpoints/<key>/     unfinished work
    tmp/<attempt>/         scratch
    leases/ cache/         locks and memos; both may be removed while nothing runs
    jobs/<key>.json        the cluster's job that works on an action
    FORMAT                 1
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pipeline.errors import BadInput
from pipeline.files import read_json, remove_tree, unique, write_atomic, write_memo
from pipeline.ledger import Ledger
from pipeline.objects import Objects

FORMAT = "1"


class Workspace:
    """One reconstruction's folder."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.tmp = self.root / "tmp"
        self.runs = self.root / "runs"
        self.cache = self.root / "cache"
        self.checkpoints = self.root / "checkpoints"
        self.leases = self.root / "leases"
        self.jobs = self.root / "jobs"
        self.exports = self.root / "exports"
        self.attempts = self.cache / "attempts"
        self.settings_path = self.root / "pipeline.toml"
        self.objects = Objects(self.root / "objects", seen=self.cache / "seen", tmp=self.tmp)
        self.ledger = Ledger(self.root / "actions")

    @classmethod
    def open(cls, root: Path, *, create: bool = False, template: Path | None = None) -> Workspace:
        """Open a workspace, or make one from a `template` folder.

        Raises BadInput when it is not one, or of a later format.
        """
        workspace = cls(root)
        mark = workspace.root / "FORMAT"
        if mark.is_file():
            found = mark.read_text(encoding="utf-8", errors="replace").strip()
            if found != FORMAT:
                raise BadInput(
                    f"this workspace has format {found!r}, this version reads {FORMAT}", where=workspace.root
                )
            return workspace
        if not create:
            raise BadInput(
                "no workspace here",
                where=workspace.root,
                hint="`banmo run VIDEOS` makes one, or name it by --workspace",
            )
        workspace.create(template)
        return workspace

    def create(self, template: Path | None = None) -> None:
        """Make the folder from the template; what is there already stays as it is."""
        if self.root.exists() and not self.root.is_dir():
            raise BadInput("this is a file, not a folder", where=self.root)
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            if template is not None and template.is_dir():
                for path in sorted(template.iterdir()):
                    if path.is_file() and path.name != "__init__.py" and not (self.root / path.name).exists():
                        shutil.copyfile(path, self.root / path.name)
            write_atomic(self.root / "FORMAT", FORMAT + "\n")
        except OSError as error:
            raise BadInput(
                f"cannot write here ({error.strerror})", where=self.root, hint="choose another --workspace"
            ) from error

    # ------------------------------------------------------------------ what the workspace remembers

    def remembered(self) -> dict[str, Any]:
        """The videos folder and the command-line settings of the last run."""
        value = read_json(self.root / "inputs.json")
        return value if isinstance(value, dict) else {}

    def remember(self, value: dict[str, Any]) -> None:
        """Keep them for later commands."""
        if value != self.remembered():
            write_memo(self.root / "inputs.json", value)

    # ------------------------------------------------------------------ locks

    def lease(self, key: str) -> FileLock:
        """Held by the worker of an action. The kernel drops it when its holder dies."""
        return self._lock(self.leases / f"{key}.lock")

    def run_lock(self, run: str) -> FileLock:
        """Held by a run while it is alive."""
        return self._lock(self.leases / f"run-{run}.lock")

    @contextmanager
    def exclusive(self, timeout_s: float = 60.0) -> Iterator[None]:
        """Nobody else starts a run, collects or repairs meanwhile."""
        try:
            with self._lock(self.leases / "workspace.lock").acquire(timeout=timeout_s):
                yield
        except Timeout as error:
            raise BadInput(
                f"another command has kept this workspace busy for {timeout_s:.0f} s", where=self.root
            ) from error

    def live(self) -> list[str]:
        """Names of the leases and runs that somebody holds now."""
        held = []
        for path in sorted(self.leases.glob("*.lock")) if self.leases.is_dir() else []:
            if path.name != "workspace.lock" and self.held(path):
                held.append(path.stem)
        return held

    @staticmethod
    def held(path: Path) -> bool:
        """Whether a living process holds this lock."""
        if not path.exists():
            return False
        lock = FileLock(path)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return True
        lock.release()
        return False

    def collection(self) -> str:
        """Changes whenever ``gc`` or a repair takes something away: what was planned before may miss it."""
        try:
            return (self.cache / "collected").read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return ""

    def collected(self) -> None:
        """Something is about to be taken away, under the exclusive lock."""
        write_atomic(self.cache / "collected", unique())

    def _lock(self, path: Path) -> FileLock:
        path.parent.mkdir(parents=True, exist_ok=True)
        return FileLock(path)

    # ------------------------------------------------------------------ scratch

    def clean_scratch(self) -> None:
        """Remove scratch of attempts that nobody works on any more (their lock is free and so is their run's)."""
        if not self.tmp.is_dir():
            return
        queued = self.attempts_of_jobs()
        for attempt in self.tmp.iterdir():
            run = re.match(r"try-(.+)-[0-9a-f]{8}$", attempt.name)
            if run is None or attempt.name in queued:
                continue
            if self.held(attempt / "alive.lock") or self.held(self.leases / f"run-{run[1]}.lock"):
                continue
            remove_tree(attempt)

    def attempts_of_jobs(self) -> set[str]:
        """Names of the attempts that wait or run on a cluster."""
        notes = [read_json(p) for p in self.jobs.glob("*.json")] if self.jobs.is_dir() else []
        return {str(n.get("attempt")) for n in notes if isinstance(n, dict)}

    def free_bytes(self) -> int:
        """Bytes an ordinary user may still write."""
        status = os.statvfs(self.root)
        return status.f_bavail * status.f_frsize
