"""Settings: defaults < preset < pipeline.toml < command line. Unknown keys are refused with a suggestion.

The tables of pipeline.toml are ``[pipeline]`` and ``[execution]`` (the engine's own, below) and one a stage, whose keys
are the fields of that stage's settings class. On the command line: ``--stage.key value``.
"""

from __future__ import annotations

import functools
import importlib
import os
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pipeline.definition import Definition, StageInfo, read_toml
from pipeline.describe import fields_of
from pipeline.errors import BadInput, did_you_mean


@dataclass(frozen=True)
class PipelineSection:
    """``[pipeline]``: what to reconstruct."""

    preset: str = ""
    """Settings by purpose; "" takes the first preset of the pipeline."""
    videos: str = ""
    """Folder of the videos; "" takes the one given on the command line, now or last time."""
    skip_videos: tuple[str, ...] = ()
    """Videos to leave out."""
    salt: str = ""
    """Any text; changing it distrusts every earlier result and makes all stages run again."""
    guard_minutes: float = 20.0
    """When only code changed and the old result took longer than this, ask before redoing it."""


@dataclass(frozen=True)
class ExecutionSection:
    """``[execution]``: how to run. Never part of a key."""

    cpus: int = 0
    """Cores to use; 0 takes all."""
    gpus: int = -1
    """GPUs to use; -1 takes all."""
    grace_s: float = 60.0
    """Seconds a worker has to save its work when asked to stop, before it is killed."""
    keep_runs: int = 5
    """Runs whose results `gc` keeps."""
    executor: Literal["local", "slurm"] = "local"
    """Where to run: this machine, or a Slurm cluster (needs the extra `slurm`)."""
    ranks: int = 1
    """Processes that share the work of a stage which trains in parallel."""
    nodes: int = 1
    """Slurm: nodes over which these ranks are spread."""
    slurm_partition: str = ""
    """Slurm: partition; "" leaves it to the cluster."""
    slurm_account: str = ""
    """Slurm: account to charge."""
    slurm_qos: str = ""
    """Slurm: quality of service."""
    slurm_time_limit_min: int = 720
    """Slurm: time limit of a job; what it could not finish is requeued and goes on from its checkpoint."""
    slurm_memory_gb: float = 0.0
    """Slurm: memory of a job on each node; 0 leaves it to the cluster."""
    slurm_parallel: int = 64
    """Slurm: jobs of one array that run at the same time."""


@dataclass(frozen=True)
class StoreSection:
    """``[store]``: where else results may be. Never part of a key."""

    shared: str = ""
    """A store to read through to: a folder or URL that `banmo push` has filled; what is found there is copied here."""
    locks: Literal["auto", "kernel", "expiring"] = "auto"
    """Locks of the workspace: the kernel's, or leases that expire, for network disks; auto looks at the file system."""
    expire_s: float = 60.0
    """Time without a sign of life after which an expiring lease may be taken over."""
    latency_s: float = 30.0
    """How long a network disk or a shared store may hide files that are written already; waited once in a command."""


_OWN: dict[str, type] = {"pipeline": PipelineSection, "execution": ExecutionSection, "store": StoreSection}


@dataclass(frozen=True)
class Settings:
    """The merged settings: section -> key -> value, and where each came from when it is no default."""

    values: dict[str, dict[str, Any]]
    origins: dict[str, str] = field(default_factory=dict)
    preset: str = ""

    @property
    def pipeline(self) -> PipelineSection:
        """The ``[pipeline]`` table."""
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in self.values["pipeline"].items()}
        return PipelineSection(**values)

    @property
    def execution(self) -> ExecutionSection:
        """The ``[execution]`` table."""
        return ExecutionSection(**self.values["execution"])

    @property
    def store(self) -> StoreSection:
        """The ``[store]`` table."""
        return StoreSection(**self.values["store"])


@functools.cache
def _own_fields() -> dict[str, tuple[dict[str, Any], ...]]:
    """The fields of the engine's own sections; their help is read from the source, once."""
    return {name: tuple(fields_of(kind)) for name, kind in _OWN.items()}


def check_execution(found: ExecutionSection) -> None:
    """Raise BadInput for counts that cannot be."""
    for name, least in (("ranks", 1), ("nodes", 1), ("slurm_time_limit_min", 1), ("slurm_parallel", 1), ("cpus", 0)):
        if getattr(found, name) < least:
            raise BadInput(f"[execution] {name} = {getattr(found, name)} is less than {least}")


