"""``inspect`` and ``log``: look into one result, or follow how it came about."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from pipeline.commands.show import ago, nodes_named, open_quietly, print_json
from pipeline.console import duration, size
from pipeline.definition import child_environment
from pipeline.errors import BadInput, ExitCode
from pipeline.files import unique
from pipeline.graph import Node
from pipeline.ledger import Record
from pipeline.objects import walk
from pipeline.plan import HIT, Planner
from pipeline.project import Options, Project
from pipeline.runs import list_runs
from pipeline.settings import stage_values


def inspect_command(args: argparse.Namespace, options: Options) -> int:
    """Counts, sizes, figures, provenance, path, contact sheet."""
    project = open_quietly(options)
    nodes = nodes_named(project, args.stage, args.video)
    planner = project.planner()
    planner.plan(project.graph.needed(nodes))
    found = [(n, *_result(project, planner, n)) for n in nodes]
    if not any(record for _, record, _ in found):
        waiting = next(iter(project.workspace.checkpoints.glob("*")), None)
        hint = f"unfinished work lies in {project.workspace.checkpoints}" if waiting else "banmo run"
        raise BadInput(f"{args.stage} has no result yet", hint=hint)
    facts = [_facts(project, n, record, fresh) for n, record, fresh in found if record]
    if args.json:
        print_json(facts)
        return ExitCode.DONE
    for entry in facts:
        _say(entry)
    missing = [n.label for n, record, _ in found if record is None]
    if missing:
        sys.stdout.write(f"no result yet: {', '.join(missing)}\n")
    return ExitCode.DONE


def _result(project: Project, planner: Planner, node: Node) -> tuple[Record | None, bool]:
    """The result of a node that is up to date, else its newest earlier one."""
    step = planner.steps[node.label]
    if step.status == HIT:
        return step.record, True
    earlier = [r for r in project.workspace.ledger.all(node.info.name) if r.video == node.video_name]
    sound = (r for r in earlier if project.workspace.objects.sound(r.stage, r.digest))
    return next(sound, None), False


def _facts(project: Project, node: Node, record: Record, fresh: bool) -> dict[str, Any]:
    path = project.workspace.objects.path(record.stage, record.digest)
    kinds: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    for name, _, status in walk(path):
        kind = Path(name).suffix.lower() or name
        folder = str(Path(name).parent)
        place = kind if folder == "." else f"{folder}/*{kind}"
        kinds[place] += 1
        sizes[place] += status.st_size
    return {
        "label": node.label,
        "doc": node.info.doc.split("\n")[0],
        "fresh": fresh,
        "path": str(path),
        "digest": record.digest,
        "key": record.key,
        "files": record.files,
        "bytes": record.bytes,
        "contents": {k: {"files": kinds[k], "bytes": sizes[k]} for k in sorted(kinds)},
        "metrics": record.metrics,
        "warnings": record.warnings,
        "settings": record.action.get("settings", {}),
        "finished": record.finished,
        "seconds": record.seconds,
        "host": record.host,
        "versions": record.versions,
        "run": record.run,
        "blessed": record.blessed,
        "sheet": str(sheet) if (sheet := _sheet(project, node, record, path)) else None,
    }


def _say(entry: dict[str, Any]) -> None:
    out = sys.stdout
    state = "" if entry["fresh"] else "   (an earlier result; `banmo why` tells what changed)"
    out.write(f"{entry['label']}{state}\n  {entry['doc']}\n")
    out.write(f"  path      {entry['path']}\n")
    out.write(f"  holds     {entry['files']} files, {size(entry['bytes'])}\n")
    shown = list(entry["contents"].items())
    for place, facts in shown[:12]:
        out.write(f"              {facts['files']:>6} {place}  {size(facts['bytes'])}\n")
    if len(shown) > 12:
        out.write(f"              and {len(shown) - 12} other kinds\n")
    for name, value in entry["metrics"].items():
        text = json.dumps(value)
        out.write(f"  {name:<9} {text if len(text) < 200 else text[:197] + '...'}\n")
    for text in entry["warnings"]:
        out.write(f"  warning   {text}\n")
    out.write(
        f"  made      {ago(entry['finished'])} in {duration(entry['seconds'])} on {entry['host']}, run {entry['run']}\n"
    )
    if entry["blessed"]:
        out.write(f"  blessed   by {entry['blessed'].get('who')} at {entry['blessed'].get('when')}\n")
    if entry["sheet"]:
        out.write(f"  sheet     {entry['sheet']}\n")


def _sheet(project: Project, node: Node, record: Record, path: Path) -> Path | None:
    """The contact sheet of a result, drawn by the stage in a child process; None when it has none."""
    if not node.info.sheet:
        return None
    picture = project.workspace.cache / "sheets" / f"{record.stage}-{record.digest[:16]}.png"
    if picture.is_file():
        return picture
    try:
        picture.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        sys.stderr.write(f"note: no contact sheet: {error.strerror}\n")
        return None
    drawing = picture.with_name(f".{unique()}.png")  # one that was cut short must not be shown ever after
    folders = _input_folders(project, node, record)
    if folders is None:
        return None
    request = {
        "reference": node.info.reference,
        "out": str(path),
        "picture": str(drawing),
        "inputs": folders,
        "settings": stage_values(project.settings, node.info),
    }
    child = subprocess.run(
        [sys.executable, "-P", "-m", "pipeline.sheet", json.dumps(request)],
        env=child_environment(project.definition.package_dir),
        cwd=picture.parent,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    if child.returncode == 0 and drawing.is_file():
        os.replace(drawing, picture)
    elif child.returncode != 0:
        drawing.unlink(missing_ok=True)
        sys.stderr.write(f"note: no contact sheet: {(child.stderr.strip().splitlines() or ['it failed'])[-1]}\n")
    return picture if picture.is_file() else None


def _input_folders(project: Project, node: Node, record: Record) -> dict[str, Any] | None:
    """Paths of the folders a record was made from; None when one is gone."""
    found: dict[str, Any] = {}
    for name in node.info.inputs:
        digests = record.action["inputs"].get(name)
        many = isinstance(digests, dict)
        paths = {
            v: str(project.workspace.objects.path(name, d))
            for v, d in (digests if many else {"": digests}).items()
            if d
        }
        if not paths or not all(Path(p).is_dir() for p in paths.values()):
            return None
        found[name] = paths if many else paths[""]
    return found


def log_command(args: argparse.Namespace, options: Options) -> int:
    """Print the newest log of an action."""
    project = open_quietly(options)
    nodes = nodes_named(project, args.stage, args.video)
    paths = [p for n in nodes if (p := _newest_log(project, n)) is not None]
    if not paths:
        raise BadInput(f"{args.stage} has not run here yet", hint="banmo run")
    for path in paths:
        if len(paths) > 1:
            sys.stdout.write(f"==> {path}\n")
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
        sys.stdout.writelines(lines[-args.lines :] if args.lines > 0 else lines)
        if not lines and not args.follow:
            sys.stdout.write(f"it had nothing to say ({path})\n")
    if args.follow:
        _follow(paths[-1])
    return ExitCode.DONE


def _newest_log(project: Project, node: Node) -> Path | None:
    for run in list_runs(project.workspace):
        path = project.workspace.runs / run / "logs" / f"{node.label.replace('/', '-')}.txt"
        if path.is_file():
            return path
    return None


def _follow(path: Path) -> None:
    with path.open(encoding="utf-8", errors="replace") as file:
        file.seek(0, 2)
        while True:
            text = file.read()
            if text:
                sys.stdout.write(text)
                sys.stdout.flush()
            else:
                time.sleep(0.3)
