"""Before a run starts: will its results fit on the disk?

What an action wrote before is the best guess; else the stage's own ``@stage.estimate``, asked in a child process
(``python -m pipeline.preflight``) because it imports the stage; else a small constant. A stage's estimate may raise
:class:`BadInput`, which then ends the run before it starts.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from pipeline.console import size
from pipeline.contract import Given, Source
from pipeline.definition import child_environment
from pipeline.describe import bind, build, load_stage, settings_class
from pipeline.errors import BadInput
from pipeline.files import read_json
from pipeline.graph import Node
from pipeline.plan import Planner, Step
from pipeline.project import Project
from pipeline.settings import stage_values

_UNKNOWN_BYTES = 16_000_000
_SPARE_BYTES = 64_000_000


def check_disk(project: Project, planner: Planner, pending: list[Step]) -> None:
    """Raise BadInput when the disk is clearly too small for what is to run."""
    free = project.workspace.free_bytes()
    needed = _SPARE_BYTES
    asked: list[Step] = []
    for step in pending:
        same = step.record is not None and not any(r.kind == "settings" for r in step.reasons)
        if step.node.info.estimates and not same:
            asked.append(step)
        elif step.record is not None:
            needed += step.record.bytes
        else:
            needed += _UNKNOWN_BYTES
    needed += sum(_ask(project, asked)) if asked else 0
    if needed > free:
        raise BadInput(
            f"about {size(needed)} are needed and {size(free)} are free on this disk",
            where=project.workspace.root,
            hint="free some space, choose another --workspace, or see `banmo gc`",
        )


def _ask(project: Project, steps: list[Step]) -> list[int]:
    requests = [_request(project, s.node) for s in steps]
    with tempfile.TemporaryDirectory(prefix="banmo-preflight-") as scratch:
        source, target = Path(scratch) / "in.json", Path(scratch) / "out.json"
        source.write_text(json.dumps(requests), encoding="utf-8")
        child = subprocess.run(
            [sys.executable, "-P", "-m", "pipeline.preflight", str(source), str(target)],
            env=child_environment(project.definition.package_dir),
            cwd=scratch,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        found = read_json(target)
    if not isinstance(found, list):
        sys.stderr.write(f"note: disk use could not be estimated: {child.stderr.strip()[-300:]}\n")
        return [_UNKNOWN_BYTES] * len(steps)
    for entry in found:
        if "bad_input" in entry:
            raise BadInput(**entry["bad_input"])
    return [int(entry.get("bytes", _UNKNOWN_BYTES)) for entry in found]


def _request(project: Project, node: Node) -> dict[str, Any]:
    videos = [node.video] if node.video else project.videos
    return {
        "reference": node.info.reference,
        "only": node.video_name,
        "settings": stage_values(project.settings, node.info),
        "videos": [
            {
                "name": v.name,
                "path": str(v.path),
                "is_folder": v.is_folder,
                "given": {s: str(p) for s, p in v.given.items() if s in node.info.given},
            }
            for v in videos
        ],
    }


def _answer(request: dict[str, Any]) -> dict[str, Any]:
    try:
        found = load_stage(request["reference"])
        if found.estimator is None:
            return {}
        videos = request["videos"]
        sources = {v["name"]: Source(Path(v["path"]), v["name"], "", v["is_folder"]) for v in videos}
        given = {v["name"]: Given({s: Path(p) for s, p in v["given"].items()}) for v in videos}
        only = request["only"]
        known: dict[str, Any] = {
            "video": sources[only] if only else sources,
            "given": given[only] if only else given,
        }
        kind = settings_class(found)
        if kind is not None:
            known["settings"] = build(kind, request["settings"])
        return {"bytes": max(0, int(found.estimator(**bind(found, found.estimator, known))))}
    except BadInput as error:
        return {"bad_input": {"what": error.what, "where": error.where, "hint": error.hint}}
    except Exception as error:  # an estimate that fails must not stop the work
        return {"error": str(error)}


def main(argv: list[str]) -> int:
    """Answer the requests in the first file into the second."""
    requests = json.loads(Path(argv[0]).read_text(encoding="utf-8"))
    Path(argv[1]).write_text(json.dumps([_answer(r) for r in requests]), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
