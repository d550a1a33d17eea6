"""How a run ended, and the interface of what shows it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

from pipeline.plan import Step


class Display(Protocol):
    """What shows a run to people."""

    def event(self, label: str, event: dict[str, Any]) -> None:
        """Something happened to the node `label`: queued, hit, started, progress, warning, done, failed, …"""

    def refresh(self) -> None:
        """Time passed."""


@dataclass
class Report:
    """How a run ended."""

    done: list[str] = field(default_factory=list)
    hits: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    bad_input: dict[str, str] = field(default_factory=dict)
    interrupted: list[str] = field(default_factory=list)
    blocked: dict[str, str] = field(default_factory=dict)
    not_started: list[str] = field(default_factory=list)
    warnings: dict[str, list[str]] = field(default_factory=dict)
    undecided: list[Step] = field(default_factory=list)
    stopped_by: int | None = None
    seconds: float = 0.0
