"""Why an action has to run: a diff of two canonical texts, recursive to the root cause.

Kinds form a closed list: never run, settings, input, code, version, salt, damaged, asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from pipeline.ledger import Ledger, Record

KINDS = ("never run", "settings", "input", "code", "version", "salt", "damaged", "asked for")

Because = Callable[[str, str | None, str | None, str | None], "list[Reason]"]


@dataclass(frozen=True)
class Reason:
    """One difference between what is wanted and what was done."""

    kind: str
    name: str = ""
    old: Any = None
    new: Any = None
    because: list[Reason] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"{self.kind!r} is no reason")

    def roots(self) -> set[str]:
        """Kinds of the causes at the bottom; an input without a known cause is one."""
        if self.kind == "input" and self.because:
            return {k for r in self.because for k in r.roots()}
        return {self.kind}

    def line(self) -> str:
        """One line for people."""
        if self.kind == "settings":
            return f"settings  {self.name}  {show(self.old)} -> {show(self.new)}"
        if self.kind == "input":
            what = "new" if self.old is None else "gone" if self.new is None else "changed"
            return f"input  {self.name}  {what}"
        if self.kind in ("version", "salt"):
            return f"{self.kind}  {show(self.old)} -> {show(self.new)}"
        return f"{self.kind}  {self.name}".rstrip()

    def as_json(self) -> dict[str, Any]:
        """For machines."""
        found: dict[str, Any] = {"kind": self.kind}
        if self.name:
            found["name"] = self.name
        if self.old is not None or self.new is not None:
            found |= {"old": self.old, "new": self.new}
        if self.because:
            found["because"] = [r.as_json() for r in self.because]
        return found


def brief(reasons: list[Reason], limit: int = 2) -> str:
    """A few words: the first reasons, root causes preferred over the inputs they changed."""
    words: list[str] = []
    for reason in reasons:
        text = reason.line() if reason.kind in ("settings", "code") else f"{reason.kind} {reason.name}".strip()
        words.append(" ".join(text.replace("settings  ", "settings: ").replace("code  ", "code: ").split()))
    more = f" and {len(words) - limit} more" if len(words) > limit else ""
    return "; ".join(words[:limit]) + more


def words_of(stored: list[Any], limit: int = 2) -> str:
    """:func:`brief` of reasons as :meth:`Reason.as_json` wrote them."""
    known = [r for r in stored if isinstance(r, dict) and r.get("kind") in KINDS]
    return brief([Reason(r["kind"], str(r.get("name", "")), r.get("old"), r.get("new")) for r in known], limit)


def tree(reasons: list[Reason], indent: int = 2, seen: set[str] | None = None) -> list[str]:
    """The reasons as indented lines; a cause told once is not told again."""
    seen = set() if seen is None else seen
    lines = []
    for reason in reasons:
        lines.append(" " * indent + reason.line())
        told = f"{reason.kind} {reason.name}"
        if reason.because and told not in seen:
            seen.add(told)
            below = tree(reason.because, indent + 4, seen)
            lines += [" " * (indent + 2) + "because " + below[0].strip(), *below[1:]]
    return lines


def nearest(text: dict[str, Any], ledger: Ledger, stage: str, video: str | None) -> Record | None:
    """The earlier result that differs in the fewest fields; the newest of equals.

    A video that was renamed finds its records by what they read.
    """
    mine = ledger.of_video(stage, video)
    if not mine and video is not None and ledger.all(stage):
        digests = {d for d in _flat(text.get("inputs", {})).values() if isinstance(d, str)}
        mine = ledger.reading(stage, digests)
    return min(mine, key=lambda r: len(_differences(text, r.action)), default=None)


def compare(
    wanted: dict[str, Any], modules: dict[str, str], earlier: Record, because: Because, per_video: Collection[str] = ()
) -> list[Reason]:
    """Every difference between the wanted text and an earlier record's. `per_video` names the stages of one video."""
    reasons: list[Reason] = []
    for area, name, new, old in _differences(wanted, earlier.action):
        if area == "settings":
            reasons.append(Reason("settings", name, old, new))
        elif area == "inputs":
            stage, _, video = name.partition("/")
            if not video and earlier.video and stage in per_video:
                video = earlier.video
            changed = old is not None and new is not None
            cause = because(stage, video or None, new, old) if changed else []
            label = f"{stage}/{video}" if video else stage
            reasons.append(Reason("input", label, old, new, cause))
        elif area == "code":
            files = sorted(
                m for m in modules.keys() | earlier.modules.keys() if modules.get(m) != earlier.modules.get(m)
            )
            reasons.append(Reason("code", ", ".join(files[:3]) + (" …" if len(files) > 3 else "")))
        else:
            reasons.append(Reason("version" if area != "salt" else "salt", "", old, new))
    order = {k: i for i, k in enumerate(("settings", "version", "salt", "input", "code"))}
    return sorted(reasons, key=lambda r: order[r.kind])


def show(value: Any) -> str:
    """A setting's value, short."""
    if isinstance(value, dict) and set(value) == {"file"}:
        return f"file {str(value['file'])[:12]}"
    text = "none" if value is None else str(value) if value != "" else '""'
    return text if len(text) <= 60 else text[:57] + "..."


def _differences(new: dict[str, Any], old: dict[str, Any]) -> list[tuple[str, str, Any, Any]]:
    """(area, name, new, old) for every field that differs; inputs by ``stage/video``."""
    found: list[tuple[str, str, Any, Any]] = []
    for area in ("version", "salt", "code"):
        if new.get(area) != old.get(area):
            found.append((area, "", new.get(area), old.get(area)))
    pairs = (("settings", new.get("settings", {}), old.get("settings", {})),)
    for area, mine, theirs in (*pairs, ("inputs", _flat(new.get("inputs", {})), _flat(old.get("inputs", {})))):
        for name in [*mine, *(k for k in theirs if k not in mine)]:
            if mine.get(name) != theirs.get(name):
                found.append((area, name, mine.get(name), theirs.get(name)))
    return found


def _flat(inputs: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in inputs.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{name}/"))
        else:
            flat[prefix + name] = value
    return flat
