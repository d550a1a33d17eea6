"""An action's canonical text and key.

The text says everything a result depends on: stage, version, code, settings, inputs, salt. The key is its SHA-256.
Inputs are digests of what was produced, not of how; paths, hosts, dates and thread counts never enter.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from enum import Enum
from typing import Any

FORMAT = 1
_TAG = b"banmo-action-1\n"


@dataclass(frozen=True)
class Action:
    """A stage applied to given folders and settings."""

    text: dict[str, Any]

    @property
    def key(self) -> str:
        """SHA-256 of the canonical text, 64 hexadecimal digits."""
        return key_of(self.text)


def action(
    *, stage: str, version: int, code: str, settings: dict[str, Any], inputs: dict[str, Any], salt: str = ""
) -> Action:
    """Make an action of its parts."""
    return Action(
        {
            "format": FORMAT,
            "stage": stage,
            "version": version,
            "code": code,
            "settings": normal(settings),
            "inputs": normal(inputs),
            "salt": salt,
        }
    )


def normal(value: Any) -> Any:
    """`value` as JSON holds it: tuples as lists, enums by name; anything else is refused."""
    if isinstance(value, Enum):
        return value.name
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return str(value)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if value != value or value in (float("inf"), float("-inf")):
            raise ValueError(f"{value} cannot be part of a key")
        return float(value) + 0.0
    if isinstance(value, list | tuple):
        return [normal(v) for v in value]
    if isinstance(value, dict):
        if not all(isinstance(k, str) for k in value):
            raise TypeError("keys of a canonical text are strings")
        return {k: normal(v) for k, v in value.items()}
    raise TypeError(f"{type(value).__name__} cannot be part of a key")


def canonical(value: Any) -> str:
    """The one text of a value: keys sorted, no spaces, UTF-8, floats by shortest round trip, NaN refused."""
    return json.dumps(normal(value), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def key_of_stored(text: dict[str, Any]) -> str:
    """Key of a text that was read back from JSON: it was brought into normal form before it was written."""
    return _key(json.dumps(text, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False))


def key_of(text: dict[str, Any]) -> str:
    """Key of an action's text."""
    return _key(canonical(text))


def _key(canonical_text: str) -> str:
    return hashlib.sha256(_TAG + canonical_text.encode()).hexdigest()
