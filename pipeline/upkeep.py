"""Check and tidy the store: verify, repair, collect."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput
from pipeline.files import read_json, remove_tree
from pipeline.ledger import Record
from pipeline.objects import walk
from pipeline.runs import list_runs, read_plan
from pipeline.workspace import Workspace

_YOUNG_S = 86400.0


@dataclass
class Findings:
    """What ``verify`` saw."""

    objects: int = 0
    records: int = 0
    faults: list[str] = field(default_factory=list)
    repaired: list[str] = field(default_factory=list)
    hashed: int = 0


def verify(workspace: Workspace, *, deep: bool, share: float = 1.0, repair: bool = False) -> Findings:
    """Check every record and folder. Quick: counts and sizes; deep: every byte of a random `share` of the folders."""
    found = Findings()
    facts: dict[tuple[str, str], Record] = {}
    for stage in workspace.ledger.stages():
        for path in sorted((workspace.ledger.root / stage).glob("*")):
            if path.name.startswith("."):
                continue
            found.records += 1
            record = workspace.ledger.find(stage, path.stem) if path.suffix == ".json" else None
            if record is None:
                found.faults.append(f"actions/{stage}/{path.name}: not a valid record")
                if repair:
                    _aside(workspace, path)
                    found.repaired.append(f"actions/{stage}/{path.name}")
            else:
                facts[(stage, record.digest)] = record
    present = set(workspace.objects.everything())
    for kind, digest in sorted(present | facts.keys()):
        found.objects += 1
        record = facts.get((kind, digest))
        if deep and random.random() < share:
            found.hashed += 1
            faults = workspace.objects.deep_check(kind, digest)
        elif record is not None:
            faults = workspace.objects.quick_check(kind, digest, record.files, record.bytes)
        else:
            faults = []
        if not faults:
            continue
        if record is None and not workspace.objects.path(kind, digest).exists():
            continue  # a seal without a folder: a publication that was cut short, harmless
        found.faults += faults
        workspace.objects.forget(kind, digest)  # so that no later command trusts it by its times
        if repair and workspace.objects.set_aside(kind, digest):
            found.repaired.append(f"objects/{kind}/{digest}")
    return found


def _aside(workspace: Workspace, path: Path) -> None:
    refuge = workspace.tmp / f"damaged-record-{int(time.time())}-{path.name}"
    refuge.parent.mkdir(parents=True, exist_ok=True)
    path.rename(refuge)


@dataclass
class Garbage:
    """What ``gc`` would delete."""

    records: list[tuple[str, str]] = field(default_factory=list)
    objects: list[tuple[str, str]] = field(default_factory=list)
    folders: list[Path] = field(default_factory=list)
    bytes: int = 0

    def __bool__(self) -> bool:
        return bool(self.records or self.objects or self.folders)


def find_garbage(workspace: Workspace, keep_runs: int, wanted: Iterable[str] = ()) -> Garbage:
    """What no kept run, no pin and no wanted key needs, and what is older than a day.

    `wanted` are keys of the present plan: their records and checkpoints stay.
    """
    runs = list_runs(workspace)
    kept = set(runs[:keep_runs]) | set(pins(workspace).values())
    latest = _latest_run(workspace)
    kept |= {latest} if latest else set()
    roots = {row.get("key") for run in kept for row in read_plan(workspace, run).get("steps", [])} | set(wanted)
    roots |= {p.stem for p in workspace.jobs.glob("*.json")}  # of jobs that wait or run on a cluster, for days maybe
    spared = roots | workspace.attempts_of_jobs()
    now = time.time()
    found = Garbage()
    live: set[tuple[str, str]] = set()
    for stage in workspace.ledger.stages():
        for record in workspace.ledger.all(stage):
            path = workspace.ledger.path(stage, record.key)
            if record.key in roots or now - path.stat().st_mtime < _YOUNG_S:
                live.add((stage, record.digest))
            else:
                found.records.append((stage, record.key))
    for kind, digest in workspace.objects.everything():
        if (kind, digest) not in live and _age(workspace.objects.path(kind, digest), now) > _YOUNG_S:
            found.objects.append((kind, digest))
            found.bytes += tree_bytes(workspace.objects.path(kind, digest))
    for run in runs:
        if run not in kept and _age(workspace.runs / run, now) > _YOUNG_S:
            found.folders.append(workspace.runs / run)
    for place in (workspace.checkpoints, workspace.tmp):
        for path in sorted(place.iterdir()) if place.is_dir() else []:
            if path.name not in spared and _age(path, now) > _YOUNG_S:
                found.folders.append(path)
    found.bytes += sum(tree_bytes(p) for p in found.folders)
    return found


def collect(workspace: Workspace, find: Callable[[], Garbage]) -> Garbage:
    """Delete what `find` finds once nobody else can start a run, and return it: records first, then what they named.

    Refuses while anybody works. What was found before is not trusted: a run may have ended since that stands on it.
    """
    with workspace.exclusive():
        live = workspace.live()
        if live:
            raise BadInput("a run is at work in this workspace", where=workspace.root, hint="wait until it has ended")
        workspace.collected()
        workspace.ledger.refresh()
        garbage = find()
        for stage, key in garbage.records:
            workspace.ledger.path(stage, key).unlink(missing_ok=True)
        workspace.ledger.refresh()
        named = {(s, r.digest) for s in workspace.ledger.stages() for r in workspace.ledger.all(s)}
        for kind, digest in garbage.objects:
            if (kind, digest) not in named:
                workspace.objects.remove(kind, digest)
        for path in garbage.folders:
            remove_tree(path)
        for path in workspace.leases.glob(f"*{workspace.locks.suffix}"):
            if path.stem != "workspace":
                path.unlink(missing_ok=True)
    return garbage


def pins(workspace: Workspace) -> dict[str, str]:
    """Pin name -> run id."""
    value = read_json(workspace.root / "pins.json")
    return {str(k): str(v) for k, v in value.items()} if isinstance(value, dict) else {}


def tree_bytes(path: Path) -> int:
    """Bytes of the files below a path; 0 when it is gone."""
    try:
        return sum(s.st_size for _, _, s in walk(path)) if path.is_dir() else path.stat().st_size
    except OSError:
        return 0


def _latest_run(workspace: Workspace) -> str | None:
    link = workspace.root / "latest"
    try:
        return Path(link.readlink()).parent.name if link.is_symlink() else None
    except OSError:
        return None


def _age(path: Path, now: float) -> float:
    try:
        return now - path.lstat().st_mtime
    except OSError:
        return float("inf")


def as_json(found: Findings) -> dict[str, Any]:
    """Findings for machines."""
    return {
        "objects": found.objects,
        "records": found.records,
        "hashed": found.hashed,
        "faults": found.faults,
        "repaired": found.repaired,
    }
