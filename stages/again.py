"""What several commands share: running the pipeline from within one, and the flag that names the model."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def run_pipeline(words: Sequence[str]) -> int:
    """``banmo run WORDS``; returns its exit code. Ctrl-C reaches both; the child saves its work and ends first."""
    root = str(Path(__file__).resolve().parents[1])
    paths = [root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    command = [sys.executable, "-P", "-m", "pipeline.cli", "run", *words]
    child = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)})
    while True:
        try:
            return child.wait()
        except KeyboardInterrupt:
            continue


def add_model(parser: argparse.ArgumentParser, done: str) -> None:
    """``--model DIR``: another name of ``--workspace`` for verbs to whose model something is `done`."""
    parser.add_argument(
        "--model",
        type=Path,
        dest="workspace",
        default=argparse.SUPPRESS,
        metavar="DIR",
        help=f"the workspace whose model is {done}; the same as --workspace",
    )
