"""What a worker is told: one JSON file with everything that one attempt needs."""

from __future__ import annotations

from typing import Any

from pipeline.executor import Grant
from pipeline.files import read_json
from pipeline.graph import Node
from pipeline.plan import Planner, Step
from pipeline.settings import stage_values
from pipeline.videos import VideoFile, state_of


def build_request(planner: Planner, step: Step, run: str, grant: Grant) -> dict[str, Any]:
    """The request for a step whose action is known, to run on what was granted."""
    node, info = step.node, step.node.info
    assert step.action is not None and info.code is not None
    takes_sources = "video" in info.takes or "given" in info.takes
    videos = [] if not takes_sources else [node.video] if node.video else planner.graph.videos
    return {
        "workspace": str(planner.workspace.root),
        "package_dir": str(planner.graph.definition.package_dir),
        "reference": info.reference,
        "data": list(info.data),
        "label": node.label,
        "stage": info.name,
        "video": node.video_name,
        "videos": [v.name for v in planner.graph.videos],
        "key": step.action.key,
        "action": step.action.text,
        "modules": info.code.modules,
        "settings": stage_values(planner.settings, info),
        "inputs": _folders(planner, node),
        "sources": [_source(planner, node, v) for v in videos],
        "supersedes": step.record.finished if step.record and node in planner.forced else None,
        "spent_s": _spent_before(planner, step.action.key),
        "run": run,
        "device": "cuda" if grant.gpus else "cpu",
        "threads": grant.threads,
        "grace_s": planner.settings.execution.grace_s,
        "latency_s": planner.settings.store.latency_s,
        "watch_parent": True,
    }


def _spent_before(planner: Planner, key: str) -> float:
    """Seconds that stopped attempts have put into the checkpoint this one goes on from."""
    workspace = planner.workspace
    note = read_json(workspace.attempts / f"{key}.json")
    if not isinstance(note, dict) or not (workspace.checkpoints / key).is_dir():
        return 0.0
    spent = note.get("spent_s")
    return float(spent) if isinstance(spent, int | float) else 0.0


def _folders(planner: Planner, node: Node) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, nodes in planner.graph.inputs(node).items():
        folders = {}
        for source in nodes:
            digest = planner.results[source.label].digest
            path = planner.workspace.objects.path(name, digest)
            folders[source.video_name or ""] = {"path": str(path), "digest": digest}
        by_video = node.video is None and bool(nodes) and nodes[0].video is not None
        found[name] = {"folders": folders} if by_video else {"folder": next(iter(folders.values()))}
    return found


def _source(planner: Planner, node: Node, video: VideoFile) -> dict[str, Any]:
    digests = planner.sources
    given = {s: p for s, p in video.given.items() if s in node.info.given and "given" in node.info.takes}
    read = [*given.values(), *([video.path] if "video" in node.info.takes else [])]
    return {
        "name": video.name,
        "path": str(video.path),
        "digest": digests.of(video.path) if "video" in node.info.takes else "",
        "is_folder": video.is_folder,
        "given": {s: str(p) for s, p in given.items()},
        "given_digests": {s: digests.of(p) for s, p in given.items()},
        "states": {str(p): state_of(p) for p in read},
    }
