"""Progress and decisions as JSON lines: workers append to their own file, the run copies them into its own."""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path
from typing import Any

from pipeline.errors import printable

_OF_WORKERS = ("started", "waiting", "progress", "warning")


class EventWriter:
    """Appends events to a file, one line each, in one write. Losing an event never stops the work."""

    def __init__(self, path: Path, common: dict[str, Any] | None = None) -> None:
        self._common = common or {}
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("ab", buffering=0)

    def __call__(self, event: dict[str, Any]) -> None:
        """Append one event."""
        value = {"time": round(time.time(), 3), **self._common, **event}
        with contextlib.suppress(OSError, ValueError, TypeError):
            self._file.write((json.dumps(value, ensure_ascii=True) + "\n").encode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class EventReader:
    """Reads whole new lines of a growing file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def read(self) -> list[dict[str, Any]]:
        """The events appended since the last call; lines that are not JSON are skipped."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                data = file.read()
        except OSError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        found = []
        for line in whole.splitlines():
            try:
                value = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(value, dict):
                found.append(value)
        return found


def of_worker(event: dict[str, Any]) -> dict[str, Any]:
    """An event as a worker may send it: the kinds it may tell of, numbers that are numbers, text fit for a terminal.

    Whatever else a stage wrote into its events becomes the kind "unknown", a sign of life and no more.
    """
    kind = event.get("event")
    if kind not in _OF_WORKERS:
        return {"event": "unknown"}
    found: dict[str, Any] = {"event": kind}
    for name in ("done", "total", "pid"):
        if _is_number(event.get(name)):
            found[name] = event[name]
    for name in ("text", "what"):
        if isinstance(event.get(name), str):
            found[name] = printable(event[name])
    extra = event.get("extra")
    if isinstance(extra, dict):
        found["extra"] = {printable(str(k)): v if _is_number(v) else printable(str(v)) for k, v in extra.items()}
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
