"""The pipeline as data: which stages there are, in order, and what each declares.

The package that defines a pipeline names it in its ``__init__.py`` by three literals, read without importing it:
``PIPELINE`` (tuple of ``module:function``), ``GROUPS`` (name -> stages) and ``PRESETS`` (a TOML file beside it); a
fourth, ``VERBS``, names commands of its own (:mod:`pipeline.verbs`); a fifth, ``EXPORTS``, the stages whose files a
user gets (the last one where it is not there); a sixth, ``NAMED_FILES``, a ``module:function`` that turns a name in a
setting that takes a file into a path (None where it knows no such name).
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib.util
import os
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput, StageError, did_you_mean
from pipeline.files import read_json, write_memo
from pipeline.source import Code, CodeReader

_ENGINE_ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class StageInfo:
    """What a stage declares. `error` is set when its module cannot be imported; then nothing else is known."""

    name: str
    reference: str
    code: Code | None
    per_video: bool = True
    version: int = 1
    given: tuple[str, ...] = ()
    data: tuple[str, ...] = ()
    cpus: int = 1
    gpus: int = 0
    distributed: bool = False
    inputs: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    doc: str = ""
    fields: tuple[dict[str, Any], ...] = ()
    estimates: bool = False
    sheet: bool = False
    error: str = ""


@dataclass(frozen=True)
class Definition:
    """A pipeline: its stages in data order, groups of names, presets."""

    package_dir: Path
    stages: dict[str, StageInfo]
    groups: dict[str, tuple[str, ...]]
    presets: dict[str, dict[str, Any]]
    presets_path: Path | None
    exported: tuple[str, ...] = ()
    """Stages whose files are copied to ``exports/``: those that EXPORTS names, else the last."""
    named_files: str = ""
    """``module:function`` that knows files by name."""

    @property
    def given_suffixes(self) -> tuple[str, ...]:
        """Every suffix that some stage accepts beside a video."""
        return tuple(sorted({s for info in self.stages.values() for s in info.given}))

    def names(self, word: str) -> tuple[str, ...]:
        """The stages a word of the command line stands for. Raises BadInput with a suggestion."""
        if word in self.stages:
            return (word,)
        if word in self.groups:
            return self.groups[word]
        raise BadInput(f"there is no stage {word!r}", hint=did_you_mean(word, [*self.stages, *self.groups]))


def load(package: str, cache: Path | None = None) -> Definition:
    """Read a pipeline's definition; `package` is an importable name or the path of a package's folder."""
    folder = locate(package)
    constants = names_in(folder / "__init__.py")
    references = constants.get("PIPELINE")
    if not isinstance(references, list | tuple) or not all(isinstance(r, str) and ":" in r for r in references):
        raise BadInput("PIPELINE must be a tuple of 'module:function'", where=folder / "__init__.py")
    root = folder  # a pipeline may be defined by a package inside another one, whose modules it then shares
    while (root.parent / "__init__.py").is_file():
        root = root.parent
    reader = CodeReader(root, cache / "code.json" if cache else None)
    infos = _describe_all(root, list(references), reader, cache)
    stages = {info.name: info for info in infos}
    _check_order(infos)
    presets_path = folder / str(constants["PRESETS"]) if constants.get("PRESETS") else None
    presets = read_toml(presets_path) if presets_path else {}
    groups = {str(k): tuple(v) for k, v in (constants.get("GROUPS") or {}).items()}
    reader.save()
    exported = tuple(str(name) for name in constants.get("EXPORTS") or [list(stages)[-1]])
    for name in exported:
        if name not in stages:
            raise BadInput(f"EXPORTS names {name!r}, which is no stage", where=folder / "__init__.py")
    named_files = str(constants.get("NAMED_FILES") or "")
    return Definition(root, stages, groups, presets, presets_path, exported, named_files)


def locate(package: str) -> Path:
    """Folder of the package, without importing it."""
    if "/" in package or package in (".", ".."):
        folder = Path(package).resolve()
    else:
        spec = importlib.util.find_spec(package.split(".")[0])
        places = list(spec.submodule_search_locations or []) if spec else []
        if not places:
            raise BadInput(f"there is no package {package!r} that defines a pipeline")
        folder = Path(places[0]).joinpath(*package.split(".")[1:]).resolve()
    if not (folder / "__init__.py").is_file():
        raise BadInput("no __init__.py here that defines a pipeline", where=folder)
    return folder


def read_toml(path: Path) -> dict[str, Any]:
    """Parsed TOML. Raises BadInput naming the file and the line."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadInput(f"not valid TOML: {error}", where=path) from error
    except OSError as error:
        raise BadInput(f"it cannot be read ({error.strerror})", where=path) from error