def sections(definition: Definition) -> dict[str, tuple[dict[str, Any], ...]]:
    """Every section and its fields. Stages that cannot be imported have no entry."""
    found = dict(_own_fields())
    for name, info in definition.stages.items():
        if not info.error:
            found[name] = info.fields
    return found


def resolve(
    definition: Definition,
    config: Path | None,
    overrides: list[tuple[str, str]],
    preset: str | None = None,
) -> Settings:
    """Merge the four layers. `overrides` are ("stage.key", text) pairs of the command line."""
    known = sections(definition)
    values = {name: {f["name"]: f["default"] for f in fields} for name, fields in known.items()}
    origins: dict[str, str] = {}
    broken = {name for name, info in definition.stages.items() if info.error}
    written = read_toml(config) if config is not None and config.is_file() else {}
    asked = preset if preset is not None else _preset_of(written, overrides, config)
    chosen = asked or next(iter(definition.presets), "")
    if asked and asked not in definition.presets:
        raise BadInput(f"there is no preset {asked!r}", hint=did_you_mean(asked, definition.presets))
    layers: list[tuple[dict[str, Any], Path | None, str]] = []
    if chosen:
        layers.append((definition.presets[chosen], definition.presets_path, f"preset {chosen}"))
    if written and config is not None:
        layers.append((written, config, config.name))
    for table, path, origin in layers:
        _check_sections(table, known, broken, path)
        for section, entries in table.items():
            if section in broken:
                continue
            flat = _flatten(entries, section, known[section], path)
            for key, value in flat.items():
                spec = _field(known, section, key, path)
                where = f"{path}: [{section}] {key}"
                values[section][key] = coerce(spec["type"], value, where, path.parent if path else Path.cwd())
                origins[f"{section}.{key}"] = origin
    for name, text in overrides:
        section, _, key = name.partition(".")
        if section in broken:
            raise BadInput(f"--{name}: stage {section} cannot be loaded", hint=definition.stages[section].error)
        if section not in known:
            raise BadInput(f"there is no section {section!r} for --{name}", hint=did_you_mean(section, known))
        spec = _field(known, section, key, None)
        values[section][key] = coerce(spec["type"], _from_text(spec["type"], text), f"--{name}", Path.cwd())
        origins[f"{section}.{key}"] = "command line"
    values["pipeline"]["preset"] = chosen
    _name_files(definition, known, values)
    return Settings(values, origins, chosen)


def _name_files(definition: Definition, known: dict[str, Any], values: dict[str, dict[str, Any]]) -> None:
    """Replace files that are not there by what the pipeline knows under their names, if it knows any."""
    module, _, function = definition.named_files.partition(":")
    for section, fields in known.items() if module else ():
        for spec in fields:
            value = values[section][spec["name"]]
            if spec["type"]["kind"] == "file" and value and not os.path.exists(value):
                found = getattr(importlib.import_module(module), function)(os.path.basename(value))
                values[section][spec["name"]] = found or value


def _preset_of(written: dict[str, Any], overrides: list[tuple[str, str]], config: Path | None) -> str:
    for name, text in reversed(overrides):
        if name == "pipeline.preset":
            return text
    table = written.get("pipeline", {})
    found = table.get("preset", "") if isinstance(table, dict) else ""
    if not isinstance(found, str):
        raise BadInput("[pipeline] preset is a text", where=config or "")
    return found


def _check_sections(table: dict[str, Any], known: dict[str, Any], broken: set[str], path: Path | None) -> None:
    for section, entries in table.items():
        if section not in known and section not in broken:
            hint = did_you_mean(section, [*known, *broken])
            if not isinstance(entries, dict):
                owners = [s for s, fields in known.items() if any(f["name"] == section for f in fields)]
                hint = f"it belongs under [{owners[0]}]" if owners else hint
            raise BadInput(f"unknown section or key {section!r}", where=path or "", hint=hint)
        if not isinstance(entries, dict):
            raise BadInput(f"[{section}] is a table, not {entries!r}", where=path or "")


