"""Verbs that a pipeline brings with it: ``VERBS = {"render": "stages.verbs.render"}`` in its package.

A verb is a module with ``SUMMARY`` (one line), ``EXAMPLES`` (tuple of commands), ``arguments(parser)`` and
``run(args, results) -> exit code``. The engine imports it only when the verb is called, and reads ``SUMMARY`` for the
list of commands without importing anything. What the module imports at its top is what ``--help`` waits for.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.definition import locate, names_in
from pipeline.errors import BadInput, StageError
from pipeline.project import Options, package_of
from pipeline.results import Results
from pipeline.workspace import Workspace

_NEEDED = ("SUMMARY", "EXAMPLES", "arguments", "run")


@dataclass(frozen=True)
class Verb:
    """A verb of the pipeline: its name, its module, what it says of itself."""

    name: str
    module: str
    summary: str
    package_dir: Path

    def load(self) -> ModuleType:
        """Import the module. Raises StageError when it is no verb."""
        parent = str(self.package_dir.parent)
        if parent not in sys.path:
            sys.path.insert(0, parent)
        try:
            module = importlib.import_module(self.module)
        except ImportError as error:
            raise StageError(f"the command {self.name!r} cannot be loaded: {error}") from error
        missing = [n for n in _NEEDED if not hasattr(module, n)]
        if missing:
            raise StageError(f"the command {self.name!r} cannot be loaded: {self.module} lacks {', '.join(missing)}")
        return module


def verbs_of(options: Options) -> dict[str, Verb]:
    """The verbs of the pipeline that these options name; none when it cannot be found."""
    try:
        memory = Workspace(options.workspace).remembered()
        folder = locate(package_of(options, memory))
        named = names_in(folder / "__init__.py").get("VERBS") or {}
    except (BadInput, OSError):
        return {}
    found = {}
    for name, module in named.items() if isinstance(named, dict) else ():
        path = folder.parent.joinpath(*str(module).split(".")).with_suffix(".py")
        found[str(name)] = Verb(str(name), str(module), _summary(path), folder)
    return found


def add_arguments(verb: Verb, parser: argparse.ArgumentParser) -> tuple[str, tuple[str, ...]]:
    """Let the verb add its flags; returns its summary and examples."""
    module: Any = verb.load()
    module.arguments(parser)
    return str(module.SUMMARY), tuple(module.EXAMPLES)


def takes_settings(verb: Verb) -> bool:
    """Whether settings of stages (``--stage.key value``) are for this verb: it says ``TAKES_SETTINGS = True``.

    It then finds them in ``args.overrides``, as (name, text).
    """
    return bool(getattr(verb.load(), "TAKES_SETTINGS", False))


def run_verb(verb: Verb, args: argparse.Namespace, options: Options) -> int:
    """Run a verb on the results of a workspace; returns its exit code.

    One that says ``NEEDS_WORKSPACE = False`` gets no results, and works where there is no workspace.
    """
    module: Any = verb.load()
    results = Results(options.workspace) if getattr(module, "NEEDS_WORKSPACE", True) else None
    return int(module.run(args, results))


def _summary(path: Path) -> str:
    """``SUMMARY`` of a module, read without importing it."""
    try:
        value = names_in(path).get("SUMMARY", "")
    except (BadInput, OSError):
        return ""
    return value if isinstance(value, str) else ""
