"""What a stage's parameters stand for, from the request of its action."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.contract import Folder, Given, Source, Stage
from pipeline.describe import build, settings_class
from pipeline.locks import Patience


def arguments(request: dict[str, Any], found: Stage, patience: Patience) -> dict[str, Any]:
    """Inputs, sources, what lies beside them, and settings, by the names of parameters.

    Folders that another machine has made just now may show up late; `patience` says how long they are waited for.
    """

    def folder(value: dict[str, str]) -> Folder:
        path = Path(value["path"])
        patience.until(path.is_dir)
        return Folder(path, value["digest"])

    known: dict[str, Any] = {}
    for name, value in request["inputs"].items():
        if "folders" in value:
            known[name] = {v: folder(f) for v, f in sorted(value["folders"].items())}
        else:
            known[name] = folder(value["folder"])
    sources = {v["name"]: Source(Path(v["path"]), v["name"], v["digest"], v["is_folder"]) for v in request["sources"]}
    given = {
        v["name"]: Given({s: Path(p) for s, p in v["given"].items()}, v["given_digests"]) for v in request["sources"]
    }
    only = request["video"]
    if sources:
        known["video"] = sources[only] if only else dict(sorted(sources.items()))
        known["given"] = given[only] if only else dict(sorted(given.items()))
    kind = settings_class(found)
    if kind is not None:
        known["settings"] = build(kind, request["settings"])
    return known
