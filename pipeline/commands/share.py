"""``push``, ``pull``, ``compare``: a workspace and other stores, a run and another run."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from pipeline.commands.show import print_json
from pipeline.console import duration, size
from pipeline.definition import read_toml
from pipeline.errors import BadInput, ExitCode, did_you_mean
from pipeline.project import Options
from pipeline.remote import Remote
from pipeline.runs import list_runs, read_plan
from pipeline.transfer import Moved, pull, push
from pipeline.upkeep import pins
from pipeline.workspace import Workspace


def push_command(args: argparse.Namespace, options: Options) -> int:
    """Copy results to another store."""
    workspace = Workspace.open(options.workspace)
    moved = push(workspace, Remote(args.url), everything=args.all, dry_run=args.dry_run)
    return _say(moved, args, "pushed", "would be pushed")


def pull_command(args: argparse.Namespace, options: Options) -> int:
    """Copy results from another store, verified on arrival."""
    remote = Remote(args.url)
    workspace = Workspace.open(options.workspace, create=True)
    moved = pull(workspace, remote, everything=args.all, dry_run=args.dry_run)
    return _say(moved, args, "pulled", "would be pulled")


def _say(moved: Moved, args: argparse.Namespace, verb: str, would: str) -> int:
    if args.json:
        print_json(moved.as_json())
    else:
        word = would if args.dry_run else verb
        sys.stdout.write(
            f"{moved.folders} results ({size(moved.bytes)}), {moved.records} records, {len(moved.runs)} runs {word}; "
            f"{moved.present} were there already\n"
        )
        for name in moved.damaged:
            sys.stdout.write(f"damaged, left out: {name}\n")
    return ExitCode.DAMAGED if moved.damaged else ExitCode.DONE


def compare_command(args: argparse.Namespace, options: Options) -> int:
    """Settings, times and figures of two runs that differ."""
    workspace = Workspace.open(options.workspace)
    names = [_run(workspace, word) for word in (args.old, args.new)]
    old, new = (_facts(workspace, name) for name in names)
    settings = _differing(old["settings"], new["settings"])
    rows = []
    for label in sorted(old["results"].keys() | new["results"].keys()):
        a, b = old["results"].get(label), new["results"].get(label)
        if a is None or b is None or a["digest"] != b["digest"]:
            rows.append({"label": label, "old": a, "new": b})
    if args.json:
        print_json({"runs": names, "settings": settings, "results": rows})
        return ExitCode.DONE
    out = sys.stdout
    out.write(f"{names[0]} -> {names[1]}\n")
    for name, (a, b) in settings.items():
        out.write(f"  settings  {name}  {_short(a)} -> {_short(b)}\n")
    for row in rows:
        out.write(f"  {row['label']}  {_change(row['old'], row['new'])}\n")
        for name, (a, b) in _differing(_metrics(row["old"]), _metrics(row["new"])).items():
            out.write(f"      {name}  {_short(a)} -> {_short(b)}\n")
    same = len(old["results"].keys() & new["results"].keys()) - sum(1 for r in rows if r["old"] and r["new"])
    out.write(f"  {same} results are the same\n")
    return ExitCode.DONE


def _run(workspace: Workspace, word: str) -> str:
    runs, named = list_runs(workspace), pins(workspace)
    if word == "latest" and runs:
        return runs[0]
    found = named.get(word, word)
    if found not in runs:
        raise BadInput(f"there is no run {word!r}", hint=did_you_mean(word, [*runs[:5], *named, "latest"]))
    return found


def _facts(workspace: Workspace, run: str) -> dict[str, Any]:
    path = workspace.runs / run / "settings.toml"
    tables = read_toml(path) if path.is_file() else {}
    settings = {
        f"{section}.{key}": value
        for section, entries in tables.items()
        if isinstance(entries, dict) and section != "execution"
        for key, value in entries.items()
    }
    results: dict[str, Any] = {}
    for row in read_plan(workspace, run).get("steps", []):
        key, stage, video = row.get("key"), row.get("stage"), row.get("video")
        record = workspace.ledger.find(stage, key) if isinstance(key, str) and isinstance(stage, str) else None
        if record is not None:
            label = f"{stage}/{video}" if video else stage
            facts = {"digest": record.digest, "seconds": record.seconds, "bytes": record.bytes}
            results[label] = facts | {"metrics": record.metrics}
    return {"settings": settings, "results": results}


def _differing(old: dict[str, Any], new: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    return {k: (old.get(k), new.get(k)) for k in [*old, *(k for k in new if k not in old)] if old.get(k) != new.get(k)}


def _metrics(facts: dict[str, Any] | None) -> dict[str, Any]:
    found: dict[str, Any] = facts["metrics"] if facts else {}
    return found


def _change(old: dict[str, Any] | None, new: dict[str, Any] | None) -> str:
    if old is None or new is None:
        return "new" if old is None else "gone"
    times = f"{duration(old['seconds'])} -> {duration(new['seconds'])}"
    return f"changed  {times}, {size(old['bytes'])} -> {size(new['bytes'])}"


def _short(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else "none" if value is None else str(value)
    return text if len(text) <= 60 else text[:57] + "..."