def _flatten(entries: dict[str, Any], section: str, fields: Any, path: Path | None, prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    nested = {f["name"].rpartition(".")[0] for f in fields}
    for key, value in entries.items():
        name = prefix + key
        if isinstance(value, dict) and any(n == name or n.startswith(name + ".") for n in nested):
            flat.update(_flatten(value, section, fields, path, name + "."))
        else:
            flat[name] = value
    return flat


def _field(known: dict[str, Any], section: str, key: str, path: Path | None) -> dict[str, Any]:
    for spec in known[section]:
        if spec["name"] == key:
            found: dict[str, Any] = spec
            return found
    what = f"unknown setting {key!r} in [{section}]" if path else f"unknown setting --{section}.{key}"
    names = [spec["name"] for spec in known[section]]
    hint = did_you_mean(key, names)
    elsewhere = [s for s, fields in known.items() if any(f["name"] == key for f in fields)]
    if "did you mean" not in hint and elsewhere:
        hint = f"[{elsewhere[0]}] has it"
    raise BadInput(what, where=path or "", hint=hint or f"[{section}] has no settings")


def coerce(kind: dict[str, Any], value: Any, where: str, base: Path) -> Any:
    """`value` as the type wants it, or BadInput saying what is expected."""
    name = kind["kind"]
    if name == "optional":
        return None if value is None or value == "none" else coerce(kind["item"], value, where, base)
    if name == "bool" and isinstance(value, bool):
        return value
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if name == "int" and whole and not isinstance(value, bool):
        return int(value)
    if name == "float" and isinstance(value, int | float) and not isinstance(value, bool):
        number = float(value)
        if number == number and abs(number) != float("inf"):
            return number
    if name == "str" and isinstance(value, str):
        return value
    if name == "file" and isinstance(value, str):
        return os.path.abspath(base / Path(value).expanduser()) if value else ""
    if name == "choice" and value in kind["choices"] and not isinstance(value, bool):
        return value
    if name == "list" and isinstance(value, list):
        return [coerce(kind["item"], v, where, base) for v in value]
    if name == "tuple" and isinstance(value, list) and len(value) == len(kind["items"]):
        return [coerce(k, v, where, base) for k, v in zip(kind["items"], value, strict=True)]
    hint = did_you_mean(str(value), [str(c) for c in kind["choices"]]) if name == "choice" else ""
    raise BadInput(f"{where} = {value!r} is not {expected(kind)}", hint=hint)


def expected(kind: dict[str, Any]) -> str:
    """A type in words."""
    name = kind["kind"]
    if name == "choice":
        return "one of " + ", ".join(str(c) for c in kind["choices"])
    if name == "optional":
        return expected(kind["item"]) + " or none"
    if name == "list":
        return f"a list, each {expected(kind['item'])}"
    if name == "tuple":
        return f"a list of {len(kind['items'])}: " + ", ".join(expected(k) for k in kind["items"])
    words = {"int": "a whole number", "float": "a finite number", "bool": "true or false", "str": "a text"}
    return words.get(name, "the path of a file")


def _from_text(kind: dict[str, Any], text: str) -> Any:
    """A command-line word as a TOML value."""
    name = kind["kind"]
    if name == "optional":
        return None if text in ("none", "None", "") else _from_text(kind["item"], text)
    if name in ("str", "file"):
        return text
    if name == "choice" and text in kind["choices"]:
        return text
    if name == "bool":
        return {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}.get(text.lower(), text)
    if name in ("list", "tuple") and not text.lstrip().startswith("["):
        items = [t.strip() for t in text.split(",") if t.strip()]
        kinds = [kind["item"]] * len(items) if name == "list" else kind["items"]
        return [_from_text(k, t) for k, t in zip(kinds, items, strict=False)] if len(kinds) >= len(items) else items
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return text


def stage_values(settings: Settings, info: StageInfo) -> dict[str, Any]:
    """The settings of one stage, flat."""
    return settings.values.get(info.name, {})


def to_toml(settings: Settings) -> str:
    """The merged settings as a file that can serve as pipeline.toml."""
    lines: list[str] = []
    for section, entries in settings.values.items():
        lines.append(f"[{section}]")
        lines += [f"{key} = {toml_value(value)}" for key, value in entries.items() if value is not None]
        lines.append("")
    return "\n".join(lines)


def toml_value(value: Any) -> str:
    """One value in TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + "".join(_toml_character(c) for c in value) + '"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    return repr(value)


def _toml_character(character: str) -> str:
    if character.isprintable() and character not in '"\\':
        return character
    if 0xD800 <= ord(character) < 0xE000:  # a byte of a path that is not UTF-8; TOML cannot say it
        return "\ufffd"
    return f"\\U{ord(character):08x}"
