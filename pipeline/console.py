"""What a run shows on a terminal: a live table, or plain lines when nobody watches."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import Any, TextIO, TypeVar

from pipeline.plan import HIT, WAIT, Step
from pipeline.reasons import brief

T = TypeVar("T")
_MOST_LINES = 40


def duration(seconds: float) -> str:
    """``4.2 s``, ``1:05 min``, ``2 h 41 min``."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{int(seconds) // 60}:{int(seconds) % 60:02d} min"
    return f"{int(seconds) // 3600} h {int(seconds) % 3600 // 60} min"


def size(count: float) -> str:
    """Bytes for people."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 100 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def progress(
    iterable: Iterable[T], total: int | None = None, label: str = "", stream: TextIO | None = None
) -> Iterator[T]:
    """Yield from `iterable`, showing how far it is: one line redrawn on a terminal, a line now and then elsewhere."""
    stream = stream or sys.stderr
    if total is None and isinstance(iterable, Sized):
        total = len(iterable)
    redraw, started, told = stream.isatty(), time.monotonic(), time.monotonic()
    done = 0
    try:
        for item in iterable:
            yield item
            done += 1
            now = time.monotonic()
            if now - told < (0.2 if redraw else 15.0):
                continue
            told = now
            text = progress_text({"label": label, "done": done, "total": total})
            if total and done <= total:
                text += f"  {duration((now - started) * (total - done) / done)} left"
            stream.write(f"\r\x1b[K{text}" if redraw else f"{time.strftime('%H:%M:%S')}  {text}\n")
            stream.flush()
    finally:
        if redraw and done:
            stream.write("\r\x1b[K")
            stream.flush()


def print_plan(steps: list[Step], stream: TextIO | None = None) -> None:
    """One line a node that is not up to date; one line a stage when they are many."""
    stream = stream or sys.stdout
    pending = [s for s in steps if s.status != HIT]
    if len(pending) > _MOST_LINES:
        _print_stages(pending, stream)
        return
    width = max((len(s.node.label) for s in pending), default=0)
    for step in pending:
        past = f"  took {duration(step.record.seconds)} last time" if step.record else ""
        if step.status == WAIT:
            what = f"waits for {', '.join(step.waits_for[:2])}{' …' if len(step.waits_for) > 2 else ''}"
        else:
            what = brief(step.reasons)
        stream.write(f"  {step.node.label:<{width}}  {what}{past}\n")


def _print_stages(pending: list[Step], stream: TextIO) -> None:
    counts: dict[tuple[str, str], int] = {}
    for step in pending:
        what = "waits" if step.status == WAIT else brief(step.reasons)
        counts[(step.node.info.name, what)] = counts.get((step.node.info.name, what), 0) + 1
    width = max(len(stage) for stage, _ in counts)
    for (stage, what), count in counts.items():
        stream.write(f"  {stage:<{width}}  {count:>6}  {what}\n")


class PlainDisplay:
    """Lines for logs and pipes."""

    def __init__(self, stream: TextIO, interval_s: float = 15.0) -> None:
        self._stream, self._interval_s = stream, interval_s
        self._told: dict[str, float] = {}

    def event(self, label: str, event: dict[str, Any]) -> None:
        """Write a line for what matters."""
        kind, text = event.get("event"), event.get("text", "")
        if kind == "launched":
            self._line(f"{label}: running")
            self._told[label] = time.monotonic()
        elif kind == "progress":
            now = time.monotonic()
            if now - self._told.get(label, 0.0) >= self._interval_s:
                self._told[label] = now
                self._line(f"{label}: {progress_text(event)}")
        elif kind == "done":
            self._line(f"{label}: done in {duration(event.get('seconds', 0.0))}")
        elif kind == "failed":
            self._line(f"{label}: failed: {text}")
        elif kind == "bad_input":
            self._line(f"{label}: failed, its input is at fault")
        elif kind == "interrupted":
            self._line(f"{label}: {text}; the next run goes on from its checkpoint")
        elif kind in ("waiting", "silent"):
            self._line(f"{label}: {text}")
        elif kind == "stopping":
            self._line("stopping: workers save their work; once more to kill them")

    def refresh(self) -> None:
        """Nothing to redraw."""

    def _line(self, text: str) -> None:
        self._stream.write(f"{time.strftime('%H:%M:%S')}  {text}\n")
        self._stream.flush()


def progress_text(event: dict[str, Any]) -> str:
    """``143/212  loss 0.31``."""
    total = event.get("total")
    done = event.get("done", 0)
    text = f"{done:g}/{total:g}" if isinstance(total, int | float) and total > 0 else f"{done:g}"
    if event.get("what"):
        text = f"{event['what']} {text}"
    extra = event.get("extra") or {}
    words = [f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in extra.items()]
    return "  ".join([text, *words])
