"""What state every node is in now: up to date, to run, running, failed, stopped, waiting."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from pipeline.events import EventReader
from pipeline.files import read_json
from pipeline.plan import HIT, RUN, Planner, Step
from pipeline.project import Project
from pipeline.reasons import brief
from pipeline.workspace import Workspace


@dataclass
class State:
    """The state of one node, with a word of explanation."""

    step: Step
    word: str
    note: str = ""
    progress: dict[str, Any] = field(default_factory=dict)


def survey(project: Project) -> tuple[Planner, list[State]]:
    """The state of every node whose stage can be loaded."""
    broken = {i.name for i in project.definition.stages.values() if i.error}
    nodes = [n for n in project.graph.nodes if n.info.name not in broken and not _reads(project, n.info.name, broken)]
    planner = project.planner()
    steps = planner.plan(nodes)
    project.sources.save()
    running = live_events(project.workspace)
    return planner, [_state(project.workspace, step, running) for step in steps]


def _reads(project: Project, stage: str, broken: set[str]) -> bool:
    info = project.definition.stages[stage]
    return any(name in broken or _reads(project, name, broken) for name in info.inputs)


def _state(workspace: Workspace, step: Step, running: dict[str, dict[str, Any]]) -> State:
    label = step.node.label
    if step.status == HIT:
        return State(step, "ok")
    if label in running:
        return State(step, "running", progress=running[label])
    if step.status == RUN and step.action is not None:
        note = read_json(workspace.attempts / f"{step.action.key}.json")
        if isinstance(note, dict):
            word = "stopped" if note.get("status") == "interrupted" else "failed"
            return State(step, word, str(note.get("message", "")))
        return State(step, "to run", brief(step.reasons))
    return State(step, "waits", "for " + ", ".join(step.waits_for[:2]))


def live_events(workspace: Workspace) -> dict[str, dict[str, Any]]:
    """Label -> last progress event of every action that some living run is working on."""
    found: dict[str, dict[str, Any]] = {}
    if not workspace.runs.is_dir():
        return found
    for run in sorted(workspace.runs.iterdir()):
        if not workspace.runs_now(run.name):
            continue
        for event in EventReader(run / "events.jsonl").read():
            label, kind = str(event.get("label", "")), event.get("event")
            if kind == "launched":
                found[label] = {"event": "progress", "done": 0, "since": event.get("time", time.time())}
            elif kind == "progress" and label in found:
                found[label] = {**event, "since": found[label].get("since")}
            elif kind in ("done", "failed", "bad_input", "interrupted"):
                found.pop(label, None)
    return found
