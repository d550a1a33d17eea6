"""``status``, ``why``, ``graph``, ``settings``: what there is and what would happen, without doing it."""

from __future__ import annotations

import argparse
import json
import sys
import time
from datetime import datetime
from typing import Any

from pipeline.console import duration, progress_text, size
from pipeline.definition import StageInfo, load
from pipeline.errors import BadInput, ExitCode, did_you_mean
from pipeline.graph import Node, find_video
from pipeline.plan import HIT, WAIT, Planner, Step
from pipeline.project import Options, Project
from pipeline.reasons import tree
from pipeline.settings import Settings, expected, resolve, sections, toml_value
from pipeline.states import State, survey
from pipeline.workspace import Workspace


def open_quietly(options: Options) -> Project:
    """The project as the last run saw it, unless flags say otherwise."""
    return Project.open(options, recall=True)


def nodes_named(project: Project, stage: str, video: str | None) -> list[Node]:
    """The nodes a STAGE [VIDEO] on the command line stands for. Raises BadInput."""
    nodes = [n for s in project.definition.names(stage) for n in project.graph.of_stage(s)]
    if video is not None:
        wanted = find_video(project.videos, video).name
        nodes = [n for n in nodes if n.video_name == wanted]
        if not nodes:
            raise BadInput(f"{stage} runs once for all videos", hint=f"leave {video} out")
    broken = next((n.info for n in nodes if n.info.error), None)
    if broken is not None:
        raise BadInput(f"stage {broken.name} cannot be loaded: {broken.error}")
    return nodes


# ---------------------------------------------------------------------------------------------- status


def status_command(args: argparse.Namespace, options: Options) -> int:
    """The table of stages and videos."""
    project = open_quietly(options)
    _, states = survey(project)
    broken = [i for i in project.definition.stages.values() if i.error]
    if args.json:
        rows = [_state_json(s) for s in states]
        print_json(
            {"videos": [v.name for v in project.videos], "nodes": rows, "broken": {i.name: i.error for i in broken}}
        )
        return ExitCode.DONE
    from rich.console import Console

    from pipeline.live import table_of

    extra = {
        name: _stage_facts([s for s in states if s.step.node.info.name == name]) for name in project.definition.stages
    }
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(
        f"{project.workspace.root}   videos {project.videos_dir}   preset {project.settings.preset or 'none'}"
    )
    console.print(table_of([s.step.node for s in states], {s.step.node.label: s.word for s in states}, extra))
    for state in states:
        if state.word in ("failed", "stopped"):
            console.print(f"{state.step.node.label} {state.word}: {state.note}", markup=False, highlight=False)
    for info in broken:
        console.print(f"{info.name} cannot be loaded: {info.error}", markup=False, highlight=False)
    return ExitCode.DONE


def _stage_facts(states: list[State]) -> tuple[str, str, str]:
    """Size, time and a note for the row of a stage."""
    records = [s.step.record for s in states if s.word == "ok" and s.step.record]
    total = size(sum(r.bytes for r in records)) if records else ""
    seconds = duration(sum(r.seconds for r in records)) if records else ""
    notes = [
        f"{s.step.node.video_name or ''} {progress_text(s.progress)}".strip() for s in states if s.word == "running"
    ]
    notes += [s.note for s in states if s.word == "to run"][:1]
    return total, seconds, "; ".join(notes[:2])


def _state_json(state: State) -> dict[str, Any]:
    step = state.step
    record = step.record if step.status == HIT else None
    return {
        "stage": step.node.info.name,
        "video": step.node.video_name,
        "state": state.word,
        "note": state.note,
        "key": step.action.key if step.action else None,
        "digest": record.digest if record else None,
        "bytes": record.bytes if record else None,
        "seconds": record.seconds if record else None,
        "reasons": [r.as_json() for r in step.reasons],
        "progress": state.progress,
    }


# ---------------------------------------------------------------------------------------------- why


def why_command(args: argparse.Namespace, options: Options) -> int:
    """Reasons, recursively."""
    project = open_quietly(options)
    nodes = nodes_named(project, args.stage, args.video)
    planner = project.planner()
    planner.plan(project.graph.needed(nodes))
    steps = [planner.steps[n.label] for n in nodes]
    if args.json:
        rows = [
            {
                "label": s.node.label,
                "status": s.status,
                "reasons": [r.as_json() for r in s.reasons],
                "waits": s.waits_for,
            }
            for s in steps
        ]
        print_json(rows)
        return ExitCode.DONE
    for step in steps:
        _say_why(step, planner)
    return ExitCode.DONE


def _say_why(step: Step, planner: Planner) -> None:
    out, label, record = sys.stdout, step.node.label, step.record
    if step.status == HIT:
        assert record is not None
        out.write(f"{label} is up to date      made {ago(record.finished)} in {duration(record.seconds)}\n")
        return
    verb = "may run, once its inputs are known" if step.status == WAIT else "will run"
    last = f"      last result: {ago(record.finished)}, {duration(record.seconds)}" if record else ""
    out.write(f"{label} {verb}{last}\n")
    out.write("".join(line + "\n" for line in tree(step.reasons)))
    if record is not None:
        kinds = {r.kind for r in step.reasons}
        changed = sum(r.kind == "input" for r in step.reasons)
        count = len(planner.graph.inputs(step.node)) if step.node.video else _count(record.action.get("inputs", {}))
        same = [k for k in ("code", "settings", "version") if k not in kinds]
        if count > changed:
            same.append(f"{count - changed} {'other inputs' if changed else 'inputs'}")
        out.write(f"  same  {', '.join(same)}\n" if same else "")


