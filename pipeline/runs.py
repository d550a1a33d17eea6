"""One folder a run: plan.json, settings.toml, events.jsonl, logs, and a view of links to what it looked at."""

from __future__ import annotations

import contextlib
import os
import time
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from pipeline.events import EventWriter
from pipeline.files import read_json, relink, remove_tree, unique, write_atomic, write_json
from pipeline.graph import Node
from pipeline.workspace import Workspace

_STAMP = "%Y-%m-%dT%H-%M-%S"
_SECONDS = len("2026-09-28T10-15-00")


class RunFolder:
    """The folder of one run. Holding it holds the run's lock, by which others see that it is alive.

    Its id is the local time of its start; where an earlier run has that time or a later one (clocks are set back, in
    autumn all of them are), the second after that run's: ids tell the order of the runs whatever the clock did.
    """

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace

    def open(self) -> None:
        """Create the folder and take the lock."""
        with self.workspace.exclusive():
            self.id = _stamp_after(self.workspace.runs) + "-" + unique()[-4:]
            self.path = self.workspace.runs / self.id
            self.view = self.path / "view"
            self._lock = self.workspace.run_lock(self.id)
            self._lock.acquire()
            self.view.mkdir(parents=True)
        self.events = EventWriter(self.path / "events.jsonl")

    def close(self) -> None:
        """Let go of the lock."""
        self.events.close()
        self._lock.release()
        Path(self._lock.lock_file).unlink(missing_ok=True)

    def discard(self) -> None:
        """Let go of the lock, and leave no trace: nothing was run."""
        self.close()
        remove_tree(self.path)

    def log_path(self, node: Node) -> Path:
        """Log of one action of this run."""
        return self.path / "logs" / f"{node.label.replace('/', '-')}.txt"

    def write_plan(self, value: dict[str, Any], settings_toml: str) -> None:
        """Keep the plan and the merged settings."""
        write_json(self.path / "plan.json", value)
        write_atomic(self.path / "settings.toml", settings_toml)

    def link(self, node: Node, digest: str) -> None:
        """Show a result in the view."""
        place = view_place(self.view, node.info.name, node.video_name)
        target = self.workspace.objects.path(node.info.name, digest)
        relink(place, os.path.relpath(target, place.parent))

    def make_latest(self) -> None:
        """Let ``latest`` point at this run's view."""
        relink(self.workspace.root / "latest", os.path.relpath(self.view, self.workspace.root))


def view_place(view: Path, stage: str, video: str | None) -> Path:
    """Where a view shows a stage's folder."""
    return view / "videos" / video / stage if video else view / stage


def _stamp_after(runs: Path) -> str:
    """The time now, or the second after the newest run where that is later."""
    now = time.strftime(_STAMP)
    stamps = [p.name[:_SECONDS] for p in runs.iterdir()] if runs.is_dir() else []
    newest = max((s for s in stamps if s >= now and s[:1].isdigit()), default="")
    try:
        return (datetime.strptime(newest, _STAMP) + timedelta(seconds=1)).strftime(_STAMP) if newest else now
    except (ValueError, OverflowError):  # no name of ours
        return now


def list_runs(workspace: Workspace) -> list[str]:
    """Ids of the runs, newest first."""
    if not workspace.runs.is_dir():
        return []
    found = []
    for folder in workspace.runs.iterdir():
        with contextlib.suppress(OSError):  # ids tell seconds only: runs of one second go by when they were planned
            found.append((folder.name[:_SECONDS], (folder / "plan.json").stat().st_mtime_ns, folder.name))
    return [name for _, _, name in sorted(found, reverse=True)]


def read_plan(workspace: Workspace, run: str) -> dict[str, Any]:
    """The plan of a run, empty when unreadable."""
    value = read_json(workspace.runs / run / "plan.json")
    return value if isinstance(value, dict) else {}


def shows(workspace: Workspace, wanted: dict[tuple[str, str | None], str]) -> bool:
    """Whether ``latest`` shows exactly these (stage, video) -> digest."""
    latest = workspace.root / "latest"
    for (stage, video), digest in wanted.items():
        place = view_place(latest, stage, video)
        try:
            if os.path.basename(os.readlink(place)) != digest:
                return False
        except OSError:
            return False
    videos = latest / "videos"
    names = {p.name for p in videos.iterdir()} if videos.is_dir() else set()
    return names == {video for _, video in wanted if video}