def child_environment(package_dir: Path) -> dict[str, str]:
    """Environment in which a child process finds the engine and the pipeline's package, and nothing by accident."""
    environment = dict(os.environ)
    paths = [str(_ENGINE_ROOT), str(package_dir.parent), *environment.get("PYTHONPATH", "").split(os.pathsep)]
    environment["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(p for p in paths if p))
    environment["PYTHONHASHSEED"] = "0"
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        environment.pop(name, None)  # those of whoever started us are not the worker's
    environment.setdefault("GOMP_SPINCOUNT", "2000")  # spinning threads starve their neighbours on a shared machine
    environment.setdefault("MALLOC_TRIM_THRESHOLD_", "17179869184")  # both: fewer page faults, training gains a fifth
    environment.setdefault("MALLOC_MMAP_MAX_", "0")
    return environment


def names_in(path: Path) -> dict[str, Any]:
    """The literals that a module assigns to names at its top, read without importing it."""
    try:
        tree = ast.parse(path.read_bytes(), filename=str(path))
    except (SyntaxError, ValueError) as error:
        raise BadInput(f"not valid Python ({error})", where=path) from error
    found: dict[str, Any] = {}
    for statement in tree.body:
        target = statement.targets[0] if isinstance(statement, ast.Assign) else None
        target = statement.target if isinstance(statement, ast.AnnAssign) else target
        if isinstance(statement, ast.Assign | ast.AnnAssign) and isinstance(target, ast.Name) and statement.value:
            with contextlib.suppress(ValueError, TypeError):
                found[target.id] = ast.literal_eval(statement.value)
    return found


def _describe_all(folder: Path, references: list[str], reader: CodeReader, cache: Path | None) -> list[StageInfo]:
    described: dict[str, Any] = {}
    keys: dict[str, str] = {}
    missing: dict[str, str] = {}
    for reference in references:
        module = reference.partition(":")[0]
        path = reader.find(module)
        if path is None:
            missing[reference] = f"there is no file for {module} yet"
            continue
        code = reader.fingerprint(module)
        material = f"4\n{sys.version}\n{reference}\n{code.digest}\n".encode() + path.read_bytes()
        keys[reference] = hashlib.sha256(material).hexdigest()
        stored = read_json(cache / "contracts" / f"{keys[reference]}.json") if cache else None
        if isinstance(stored, dict) and stored.get("reference") == reference:
            described[reference] = stored
    stale = [r for r in keys if r not in described]
    if stale:
        for reference, value in _ask(folder, stale).items():
            described[reference] = value
            if cache and "error" not in value:
                write_memo(cache / "contracts" / f"{keys[reference]}.json", value)
    infos = []
    for reference in references:
        name = reference.partition(":")[2]
        value = described.get(reference) or {"error": missing[reference]}
        if "error" in value:
            infos.append(StageInfo(name, reference, None, error=value["error"]))
            continue
        infos.append(
            StageInfo(
                name=value["name"],
                reference=reference,
                code=reader.fingerprint(reference.partition(":")[0], tuple(value["data"])),
                per_video=value["per"] == "video",
                version=value["version"],
                given=tuple(value["given"]),
                data=tuple(value["data"]),
                cpus=value["cpus"],
                gpus=value["gpus"],
                distributed=value["distributed"],
                inputs=tuple(value["inputs"]),
                takes=tuple(value["takes"]),
                doc=value["doc"],
                fields=tuple(value["fields"]),
                estimates=value["estimates"],
                sheet=value["sheet"],
            )
        )
    return infos


def _ask(folder: Path, references: list[str]) -> dict[str, Any]:
    """Describe stages in a child process that imports them."""
    with tempfile.TemporaryDirectory(prefix="banmo-describe-") as scratch:
        target = Path(scratch) / "contracts.json"
        command = [sys.executable, "-P", "-m", "pipeline.describe", str(target), *references]
        child = subprocess.run(
            command,
            env=child_environment(folder),
            cwd=scratch,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        found = read_json(target)
    if not isinstance(found, dict):
        raise StageError(f"the stages' contracts cannot be read: {child.stderr.strip()[-2000:] or child.returncode}")
    return found


def _check_order(infos: list[StageInfo]) -> None:
    """Inputs come from earlier stages; a video stage cannot read a scene stage's folder of another scope by video."""
    seen: dict[str, StageInfo] = {}
    names = {info.name for info in infos}
    for info in infos:
        if info.name in seen:
            raise StageError(f"two stages are named {info.name}")
        for name in info.inputs:
            if name not in seen:
                known = ", ".join(seen) or "none"
                place = "comes later" if name in names else "does not exist"
                raise StageError(f"stage {info.name} reads {name}, which {place} (earlier stages: {known})")
        seen[info.name] = info