def _count(inputs: Any) -> int:
    return sum(_count(v) for v in inputs.values()) if isinstance(inputs, dict) else 1


def ago(stamp: str) -> str:
    """``3 days ago``."""
    try:
        seconds = time.time() - datetime.fromisoformat(stamp).timestamp()
    except ValueError:
        return "at an unknown time"
    for unit, length in (("day", 86400), ("hour", 3600), ("minute", 60)):
        if seconds >= length:
            count = int(seconds // length)
            return f"{count} {unit}{'s' if count > 1 else ''} ago"
    return "just now"


# ---------------------------------------------------------------------------------------------- graph


def graph_command(args: argparse.Namespace, options: Options) -> int:
    """The graph of stages, coloured by state."""
    project = open_quietly(options)
    _, states = survey(project)
    by_stage: dict[str, list[State]] = {name: [] for name in project.definition.stages}
    for state in states:
        by_stage[state.step.node.info.name].append(state)
    worst = {name: _worst([s.word for s in found]) for name, found in by_stage.items()}
    infos = project.definition.stages
    if args.json:
        print_json({name: {"inputs": list(info.inputs), "state": worst[name]} for name, info in infos.items()})
    elif args.dot:
        sys.stdout.write(_dot(infos, worst))
    else:
        sys.stdout.write(_mermaid(infos, worst))
    return ExitCode.DONE


_COLOURS = {"ok": "#9fd8a4", "running": "#8ecae6", "to run": "#ffe08a", "waits": "#e0e0e0", "failed": "#f4a3a3"}


def _worst(words: list[str]) -> str:
    return next((w for w in ("failed", "stopped", "running", "to run", "waits", "ok") if w in words), "waits")


def _dot(infos: dict[str, StageInfo], states: dict[str, str]) -> str:
    lines = ["digraph pipeline {", "  rankdir=LR; node [shape=box, style=filled];"]
    for name, info in infos.items():
        lines.append(f'  {name} [fillcolor="{_COLOURS.get(states[name], "#d7b9e8")}", tooltip="{states[name]}"];')
        lines += [f"  {source} -> {name};" for source in (*(["videos"] if "video" in info.takes else []), *info.inputs)]
    return "\n".join([*lines, "}", ""])


def _mermaid(infos: dict[str, StageInfo], states: dict[str, str]) -> str:
    lines = ["flowchart LR"]
    for name, info in infos.items():
        lines += [f"  {source} --> {name}" for source in (*(["videos"] if "video" in info.takes else []), *info.inputs)]
        lines.append(f"  style {name} fill:{_COLOURS.get(states[name], '#d7b9e8')}")
    return "\n".join([*lines, ""])


# ---------------------------------------------------------------------------------------------- settings


def settings_command(args: argparse.Namespace, options: Options) -> int:
    """Every setting with its value, where that came from, and what it means."""
    known = (options.workspace / "FORMAT").is_file()
    if known:
        workspace = Workspace.open(options.workspace)
        definition = load(
            options.definition or str(workspace.remembered().get("definition") or "stages"), workspace.cache
        )
        settings = resolve(definition, workspace.settings_path, options.overrides, options.preset)
    else:
        definition = load(options.definition or "stages")
        settings = resolve(definition, None, options.overrides, options.preset)
    fields = sections(definition)
    if args.section and args.section not in fields:
        raise BadInput(f"there is no section {args.section!r}", hint=did_you_mean(args.section, fields))
    chosen = {args.section: fields[args.section]} if args.section else fields
    if args.json:
        print_json({name: settings.values[name] for name in chosen})
    elif args.toml:
        sys.stdout.write(_as_toml(chosen, settings))
    else:
        presets = ", ".join(definition.presets) or "none"
        sys.stdout.write(f"presets: {presets} (now: {settings.preset or 'none'})\n")
        for name, specs in chosen.items():
            sys.stdout.write(f"\n[{name}]\n")
            for spec in specs:
                origin = settings.origins.get(f"{name}.{spec['name']}", "")
                value = settings.values[name][spec["name"]]
                shown = "none" if value is None else toml_value(value)
                sys.stdout.write(f"  {spec['name']} = {shown}{f'   ({origin})' if origin else ''}\n")
                if spec["help"]:
                    sys.stdout.write(f"      {' '.join(spec['help'].split())}\n")
    return ExitCode.DONE


def _as_toml(chosen: dict[str, tuple[dict[str, Any], ...]], settings: Settings) -> str:
    lines = ["# Every setting with its default, commented out. Take the # away to change one.", ""]
    for name, specs in chosen.items():
        lines.append(f"[{name}]")
        for spec in specs:
            help_text = " ".join(spec["help"].split())
            kind = expected(spec["type"])
            default = "none" if spec["default"] is None else toml_value(spec["default"])
            lines.append(f"# {help_text or kind}{f' ({kind})' if help_text else ''}")
            if f"{name}.{spec['name']}" in settings.origins:
                value = settings.values[name][spec["name"]]
                lines.append(
                    f"# {spec['name']} = {toml_value(value)}   # by {settings.origins[name + '.' + spec['name']]}"
                )
            else:
                lines.append(f"# {spec['name']} = {default}")
        lines.append("")
    return "\n".join(lines)


def print_json(value: Any) -> None:
    """One JSON value on standard output."""
    sys.stdout.write(json.dumps(value, indent=1) + "\n")
