"""Networks by name: what is known of public ones (`weights.toml`), and the user's folder where fetched ones lie.

A network that is there lies in ``<home>/<name>/``: ``network.onnx`` and ``network.toml`` (its contract, and a table
``[about]`` with licence, source and digest). Home is ``$BANMO_WEIGHTS``, else ``$XDG_CACHE_HOME/banmo/weights``, else
``~/.cache/banmo/weights``. A setting that takes a network takes such a name as well as a path; the content of the
folder, not its place, enters the key of the action. Planning imports this module, so nothing heavy is imported here.
"""

from __future__ import annotations

import os
import re
import shutil
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline import BadInput

REGISTRY = Path(__file__).with_name("weights.toml")
SLOTS = ("masks", "flow", "features")
NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
MODEL, FACTS = "network.onnx", "network.toml"
_TEXTS = ("slot", "summary", "url", "licence", "source")
_DIGESTS = {"sha256": 64, "md5": 32}


@dataclass(frozen=True)
class Entry:
    """A public network: where it is, how to know it, what it expects."""

    name: str
    slot: str
    summary: str
    url: str
    licence: str
    source: str
    digest_kind: str
    digest: str
    bytes: int = 0
    contract: dict[str, Any] = field(default_factory=dict)


def home() -> Path:
    """Folder of fetched and added networks."""
    named = os.environ.get("BANMO_WEIGHTS", "")
    cache = os.environ.get("XDG_CACHE_HOME", "")
    if named:
        return Path(named).expanduser()
    return (Path(cache) if cache and Path(cache).is_absolute() else Path.home() / ".cache") / "banmo" / "weights"


def read_registry(path: Path = REGISTRY) -> dict[str, Entry]:
    """Known networks by name. Raises BadInput naming the table at fault."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"{path.name} cannot be read as TOML ({error})") from error
    return {name: _entry(name, row, path.name) for name, row in table.items()}


def _entry(name: str, row: Any, where: str) -> Entry:
    what = f"{where}: [{name}]"
    if not NAME.fullmatch(name) or not isinstance(row, dict):
        raise BadInput(f"{what} must be a table named in small letters, digits, dots and dashes")
    known = {*_TEXTS, *_DIGESTS, "bytes", "contract"}
    if set(row) - known:
        raise BadInput(f"{what} has an unknown key {min(set(row) - known)!r}")
    for key in _TEXTS:
        if not isinstance(row.get(key), str) or not row[key]:
            raise BadInput(f"{what} lacks {key}")
    if row["slot"] not in SLOTS:
        raise BadInput(f"{what} is for {row['slot']!r}, which is none of {', '.join(SLOTS)}")
    kinds = [k for k in _DIGESTS if k in row]
    if not kinds or not re.fullmatch(rf"[0-9a-f]{{{_DIGESTS[kinds[0]]}}}", str(row[kinds[0]])):
        raise BadInput(f"{what} lacks a digest: sha256 or md5, in hex")
    size = row.get("bytes", 0)
    if isinstance(size, bool) or not isinstance(size, int) or size < 0 or not isinstance(row.get("contract", {}), dict):
        raise BadInput(f"{what}: bytes is a number and contract a table")
    texts = {key: row[key] for key in _TEXTS}
    return Entry(
        name=name, **texts, digest_kind=kinds[0], digest=row[kinds[0]], bytes=size, contract=row.get("contract", {})
    )


def here() -> dict[str, Path]:
    """Folders of the networks that are on this machine, by name."""
    root = home()
    if not root.is_dir():
        return {}
    return {p.name: p for p in sorted(root.iterdir()) if NAME.fullmatch(p.name) and (p / MODEL).is_file()}


def find(name: str) -> str | None:
    """The folder of a network named in a setting; None where no such name is known.

    Raises BadInput with the command that fetches it when it is known but not on this machine.
    """
    if not NAME.fullmatch(name):
        return None
    folder = home() / name
    if (folder / MODEL).is_file():
        return str(folder)
    if name in read_registry():
        raise BadInput(f"the network {name!r} is not on this machine", hint=f"banmo weights get {name}")
    return None


def about(folder: Path) -> dict[str, Any]:
    """The table ``[about]`` of a network that is here; empty when it cannot be read."""
    found = _facts(folder).get("about", {})
    return found if isinstance(found, dict) else {}


def contract_table(folder: Path) -> dict[str, Any]:
    """The contract of a network that is here, as it is written."""
    return {key: value for key, value in _facts(folder).items() if key != "about"}


def _facts(folder: Path) -> dict[str, Any]:
    try:
        return tomllib.loads((folder / FACTS).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}


def keep(
    name: str,
    bring: Callable[[Path], object],
    contract: dict[str, Any],
    facts: dict[str, str],
    judge: Callable[[Path], object] = lambda folder: None,
) -> Path:
    """Make ``<home>/<name>/`` in one step: `bring` writes the model file, `judge` may refuse the finished folder.

    What an earlier call put there is replaced. Returns the folder.
    """
    if not NAME.fullmatch(name):
        raise BadInput(f"{name!r} cannot be a name", hint="small letters, digits, dots and dashes")
    root = home()
    fresh = root / f".{name}-{os.getpid()}"
    try:
        root.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir()
        bring(fresh / MODEL)
        (fresh / FACTS).write_text(_toml(contract) + "\n[about]\n" + _toml(facts), encoding="utf-8")
        judge(fresh)
        target, retired = root / name, root / f".{name}-{os.getpid()}-old"
        if target.exists():
            os.rename(target, retired)
        os.rename(fresh, target)
        shutil.rmtree(retired, ignore_errors=True)
        return target
    except OSError as error:
        raise BadInput(f"it cannot be written ({error.strerror})", where=root) from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


@contextmanager
def locked(name: str) -> Iterator[None]:
    """Hold the right to fetch or add a network of this name; others wait."""
    from filelock import FileLock

    folder = home() / "parts"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / f"{name[:64]}.lock"):
            yield
    except PermissionError as error:
        raise BadInput(
            "this folder cannot be written", where=home(), hint="set BANMO_WEIGHTS to one that can"
        ) from error


def _toml(table: dict[str, Any]) -> str:
    return "".join(f"{key} = {_value(value)}\n" for key, value in table.items())


def _value(value: Any) -> str:
    if isinstance(value, str):
        plain = "".join(c if c.isprintable() else " " for c in value)
        return '"' + plain.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return repr(value)
