"""Draw a stage's contact sheet in a process of its own: ``python -m pipeline.sheet REQUEST``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pipeline.contract import Folder
from pipeline.describe import bind, build, load_stage, settings_class


def main(argv: list[str]) -> int:
    """Draw; the request is JSON with reference, out, picture, inputs, settings."""
    request = json.loads(argv[0])
    found = load_stage(request["reference"])
    if found.sheet_writer is None:
        return 0
    known: dict[str, Any] = {"out": Path(request["out"]), "picture": Path(request["picture"])}
    for name, value in request["inputs"].items():
        known[name] = {v: Folder(Path(p)) for v, p in value.items()} if isinstance(value, dict) else Folder(Path(value))
    kind = settings_class(found)
    if kind is not None:
        known["settings"] = build(kind, request["settings"])
    found.sheet_writer(**bind(found, found.sheet_writer, known))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
