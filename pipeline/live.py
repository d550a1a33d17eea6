"""The live table of a run: stages down, videos across, what runs now with its progress and time left."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pipeline.console import duration, progress_text
from pipeline.graph import Node
from pipeline.plan import HIT, WAIT, Step

_STYLES = {
    "ok": "green",
    "running": "bold cyan",
    "to run": "yellow",
    "waits": "dim",
    "failed": "bold red",
    "stopped": "magenta",
}
_WORDS = {
    "hit": "ok",
    "done": "ok",
    "launched": "running",
    "failed": "failed",
    "bad_input": "failed",
    "interrupted": "stopped",
    "blocked": "waits",
}
_MOST_COLUMNS = 8
_REFRESH_S = 0.25


@dataclass
class Progress:
    """How far one running action is."""

    started: float
    event: dict[str, Any] = field(default_factory=dict)
    first: tuple[float, float] | None = None  # (time, done) of its first progress event

    def seconds_left(self) -> float | None:
        """Time left at the pace so far, None before there is one."""
        done, total = self.event.get("done"), self.event.get("total")
        if self.first is None or not isinstance(done, int | float) or not isinstance(total, int | float):
            return None
        if total <= 0 or done > total:
            return None
        elapsed, gained = time.monotonic() - self.first[0], done - self.first[1]
        return elapsed * (total - done) / gained if gained > 0 and elapsed > 1.0 else None


class LiveDisplay:
    """Redraws a table on a terminal. `expected_s` is the time an action took before, by label."""

    def __init__(
        self, steps: list[Step], expected_s: dict[str, float], cpus: int, console: Console | None = None
    ) -> None:
        self._nodes = [s.node for s in steps]
        self._states = {s.node.label: self._first_word(s) for s in steps}
        self._expected_s, self._cpus = expected_s, cpus
        self._running: dict[str, Progress] = {}
        self._took_s: dict[str, list[float]] = {}
        self._started = time.monotonic()
        self._drawn = 0.0
        self._note = ""
        self._live = Live(console=console or Console(), auto_refresh=False, transient=False)

    def __enter__(self) -> LiveDisplay:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.update(self._picture(), refresh=True)
        self._live.stop()

    def event(self, label: str, event: dict[str, Any]) -> None:
        """Take note of what happened."""
        kind = str(event.get("event"))
        if kind == "stopping":
            self._note = "stopping: workers save their work; Ctrl-C once more kills them"
        if kind in _WORDS:
            self._states[label] = _WORDS[kind]
        if kind == "launched":
            self._running[label] = Progress(time.monotonic())
        elif kind == "progress" and label in self._running:
            progress = self._running[label]
            another = [event.get(k) for k in ("what", "total")] != [progress.event.get(k) for k in ("what", "total")]
            progress.event = event
            if progress.first is None or another or event.get("done", 0) < progress.first[1]:
                progress.first = (time.monotonic(), float(event.get("done", 0)))
        elif kind in ("waiting", "silent") and label in self._running:
            self._running[label].event = {"what": event.get("text", ""), "done": 0}
        elif kind in ("done", "failed", "bad_input", "interrupted"):
            self._running.pop(label, None)
        if kind == "done":
            self._took_s.setdefault(label.partition("/")[0], []).append(float(event.get("seconds", 0.0)))
        if kind in ("failed", "bad_input"):
            self._live.console.print(Text(f"{label} failed: {event.get('text', '')}", style="red"))

    def refresh(self) -> None:
        """Redraw, at most four times a second."""
        now = time.monotonic()
        if now - self._drawn >= _REFRESH_S:
            self._drawn = now
            self._live.update(self._picture(), refresh=True)

    # ------------------------------------------------------------------ drawing

    @staticmethod
    def _first_word(step: Step) -> str:
        return "ok" if step.status == HIT else "waits" if step.status == WAIT else "to run"

    def _picture(self) -> Group:
        parts: list[Any] = [table_of(self._nodes, self._states)]
        for label, progress in self._running.items():
            left, spent = progress.seconds_left(), time.monotonic() - progress.started
            words = [f"{label:<24}", progress_text(progress.event) if progress.event else "starting"]
            words.append(f"{duration(left)} left" if left is not None else duration(spent))
            parts.append(Text("  ".join(words)))
        left = self._total_left()
        clock = duration(time.monotonic() - self._started)
        parts.append(Text(f"{clock}{f'   about {duration(left)} left' if left else ''}   {self._note}", style="dim"))
        return Group(*parts)

    def _total_left(self) -> float | None:
        """Time left of the whole run, from earlier times and the pace now; None while some action is unknown."""
        total = 0.0
        for node in self._nodes:
            state = self._states[node.label]
            if state not in ("running", "to run", "waits"):
                continue
            took = self._took_s.get(node.info.name)
            known = self._expected_s.get(node.label, sum(took) / len(took) if took else None)
            progress = self._running.get(node.label)
            left = progress.seconds_left() if progress else known
            if left is None and progress is not None and known is not None:
                left = max(0.0, known - (time.monotonic() - progress.started))
            if left is None:
                return None
            cores = self._cpus if node.info.cpus == 0 else min(node.info.cpus, self._cpus)
            total += left * cores / self._cpus
        return total or None


def table_of(nodes: list[Node], states: dict[str, str], extra: Mapping[str, tuple[str, ...]] | None = None) -> Table:
    """Stages down, videos across (counts when there are many); `extra` are further columns by stage."""
    videos = list(dict.fromkeys(n.video.name for n in nodes if n.video))
    stages = list(dict.fromkeys(n.info.name for n in nodes))
    narrow = len(videos) <= _MOST_COLUMNS
    table = Table(box=None, pad_edge=False, show_header=True, header_style="dim")
    table.add_column("")
    for name in videos if narrow else ["videos"]:
        table.add_column(name if len(name) <= 20 else name[:17] + "...")
    for name in ("size", "time", "") if extra is not None else ():
        table.add_column(name)
    by_stage: dict[str, dict[str | None, str]] = {}
    for node in nodes:
        by_stage.setdefault(node.info.name, {})[node.video_name] = states[node.label]
    for stage in stages:
        found = by_stage[stage]
        cells = [_cell(found[None])] if None in found else []
        if not cells and narrow:
            cells = [_cell(found.get(v, "")) for v in videos]
        elif not cells:
            counts: dict[str, int] = {}
            for word in found.values():
                counts[word] = counts.get(word, 0) + 1
            cells = [Text("  ").join(Text(f"{n} {w}", style=_STYLES.get(w, "")) for w, n in counts.items())]
        columns = max(1, len(videos)) if narrow else 1
        cells += [Text("")] * (columns - len(cells))
        table.add_row(stage, *cells, *(extra or {}).get(stage, ()))
    return table


def _cell(word: str) -> Text:
    return Text(word, style=_STYLES.get(word.split(" ")[0] if word not in _STYLES else word, ""))
