"""What people see while it runs."""

from __future__ import annotations

import io
import time
from pathlib import Path

import pytest
from rich.console import Console

from pipeline import live
from pipeline.console import PlainDisplay, duration, print_plan, progress_text, size
from pipeline.definition import StageInfo
from pipeline.graph import Node
from pipeline.plan import HIT, RUN, WAIT, Step
from pipeline.reasons import Reason
from pipeline.videos import VideoFile


def node(stage: str, video: str | None = None) -> Node:
    info = StageInfo(stage, f"toy.{stage}:{stage}", None, per_video=video is not None, cpus=1 if video else 0)
    return Node(info, VideoFile(video, video, Path(video), False) if video else None)


def steps(count: int = 2) -> list[Step]:
    videos = [f"v{i}" for i in range(count)]
    found = [Step(node("words", v), HIT) for v in videos]
    found += [Step(node("upper", v), RUN, reasons=[Reason("settings", "mark", "!", "?")]) for v in videos]
    return [*found, Step(node("merge"), WAIT, waits_for=["upper/v0", "upper/v1", "upper/v2"])]


def test_plan_is_a_line_a_node_or_a_line_a_stage() -> None:
    few, many = io.StringIO(), io.StringIO()
    print_plan(steps(2), few)
    assert [" ".join(line.split()) for line in few.getvalue().splitlines()] == [
        "upper/v0 settings: mark ! -> ?",
        "upper/v1 settings: mark ! -> ?",
        "merge waits for upper/v0, upper/v1 …",
    ]
    print_plan(steps(1000), many)
    assert [" ".join(line.split()) for line in many.getvalue().splitlines()] == [
        "upper 1000 settings: mark ! -> ?",
        "merge 1 waits",
    ]


def test_plain_lines_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    display = PlainDisplay(stream, interval_s=10.0)
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    display.event("merge", {"event": "launched"})
    for i in range(100):
        now += 0.5
        display.event("merge", {"event": "progress", "done": i, "total": 100, "extra": {"loss": 0.12345}})
    display.event("merge", {"event": "done", "seconds": 50.0})
    lines = [line.split("  ", 1)[1] for line in stream.getvalue().splitlines()]
    assert lines[0] == "merge: running" and lines[-1] == "merge: done in 50.0 s"
    assert lines[1] == "merge: 19/100  loss 0.1235"
    assert len(lines) == 2 + 5


def test_live_table_shows_states_progress_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    console = Console(file=stream, width=100, force_terminal=True, color_system=None)
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    display = live.LiveDisplay(steps(), {"upper/v1": 20.0, "merge": 100.0}, cpus=2, console=console)
    display.event("upper/v0", {"event": "launched"})
    display.event("upper/v0", {"event": "progress", "done": 0, "total": 10})
    now += 5.0
    display.event("upper/v0", {"event": "progress", "done": 5, "total": 10})
    with console.capture() as drawn:
        console.print(display._picture())
    text = drawn.get()
    assert "running  to run" in " ".join(text.split("\n")[2].split()).replace(" to", "  to")
    assert "5/10  5.0 s left" in text
    assert "about 1:52 min left" in text, "5 s and 20 s on one core of two, 100 s on both"
    display.event("upper/v0", {"event": "failed", "text": "boom"})
    assert "failed" in stream.getvalue() or "boom" in stream.getvalue()


def test_many_videos_are_counted() -> None:
    console = Console(file=io.StringIO(), width=100)
    with console.capture() as drawn:
        console.print(live.table_of([s.node for s in steps(50)], {s.node.label: "ok" for s in steps(50)}))
    assert "50 ok" in drawn.get()


def test_figures_for_people() -> None:
    assert [duration(s) for s in (0.04, 59.9, 65, 3600 * 2 + 41 * 60)] == ["0.0 s", "59.9 s", "1:05 min", "2 h 41 min"]
    assert [size(b) for b in (0, 999, 1200, 123_400_000, 2e12, 3e15)] == [
        "0 B",
        "999 B",
        "1.2 kB",
        "123 MB",
        "2.0 TB",
        "3000.0 TB",
    ]
    assert progress_text({"done": 3}) == "3"
    assert progress_text({"done": 3, "total": 0, "what": "looking"}) == "looking 3"


def test_time_left_starts_anew_with_another_part_of_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    display = live.LiveDisplay(steps(), {}, cpus=2, console=Console(file=io.StringIO()))
    display.event("merge", {"event": "launched"})
    display.event("merge", {"event": "progress", "done": 0, "total": 10, "what": "slow"})
    now += 100.0
    display.event("merge", {"event": "progress", "done": 10, "total": 10, "what": "slow"})
    display.event("merge", {"event": "progress", "done": 10, "total": 20, "what": "fast"})
    now += 2.0
    display.event("merge", {"event": "progress", "done": 12, "total": 20, "what": "fast"})
    assert display._running["merge"].seconds_left() == pytest.approx(8.0)
    display.event("merge", {"event": "progress", "done": 5, "total": 0, "what": "looking"})
    assert display._running["merge"].seconds_left() is None
