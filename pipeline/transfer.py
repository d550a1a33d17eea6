"""Between a workspace and a store elsewhere: ``push``, ``pull``, and reading through to a shared store.

What travels are records with the folders they name, and the runs' own papers (plan, settings, events, logs). Arriving
folders are published like results made here: hashed, compared with their name, then moved in; records follow.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput
from pipeline.files import relink, remove_tree, unique, write_atomic
from pipeline.ledger import Record, parse
from pipeline.locks import Patience
from pipeline.remote import Remote
from pipeline.runs import list_runs, read_plan, view_place
from pipeline.workspace import Workspace

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_RUN = re.compile(r"[0-9A-Za-z][0-9A-Za-z.:-]{0,80}\Z")
_HEX = re.compile(r"[0-9a-f]{64}\Z")
_PAPERS = ("plan.json", "settings.toml", "events.jsonl")


@dataclass
class Moved:
    """What a transfer did, or would do."""

    folders: int = 0
    bytes: int = 0
    records: int = 0
    present: int = 0
    runs: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """For machines."""
        return dict(vars(self))


def push(workspace: Workspace, remote: Remote, *, everything: bool = False, dry_run: bool = False) -> Moved:
    """Copy the results of the newest run (or `everything`) to another store. What is there already is left alone."""
    moved = Moved()
    runs = list_runs(workspace)
    chosen = runs if everything else runs[:1]
    keys = {str(row.get("key")) for run in chosen for row in _rows(read_plan(workspace, run))}
    stored: set[tuple[str, str]] = set()
    for stage in workspace.ledger.stages():
        there = set(remote.names(f"actions/{stage}"))
        for record in workspace.ledger.all(stage):
            if not everything and record.key not in keys:
                continue
            folder = (stage, record.digest)
            if f"{record.key}.json" in there and (folder in stored or remote.has(*folder)):
                moved.present += 1
                continue
            if not workspace.objects.sound(*folder):
                moved.damaged.append(record.label)
                continue
            if folder not in stored and not remote.has(*folder):
                moved.folders += 1
                moved.bytes += record.bytes
                if not dry_run:
                    remote.store(*folder, workspace.objects.path(*folder), workspace.objects.seal_path(*folder))
            stored.add(folder)
            moved.records += 1
            if not dry_run:
                remote.write(
                    f"actions/{stage}/{record.key}.json", workspace.ledger.path(stage, record.key).read_bytes()
                )
    known = set(remote.names("runs"))
    for run in chosen:
        if run not in known:
            moved.runs.append(run)
            if not dry_run:
                _push_run(workspace, remote, run)
    if not dry_run:
        if workspace.settings_path.is_file():
            remote.write("pipeline.toml", workspace.settings_path.read_bytes())
        remote.write("FORMAT", b"1\n")
    return moved


def pull(workspace: Workspace, remote: Remote, *, everything: bool = False, dry_run: bool = False) -> Moved:
    """Copy the results of the other store's newest run (or `everything`) here, verified on arrival."""
    moved = Moved()
    if remote.read("FORMAT") is None:
        raise BadInput("there is no store at this place", where=remote.url, hint="push one there first")
    runs = sorted((r for r in remote.names("runs") if _RUN.match(r)), reverse=True)
    chosen = runs if everything else runs[:1]
    plans = {run: _json(remote.read(f"runs/{run}/plan.json")) for run in chosen}
    keys = {(str(row.get("stage")), str(row.get("key"))) for plan in plans.values() for row in _rows(plan)}
    if everything:
        for stage in remote.names("actions"):
            keys |= {(stage, name.removesuffix(".json")) for name in remote.names(f"actions/{stage}")}
    for stage, key in sorted(keys):
        if _NAME.match(stage) and _HEX.match(key):
            _pull_one(workspace, remote, stage, key, moved, dry_run)
    for run in chosen:
        if not (workspace.runs / run).exists():
            moved.runs.append(run)
            if not dry_run:
                _pull_run(workspace, remote, run, plans[run])
    if not dry_run and not workspace.settings_path.exists():
        text = remote.read("pipeline.toml")
        if text is not None:
            write_atomic(workspace.settings_path, text.decode("utf-8", "replace"))
    return moved


