"""The code guard: when only code changed and the earlier result was expensive, ask before redoing it."""

from __future__ import annotations

from pipeline.console import duration
from pipeline.errors import DecisionNeeded
from pipeline.graph import Node
from pipeline.plan import HIT, Step


def needs_decision(step: Step, forced: set[Node], guard_minutes: float) -> bool:
    """Whether this step would redo expensive work for a change of code alone."""
    if step.status == HIT or step.node in forced or step.record is None:
        return False
    if step.record.seconds <= guard_minutes * 60:
        return False
    kinds = {r.kind for r in step.reasons}
    roots = {k for r in step.reasons for k in r.roots()}
    return "code" in kinds and roots == {"code"}


def decision(steps: list[Step]) -> DecisionNeeded:
    """The question to put to the user."""
    lines = []
    for step in steps:
        assert step.record is not None
        label = step.node.label.replace("/", " ")
        changed = ", ".join(r.name for r in step.reasons if r.kind == "code")
        lines += [
            f"{step.node.label} was made by other code; redoing it costs about {duration(step.record.seconds)}",
            f"  changed  {changed}",
            f"  redo     banmo run --redo {step.node.info.name}",
            f"  keep     banmo bless {label}        the change does not alter the result",
        ]
    return GuardStop("\n".join(lines))


class GuardStop(DecisionNeeded):
    """A decision that is told in several lines."""

    def __str__(self) -> str:
        return "stop: " + self.what
