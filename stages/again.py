"""Running the pipeline from within a command: a child of the same program, with its own progress and exit code."""

from __future__ import annotations

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