def fetch(workspace: Workspace, remote: Remote, stage: str, key: str, patience: Patience) -> Record | None:
    """The record of an action from another store, its folder brought here and verified; None when it has none.

    A record is written after its folder: what of that is missing may be on its way still, and is waited for.
    """
    data = remote.read(f"actions/{stage}/{key}.json")
    record = parse(_json(data), stage, key)
    if record is None:
        return None
    if not _bring(workspace, remote, record):
        late = not remote.complete(stage, record.digest)
        arrived = late and patience.until(lambda: remote.complete(stage, record.digest))
        if not (arrived and _bring(workspace, remote, record)):
            return None
    workspace.ledger.write(record)
    return record


def _pull_one(workspace: Workspace, remote: Remote, stage: str, key: str, moved: Moved, dry_run: bool) -> None:
    mine = workspace.ledger.find(stage, key)
    if mine is not None and workspace.objects.sound(stage, mine.digest):
        moved.present += 1
        return
    record = parse(_json(remote.read(f"actions/{stage}/{key}.json")), stage, key)
    if record is None:
        moved.damaged.append(f"{stage} {key[:12]}")
        return
    if not dry_run and not _bring(workspace, remote, record):
        moved.damaged.append(record.label)
        return
    moved.folders += 1
    moved.bytes += record.bytes
    moved.records += 1
    if not dry_run:
        workspace.ledger.write(record)


def _bring(workspace: Workspace, remote: Remote, record: Record) -> bool:
    """Have the folder of a record here; every byte is hashed twice, on arrival and on publication."""
    if workspace.objects.sound(record.stage, record.digest):
        return True
    scratch = workspace.tmp / f"fetch-{unique()}"
    scratch.mkdir(parents=True)
    try:
        if not remote.fetch(record.stage, record.digest, scratch):
            return False
        return workspace.objects.publish(record.stage, scratch).digest == record.digest
    finally:
        remove_tree(scratch)


def _push_run(workspace: Workspace, remote: Remote, run: str) -> None:
    folder = workspace.runs / run
    for path in sorted(folder.glob("logs/*.txt")):
        remote.write(f"runs/{run}/logs/{path.name}", path.read_bytes())
    for name in reversed(_PAPERS):  # the plan last: it makes the run visible
        if (folder / name).is_file():
            remote.write(f"runs/{run}/{name}", (folder / name).read_bytes())


def _pull_run(workspace: Workspace, remote: Remote, run: str, plan: Any) -> None:
    folder = workspace.runs / run
    names = [f"logs/{n}" for n in remote.names(f"runs/{run}/logs") if n.endswith(".txt")]
    for name in (*names, *reversed(_PAPERS)):
        data = remote.read(f"runs/{run}/{name}")
        if data is not None:
            write_atomic(folder / name, data.decode("utf-8", "replace"))
    view = folder / "view"
    for row in _rows(plan):
        stage, video, digest = row.get("stage"), row.get("video"), row.get("digest")
        plain = video is None or (isinstance(video, str) and "/" not in video and video not in ("", ".", ".."))
        if isinstance(stage, str) and _NAME.match(stage) and isinstance(digest, str) and _HEX.match(digest) and plain:
            place = view_place(view, stage, video)
            target = Path(*[".."] * (len(place.relative_to(workspace.root).parts) - 1)) / "objects" / stage / digest
            relink(place, str(target))
    newest = list_runs(workspace)[:1]
    if newest == [run] and view.is_dir():
        relink(workspace.root / "latest", f"runs/{run}/view")


def _rows(plan: Any) -> list[dict[str, Any]]:
    rows = plan.get("steps") if isinstance(plan, dict) else None
    return [r for r in rows if isinstance(r, dict) and r.get("key")] if isinstance(rows, list) else []


def _json(data: bytes | None) -> Any:
    try:
        return json.loads(data) if data else None
    except (ValueError, RecursionError):
        return None
