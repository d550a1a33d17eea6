"""A laboratory: a copy of the toy pipeline, some clips, a workspace, and the command line to drive them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline import cli
from pipeline.ledger import Ledger, Record

TOY = Path(__file__).resolve().parent / "toy"


def wait_for(condition: Callable[[], object], timeout_s: float = 240.0) -> None:
    """Wait until something is true; the machine may be many times slower than usual."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.02)


@dataclass
class Outcome:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Standard output, parsed."""
        return json.loads(self.out)


@dataclass
class Lab:
    """One pipeline with its clips and workspace."""

    root: Path
    capture: Callable[[], Any]
    environment: dict[str, str] = field(default_factory=dict)

    @property
    def package(self) -> Path:
        return self.root / "toy"

    @property
    def clips(self) -> Path:
        return self.root / "clips"

    @property
    def workspace(self) -> Path:
        return self.root / "w"

    def command(self, *words: str) -> Outcome:
        """Run a verb in this process."""
        self.capture()
        code = cli.main([words[0], "--workspace", str(self.workspace), *words[1:]])
        captured = self.capture()
        return Outcome(code, captured.out, captured.err)

    def run(self, *words: str, videos: Path | None = None) -> Outcome:
        """``banmo run`` in this process."""
        folder = str(videos or self.clips)
        return self.command("run", "--definition", str(self.package), *words, folder)

    def spawn(self, *words: str, env: dict[str, str] | None = None) -> subprocess.Popen[str]:
        """``banmo run`` in a process of its own, leader of its group."""
        return subprocess.Popen(
            [
                *(sys.executable, "-m", "pipeline.cli", "run", "--workspace", str(self.workspace)),
                *("--definition", str(self.package), *words, str(self.clips)),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, **(env or {})},
        )

    def records(self) -> dict[str, Record]:
        """Newest record of every label."""
        ledger = Ledger(self.workspace / "actions")
        found: dict[str, Record] = {}
        for stage in ledger.stages():
            for record in ledger.all(stage):
                found.setdefault(record.label, record)
        return found

    def digests(self) -> dict[str, str]:
        """Digest of every label's newest result."""
        return {label: record.digest for label, record in self.records().items()}

    def edit(self, name: str, old: str, new: str) -> None:
        """Change a file of the pipeline."""
        path = self.package / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def pending(self, *words: str) -> dict[str, list[str]]:
        """Label -> kinds of reasons, of what would run."""
        steps = self.run("-n", "--json", *words).json["steps"]
        return {
            (f"{s['stage']}/{s['video']}" if s["video"] else s["stage"]): [r["kind"] for r in s["reasons"]]
            for s in steps
            if s["status"] != "hit"
        }

    def object_path(self, label: str) -> Path:
        """Folder of a label's result."""
        record = self.records()[label]
        return self.workspace / "objects" / record.stage / record.digest
