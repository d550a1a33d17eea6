"""A stage's line to the outside: log, progress, metrics, warnings, checkpoints and the wish to stop."""

from __future__ import annotations

import logging
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from pathlib import Path
from typing import Any, TypeVar

from pipeline.errors import Interrupted

T = TypeVar("T")
Sink = Callable[[dict[str, Any]], None]
_INTERVAL_S = 0.2


class Run:
    """What a stage may ask of, and tell to, whoever runs it.

    ``Run()`` alone serves tests: it logs, forgets events, and checkpoints to a temporary folder.
    """

    def __init__(
        self,
        *,
        checkpoint_dir: Path | None = None,
        video: str | None = None,
        videos: tuple[str, ...] = (),
        device: str = "cpu",
        threads: int = 1,
        rank: int = 0,
        world_size: int = 1,
        sink: Sink | None = None,
        log: logging.Logger | None = None,
    ) -> None:
        self.video, self.videos = video, videos
        self.device, self.threads = device, threads
        self.rank, self.world_size = rank, world_size
        self.log = log or logging.getLogger("stage")
        self.metrics: dict[str, Any] = {}
        self.warnings: list[str] = []
        self._sink = sink
        self._checkpoint_dir = checkpoint_dir
        self._stop = threading.Event()
        self._last_tick = 0.0

    @property
    def checkpoint_dir(self) -> Path:
        """Folder for unfinished work. It belongs to the action's key and survives kills; emptied by success."""
        if self._checkpoint_dir is None:
            self._checkpoint_dir = Path(tempfile.mkdtemp(prefix="checkpoint-"))
        self._checkpoint_dir.mkdir(parents=True, exist_ok=True)
        return self._checkpoint_dir

    # ------------------------------------------------------------------ stopping

    @property
    def stop_requested(self) -> bool:
        """True once the user or the machine wants this process to end: save a checkpoint, then ``interrupt()``."""
        return self._stop.is_set()

    def request_stop(self) -> None:
        """Ask the stage to stop (called by the worker, or by a test)."""
        self._stop.set()

    def interrupt(self) -> None:
        """Leave the stage, its checkpoint saved. Raises :class:`Interrupted`."""
        raise Interrupted("stopped on request")

    # ------------------------------------------------------------------ telling

    def progress(self, iterable: Iterable[T], total: int | None = None, label: str = "") -> Iterator[T]:
        """Yield from `iterable`, reporting progress; raises :class:`Interrupted` when asked to stop."""
        if total is None and isinstance(iterable, Sized):
            total = len(iterable)
        done = 0
        for item in iterable:
            if self.stop_requested:
                self.interrupt()
            self.tick(done, total, label)
            yield item
            done += 1
        self.tick(done, total if total is not None else done, label, _force=True)

    def tick(
        self, done: float, total: float | None = None, label: str = "", _force: bool = False, **extra: Any
    ) -> None:
        """Report progress: `done` of `total`; `extra` are figures worth showing (``loss=0.3``). Never raises."""
        now = time.monotonic()
        if self._sink is None or (not _force and now - self._last_tick < _INTERVAL_S):
            return
        self._last_tick = now
        event: dict[str, Any] = {"event": "progress", "done": done, "total": total}
        if label:
            event["what"] = label
        if extra:
            event["extra"] = {k: _plain(v) for k, v in extra.items()}
        self._sink(event)

    def metric(self, name: str, value: Any) -> None:
        """Record a figure of the result: kept in the ledger, shown by ``inspect``."""
        self.metrics[name] = _plain(value)

    def warn(self, text: str) -> None:
        """Tell the user something about the result's quality: shown when the run ends, kept in the record."""
        self.log.warning(text)
        if text not in self.warnings:
            self.warnings.append(text)
        if self._sink is not None:
            self._sink({"event": "warning", "text": text})


def _plain(value: Any) -> Any:
    """`value` as JSON can hold it: numpy and torch scalars become numbers, non-finite numbers become text."""
    if isinstance(value, bool | str | int) or value is None:
        return value
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    try:
        number = float(value)
    except (TypeError, ValueError):
        return str(value)
    return number if number == number and abs(number) != float("inf") else str(number)
