"""Checkpoints of an unfinished phase: whole or absent, newest first.

Each is a folder ``step-000000150`` with ``state.safetensors`` and ``state.json`` (its digest, the model's description,
the metrics so far), built aside and renamed into place. Two are kept: a torn one never costs more than one interval.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Saved:
    """One checkpoint as read."""

    step: int
    tensors: dict[str, Tensor]
    description: dict[str, Any]
    history: list[dict[str, float]]

    def model_tensors(self) -> dict[str, Tensor]:
        """The model's own part of the state."""
        return {k.removeprefix("model."): v for k, v in self.tensors.items() if k.startswith("model.")}


class Checkpoints:
    """The checkpoints of one phase, under `root`."""

    def __init__(self, root: Path, keep: int = 2) -> None:
        self.root, self.keep = root, keep

    def _steps(self) -> list[Path]:
        return sorted((p for p in self.root.glob("step-*") if p.is_dir()), reverse=True)

    def save(
        self, tensors: dict[str, Tensor], description: dict[str, Any], step: int, history: list[dict[str, float]]
    ) -> None:
        """Write one checkpoint durably; older ones beyond `keep` are removed after it is in place."""
        from safetensors.torch import save

        target = self.root / f"step-{step:09d}"
        if target.exists():
            return
        scratch = self.root / f"saving-{os.getpid()}"
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir(parents=True)
        data = save({k: v.contiguous() for k, v in tensors.items()})
        facts = {
            "sha256": hashlib.sha256(data).hexdigest(),
            "step": step,
            "description": description,
            "history": history,
        }
        for name, content in (("state.safetensors", data), ("state.json", json.dumps(facts).encode())):
            with (scratch / name).open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        os.rename(scratch, target)
        for old in self._steps()[self.keep :]:
            shutil.rmtree(old, ignore_errors=True)

    def latest(self) -> Saved | None:
        """The newest checkpoint that is whole, or None."""
        from safetensors import SafetensorError
        from safetensors.torch import load

        for folder in self._steps():
            try:
                facts = json.loads((folder / "state.json").read_text(encoding="utf-8"))
                data = (folder / "state.safetensors").read_bytes()
                if hashlib.sha256(data).hexdigest() != facts["sha256"]:
                    continue
                return Saved(int(facts["step"]), load(data), facts["description"], list(facts["history"]))
            except (OSError, ValueError, KeyError, SafetensorError):
                continue
        return None
