"""Read the contracts of stages by importing them, in a process of its own (``python -m pipeline.describe``).

The planning process never imports a stage, because that imports torch. It reads what this module wrote.
A stage that cannot be imported is described by its error, so that the others can still run.
"""

from __future__ import annotations

import ast
import dataclasses
import enum
import importlib
import inspect
import json
import sys
import textwrap
import traceback
import types
import typing
from pathlib import Path
from typing import Any

from pipeline.contract import Folder, Given, InputFile, Scene, Source, Stage
from pipeline.running import Run


def load_stage(reference: str) -> Stage:
    """The stage named by ``module:function``."""
    module_name, _, name = reference.partition(":")
    found = getattr(importlib.import_module(module_name), name, None)
    if not isinstance(found, Stage):
        raise TypeError(f"{reference} is not a stage: decorate it with @stage(...)")
    return found


def settings_class(found: Stage) -> type | None:
    """The dataclass of the stage's ``settings`` parameter, or None."""
    if "settings" not in found.parameters:
        return None
    kind = typing.get_type_hints(found.function).get("settings")
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise TypeError(f"stage {found.name}: its parameter `settings` needs the type of a dataclass")
    if not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise TypeError(f"stage {found.name}: {kind.__name__} must be frozen")
    return kind


def describe(reference: str) -> dict[str, Any]:
    """Everything the planner needs to know of a stage, as JSON."""
    found = load_stage(reference)
    kind = settings_class(found)
    return {
        "name": found.name,
        "reference": reference,
        "per": "scene" if found.per is Scene else "video",
        "version": found.version,
        "given": list(found.given),
        "data": list(found.data),
        "cpus": found.needs.cores,
        "gpus": found.needs.gpus,
        "distributed": found.needs.distributed,
        "inputs": list(found.inputs),
        "takes": [p for p in ("video", "given", "settings") if p in found.parameters],
        "doc": inspect.getdoc(found.function) or "",
        "fields": fields_of(kind) if kind else [],
        "estimates": found.estimator is not None,
        "sheet": found.sheet_writer is not None,
    }


def fields_of(kind: type, prefix: str = "") -> list[dict[str, Any]]:
    """The settings of a dataclass, nested ones with dotted names: name, type, default, help."""
    hints = typing.get_type_hints(kind)
    docs = _field_docs(kind)
    found: list[dict[str, Any]] = []
    for item in dataclasses.fields(kind):
        if item.default is not dataclasses.MISSING:
            default = item.default
        elif item.default_factory is not dataclasses.MISSING:
            default = item.default_factory()
        else:
            raise TypeError(f"{kind.__name__}.{item.name}: every setting needs a default")
        hint = hints[item.name]
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            nested = fields_of(hint, f"{prefix}{item.name}.")
            found += [{**f, "default": _plain(_reach(default, f["name"], f"{prefix}{item.name}."))} for f in nested]
            continue
        found.append(
            {
                "name": prefix + item.name,
                "type": type_of(hint, f"{kind.__name__}.{item.name}"),
                "default": _plain(default),
                "help": docs.get(item.name, ""),
            }
        )
    return found


def type_of(hint: Any, where: str) -> dict[str, Any]:
    """A type as JSON: kind int, float, str, bool, file, choice, optional, list or tuple."""
    simple: dict[Any, str] = {bool: "bool", int: "int", float: "float", str: "str", InputFile: "file"}
    if hint in simple:
        return {"kind": simple[hint]}
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return {"kind": "choice", "choices": list(arguments)}
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return {"kind": "choice", "choices": [m.name for m in hint]}
    if origin in (typing.Union, types.UnionType):
        others = [a for a in arguments if a is not type(None)]
        if len(others) == 1 and len(others) < len(arguments):
            return {"kind": "optional", "item": type_of(others[0], where)}
    if origin is list:
        return {"kind": "list", "item": type_of(arguments[0], where)}
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return {"kind": "list", "item": type_of(arguments[0], where)}
        return {"kind": "tuple", "items": [type_of(a, where) for a in arguments]}
    raise TypeError(f"{where}: settings cannot have the type {hint}")


def build(kind: type, values: dict[str, Any]) -> Any:
    """A settings object from flat values (dotted names for nested dataclasses)."""
    hints = typing.get_type_hints(kind)
    arguments = {}
    for item in dataclasses.fields(kind):
        hint = hints[item.name]
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            start = item.name + "."
            arguments[item.name] = build(hint, {k[len(start) :]: v for k, v in values.items() if k.startswith(start)})
        elif item.name in values:
            arguments[item.name] = _typed(hint, values[item.name])
    return kind(**arguments)


def _typed(hint: Any, value: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is InputFile:
        return InputFile(value)
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return hint[value]
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _typed(next(a for a in arguments if a is not type(None)), value)
    if origin is tuple:
        variadic = len(arguments) == 2 and arguments[1] is Ellipsis
        return tuple(_typed(arguments[0] if variadic else arguments[i], v) for i, v in enumerate(value))
    if origin is list:
        return [_typed(arguments[0], v) for v in value]
    return float(value) if hint is float else value


def _reach(value: Any, name: str, prefix: str) -> Any:
    for part in name.removeprefix(prefix).split("."):
        value = getattr(value, part)
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, InputFile) else value


def _field_docs(kind: type) -> dict[str, str]:
    """The string under each field of a dataclass and of its bases."""
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        except (OSError, TypeError, SyntaxError, IndexError):
            continue
        assert isinstance(body, ast.ClassDef)
        for before, after in zip(body.body, body.body[1:], strict=False):
            if (
                isinstance(before, ast.AnnAssign)
                and isinstance(before.target, ast.Name)
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
                and isinstance(after.value.value, str)
            ):
                docs[before.target.id] = inspect.cleandoc(after.value.value)
    return docs


def bind(found: Stage, function: Any, known: dict[str, Any]) -> dict[str, Any]:
    """The arguments `function` asks for by name."""
    return {name: known[name] for name in inspect.signature(function).parameters if name in known}


def check_types(found: Stage) -> None:
    """Refuse parameters whose annotations contradict what they will receive."""
    hints = typing.get_type_hints(found.function)
    scene = found.per is Scene
    expected = {
        "video": dict[str, Source] if scene else Source,
        "given": dict[str, Given] if scene else Given,
        "out": Path,
        "run": Run,
    }
    for name in found.parameters:
        hint = hints.get(name)
        if name in expected and hint is not None and hint != expected[name]:
            raise TypeError(f"stage {found.name}: parameter {name} receives {expected[name]}, is annotated {hint}")
        if name in found.inputs and hint not in (None, Folder, dict[str, Folder]):
            raise TypeError(f"stage {found.name}: input {name} is a Folder or dict[str, Folder], is annotated {hint}")


def main(argv: list[str]) -> int:
    """Describe the stages named after the output file, one JSON object keyed by reference."""
    target, *references = argv
    found: dict[str, Any] = {}
    for reference in references:
        try:
            found[reference] = describe(reference)
            check_types(load_stage(reference))
        except Exception as error:
            last = traceback.format_exception_only(type(error), error)[-1].strip()
            found[reference] = {"reference": reference, "error": last, "trace": traceback.format_exc()}
    Path(target).write_text(json.dumps(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
