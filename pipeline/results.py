"""What a verb of a stage (or a script) may read of a workspace, without knowing how the store works.

A verb reads published folders and writes, if at all, one folder of its own beside them; it never touches the store,
the settings or the user's videos. Everything here works on a finished or half-finished workspace, and where the
videos have since moved away.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.contract import Folder
from pipeline.definition import read_toml
from pipeline.errors import BadInput, did_you_mean
from pipeline.files import replacing, write_atomic
from pipeline.ledger import Record
from pipeline.project import Options, Project
from pipeline.reasons import words_of
from pipeline.runs import list_runs, read_plan
from pipeline.workspace import Workspace

_MARK = ".made-by-banmo"
_OURS = ("objects", "actions", "runs", "cache", "checkpoints", "leases", "tmp", "exports", "latest")


@dataclass(frozen=True)
class Ran:
    """One finished action, as the newest run that looked at it tells."""

    stage: str
    video: str | None
    seconds: float
    """Time it took, earlier attempts that it went on from included."""
    when: str
    """When it ended, UTC, ISO 8601."""
    reason: str
    """Why it ran, in a few words; "" when no run folder tells any more."""
    key: str
    digest: str
    bytes: int
    files: int
    run: str
    """Id of the run that made it."""
    metrics: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings that entered the key; files stand as ``{"file": sha256}``."""
    inputs: dict[str, Any] = field(default_factory=dict)
    """Digests of what it read: stage -> digest, or stage -> {video: digest}."""
    host: str = ""
    versions: dict[str, str] = field(default_factory=dict)


