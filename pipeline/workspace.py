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
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

from filelock import BaseFileLock, Timeout

from pipeline.errors import BadInput
from pipeline.files import read_json, remove_tree, unique, write_atomic, write_memo
from pipeline.ledger import Ledger
from pipeline.locks import EXPIRING, Locks
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

    @cached_property
    def locks(self) -> Locks:
        """The kind of locks that this disk asks for."""
        return Locks.of(self.leases, self.root)

    @property
    def is_far(self) -> bool:
        """Whether other machines may write here, so that files may show up late."""
        return self.locks.kind == EXPIRING

    def use_locks(self, kind: str, expire_s: float) -> None:
        """Write the choice of the user down, for all commands; ``auto`` leaves it to the file system."""
        path = self.leases / "kind"
        text = "" if kind == "auto" else f"{kind} {expire_s:g}\n"
        if text and (not path.is_file() or path.read_text(encoding="utf-8", errors="replace") != text):
            write_atomic(path, text)
        elif not text and path.is_file():
            path.unlink(missing_ok=True)
        self.__dict__.pop("locks", None)

    def lease(self, key: str) -> BaseFileLock:
        """Held by the worker of an action, until its end or death."""
        return self.locks.at(self.leases / key)

    def run_lock(self, run: str) -> BaseFileLock:
        """Held by a run while it is alive."""
        return self.locks.at(self.leases / f"run-{run}")

    @contextmanager
    def exclusive(self, timeout_s: float = 60.0) -> Iterator[None]:
        """Nobody else starts a run, collects or repairs meanwhile."""
        try:
            held = self.locks.at(self.leases / "workspace").acquire(timeout=max(timeout_s, 2 * self.locks.expire_s))
        except Timeout as error:
            raise BadInput("another command keeps this workspace busy", where=self.root) from error
        with held:
            yield

    def live(self) -> list[str]:
        """Names of the leases and runs that somebody holds now."""
        deadline = time.monotonic() + 1.5 * self.locks.expire_s if self.locks.kind == EXPIRING else 0.0
        names = [p.name.removesuffix(self.locks.suffix) for p in self.leases.glob(f"*{self.locks.suffix}")]
        return [
            name
            for name in sorted(names)
            if name != "workspace" and self.locks.held(self.leases / name, max(0.0, deadline - time.monotonic()))
        ]

    def runs_now(self, run: str) -> bool:
        """Whether this run is alive."""
        return self.locks.held(self.leases / f"run-{run}")

    def collection(self) -> str:
        """Changes whenever ``gc`` or a repair takes something away: what was planned before may miss it."""
        try:
            return (self.cache / "collected").read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return ""

    def collected(self) -> None:
        """Something is about to be taken away, under the exclusive lock."""
        write_atomic(self.cache / "collected", unique())

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
            if self.locks.held(attempt / "alive") or self.runs_now(run[1]):
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
