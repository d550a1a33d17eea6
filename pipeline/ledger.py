"""The records of finished actions: ``actions/<stage>/<key>.json``.

A record keeps the action's text, the folder it gave, the hash of every code file, metrics, warnings, time, host and
versions. It is written after the folder it names. A record that cannot be parsed, or whose text does not hash to its
own name, is no record.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.action import key_of_stored
from pipeline.files import failpoint, read_json, write_json

FORMAT = 1


@dataclass
class Record:
    """One finished action."""

    key: str
    stage: str
    video: str | None
    action: dict[str, Any]
    modules: dict[str, str]
    digest: str
    files: int
    bytes: int
    seconds: float
    started: str
    finished: str
    run: str
    metrics: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    host: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    blessed: dict[str, Any] | None = None
    format: int = FORMAT

    @property
    def label(self) -> str:
        """``stage/video`` or ``stage``."""
        return f"{self.stage}/{self.video}" if self.video else self.stage


class Ledger:
    """Reads and writes records."""

    def __init__(self, root: Path) -> None:
        self.root, self._root = root, str(root)
        self._cache: dict[str, list[Record]] = {}
        self._by_video: dict[str, dict[str | None, list[Record]]] = {}
        self._by_input: dict[str, dict[str, list[int]]] = {}

    def path(self, stage: str, key: str) -> Path:
        """Where the record of this key lies."""
        return Path(f"{self._root}/{stage}/{key}.json")

    def find(self, stage: str, key: str) -> Record | None:
        """The record of this key, or None."""
        return parse(read_json(self.path(stage, key)), stage, key)

    def write(self, record: Record) -> None:
        """Write a record durably, replacing an earlier one of the same key."""
        failpoint("before_record")
        write_json(self.path(record.stage, record.key), asdict(record), durable=True)
        self._cache.pop(record.stage, None)
        self._by_video.pop(record.stage, None)
        self._by_input.pop(record.stage, None)
        failpoint("after_record")

    def all(self, stage: str) -> list[Record]:
        """Every valid record of a stage, newest first. Read once; `refresh` forgets."""
        if stage not in self._cache:
            folder = self.root / stage
            names = sorted(p.stem for p in folder.glob("*.json")) if folder.is_dir() else []
            records = [r for key in names if (r := self.find(stage, key)) is not None]
            self._cache[stage] = sorted(records, key=lambda r: r.finished, reverse=True)
        return self._cache[stage]

    def of_video(self, stage: str, video: str | None) -> list[Record]:
        """The valid records of a stage that are of this video, newest first."""
        records = self.all(stage)
        if stage not in self._by_video:
            found: dict[str | None, list[Record]] = {}
            for record in records:
                found.setdefault(record.video, []).append(record)
            self._by_video[stage] = found
        return self._by_video[stage].get(video, [])

    def reading(self, stage: str, digests: set[str]) -> list[Record]:
        """The valid records of a stage that read one of these digests for a video, newest first."""
        records = self.all(stage)
        if not records:
            return []
        if stage not in self._by_input:
            found: dict[str, list[int]] = {}
            for i, record in enumerate(records):
                for digest in set(_strings(record.action.get("inputs"))) if record.video else ():
                    found.setdefault(digest, []).append(i)
            self._by_input[stage] = found
        known = self._by_input[stage]
        return [records[i] for i in sorted({i for d in digests for i in known.get(d, ())})]

    def stages(self) -> list[str]:
        """Names of the stages that have records."""
        return sorted(p.name for p in self.root.iterdir() if p.is_dir()) if self.root.is_dir() else []

    def refresh(self) -> None:
        """Forget what was read, because another process may have written."""
        self._cache.clear()
        self._by_video.clear()
        self._by_input.clear()


def parse(value: Any, stage: str, key: str) -> Record | None:
    """A record from parsed JSON, or None when it is not one of this stage and key."""
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        return None
    try:
        record = Record(**value)
        if not (isinstance(record.action, dict) and key_of_stored(record.action) == key == record.key):
            return None
    except (TypeError, ValueError, RecursionError):
        return None
    right = (
        record.stage == stage == record.action.get("stage")
        and isinstance(record.video, str | None)
        and _is_digest(record.digest)
        and all(isinstance(v, int) for v in (record.files, record.bytes))
        and isinstance(record.seconds, int | float)
        and all(isinstance(v, str) for v in (record.started, record.finished, record.run, record.host))
        and isinstance(record.modules, dict)
        and isinstance(record.metrics, dict)
        and isinstance(record.warnings, list)
    )
    return record if right else None


def _strings(value: Any) -> Iterator[str]:
    """Every string in a nested value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _strings(inner)


def _is_digest(value: Any) -> bool:
    return isinstance(value, str) and len(value) == 64 and not set(value) - set("0123456789abcdef")