class Results:
    """The results of one workspace, for reading."""

    def __init__(self, workspace: Path) -> None:
        """Open `workspace`. Raises BadInput when there is none."""
        self._workspace = Workspace.open(workspace)

    @property
    def workspace(self) -> Path:
        """The workspace's folder, absolute."""
        return self._workspace.root

    @property
    def videos(self) -> tuple[str, ...]:
        """Names of the videos that the newest run worked on, sorted."""
        for run in self._runs:
            names = {row.get("video") for row in self._rows(run)} - {None}
            if names:
                return tuple(sorted(str(n) for n in names))
        return ()

    def folder(self, stage: str, video: str | None = None) -> Folder:
        """The newest published and intact result of a stage (of a video, by its name in the workspace).

        Raises BadInput, naming the command that makes it, when there is none.
        """
        record = self.record(stage, video)
        return Folder(self._workspace.objects.path(stage, record.digest), record.digest)

    def record(self, stage: str, video: str | None = None) -> Ran:
        """How :meth:`folder` of the same arguments came about."""
        found = self._find(stage, video)
        if found is not None:
            return self._ran(found)
        known = self._workspace.ledger.stages()
        if video is not None and self.videos and video not in self.videos:
            raise BadInput(f"there is no video {video!r} in this workspace", hint=did_you_mean(video, self.videos))
        per_video = any(r.video for r in self._workspace.ledger.all(stage)) if stage in known else False
        if video is None and per_video:
            raise BadInput(f"{stage} has one result for each video", hint=f"name one: {', '.join(self.videos[:5])}")
        what = f"{stage} has no intact result" + (f" for {video}" if video else "") + " here"
        raise BadInput(what, where=self.workspace, hint=f"banmo run --until {stage}")

    def source(self, video: str) -> Path | None:
        """The user's own file or image folder of a video; None when it is not where it was."""
        return self._sources.get(video)

    def settings(self, stage: str) -> dict[str, Any]:
        """The settings of a stage (or ``pipeline``, ``execution``) in the newest run; empty before the first.

        Settings that are none are left out; files are paths.
        """
        for run in self._runs:
            path = self._workspace.runs / run / "settings.toml"
            if path.is_file():
                found = read_toml(path).get(stage, {})
                return dict(found) if isinstance(found, dict) else {}
        return {}

    def records(self) -> list[Ran]:
        """Every result that the newest runs stand on, one for each (stage, video), oldest first."""
        chosen: dict[tuple[str, str | None], Record] = {}
        for stage in self._workspace.ledger.stages():
            for video in {r.video for r in self._workspace.ledger.all(stage)}:
                found = self._find(stage, video)
                if found is not None:
                    chosen[(stage, video)] = found
        return sorted((self._ran(r) for r in chosen.values()), key=lambda r: r.when)

    @contextmanager
    def publish_dir(self, name: str | Path) -> Iterator[Path]:
        """An empty folder to fill, moved in one step to ``workspace/<name>`` when the block ends without an error.

        What an earlier call put there is replaced; a folder that the user made is refused. An absolute `name` is
        taken as it is.
        """
        with replacing(self._target(Path(name))) as fresh:
            yield fresh
            write_atomic(fresh / _MARK, "This folder is made anew by the command that made it; keep nothing here.\n")

    # ------------------------------------------------------------------ inside

    def _target(self, name: Path) -> Path:
        plain = not name.is_absolute()
        if not name.parts or ".." in name.parts or (plain and name.parts[0] in _OURS):
            raise BadInput(f"{str(name)!r} cannot be the name of a folder of results", hint="choose another name")
        target = (self.workspace / name).resolve()
        if plain and not target.is_relative_to(self.workspace.resolve()):
            raise BadInput("this link leads out of the workspace", where=self.workspace / name, hint="remove it")
        if target.exists() and (not target.is_dir() or (any(target.iterdir()) and not (target / _MARK).is_file())):
            raise BadInput("this was not made by banmo", where=target, hint="move it away or name another folder")
        return target

    @cached_property
    def _runs(self) -> list[str]:
        return list_runs(self._workspace)

    @cached_property
    def _plans(self) -> dict[str, list[dict[str, Any]]]:
        return {}

    def _rows(self, run: str) -> list[dict[str, Any]]:
        if run not in self._plans:
            rows = read_plan(self._workspace, run).get("steps", [])
            self._plans[run] = [r for r in rows if isinstance(r, dict)] if isinstance(rows, list) else []
        return self._plans[run]

    def _find(self, stage: str, video: str | None) -> Record | None:
        """The record the newest run stands on, else the newest one; only with its folder intact."""
        tried: set[str] = set()
        for run in self._runs:
            for row in self._rows(run):
                key = row.get("key")
                if row.get("stage") != stage or row.get("video") != video or not isinstance(key, str) or key in tried:
                    continue
                tried.add(key)
                record = self._workspace.ledger.find(stage, key)
                if record is not None and self._workspace.objects.sound(stage, record.digest):
                    return record
        for record in self._workspace.ledger.all(stage):
            if record.video == video and self._workspace.objects.sound(stage, record.digest):
                return record
        return None

    def _ran(self, record: Record) -> Ran:
        return Ran(
            stage=record.stage,
            video=record.video,
            seconds=float(record.seconds),
            when=record.finished,
            reason=self._reasons.get(record.key, ""),
            key=record.key,
            digest=record.digest,
            bytes=record.bytes,
            files=record.files,
            run=record.run,
            metrics=dict(record.metrics),
            warnings=tuple(record.warnings),
            settings=dict(record.action.get("settings", {})),
            inputs=dict(record.action.get("inputs", {})),
            host=record.host,
            versions=dict(record.versions),
        )

    @cached_property
    def _reasons(self) -> dict[str, str]:
        """Key -> why it ran, from the plans of the runs."""
        found: dict[str, str] = {}
        for run in self._runs:
            for row in self._rows(run):
                key, reasons = row.get("key"), row.get("reasons")
                if isinstance(key, str) and isinstance(reasons, list) and reasons:
                    found.setdefault(key, words_of(reasons))
        return found

    @cached_property
    def _sources(self) -> dict[str, Path]:
        try:
            project = Project.open(Options(self.workspace), recall=True)
        except BadInput:  # the videos have moved away: results stay readable
            return {}
        return {v.name: v.path for v in project.videos}
