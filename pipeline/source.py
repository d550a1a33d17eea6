"""Fingerprint of the code a stage can reach.

Starting from the stage's module, imports are followed inside the package of the pipeline; every module is parsed,
bare strings (docstrings) are dropped, comments and layout vanish with parsing, and what is left is hashed module by
module. Modules are found by file path and nothing is imported. Parent packages run on import, so they belong to it;
the lists that name the pipeline (PIPELINE, GROUPS, PRESETS, VERBS, EXPORTS) do not count. Data files that a stage
declares count with their bytes. Blind spots: imports made at run time by name, compiled extensions, other packages.
"""

from __future__ import annotations

import ast
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput, StageError
from pipeline.files import read_json, sha256_file, signature, write_memo

_NAMING = {"PIPELINE", "GROUPS", "PRESETS", "VERBS", "EXPORTS"}
_MEMO_FORMAT = 3


@dataclass(frozen=True)
class Code:
    """Fingerprint of a closure, and of each file in it (path relative to the package's parent -> hash)."""

    digest: str
    modules: dict[str, str]


class CodeReader:
    """Reads modules once; remembers them between commands by (inode, size, mtime, ctime) in `memo` if given."""

    def __init__(self, package_dir: Path, memo: Path | None = None) -> None:
        self.package_dir = package_dir
        self.root = package_dir.parent
        self.package = package_dir.name
        self._memo_path = memo
        stored = read_json(memo) if memo else None
        self._memo: dict[str, Any] = {}
        if isinstance(stored, dict) and stored.get("format") == _MEMO_FORMAT:
            self._memo = stored.get("files", {})
        self._dirty = False
        self._seen: dict[Path, tuple[str, list[str]]] = {}

    def fingerprint(self, module: str, data: tuple[str, ...] = ()) -> Code:
        """Fingerprint of everything that `module` can import inside the package, and of its data files."""
        modules: dict[str, str] = {}
        waiting = [module]
        visited: set[str] = set()
        while waiting:
            name = waiting.pop()
            if name in visited:
                continue
            visited.add(name)
            path = self.find(name)
            if path is None:
                if name == module:
                    raise StageError(f"no module {name}", where=self.package_dir)
                continue
            digest, imports = self._read(path, name)
            modules[path.relative_to(self.root).as_posix()] = digest
            parent = name.rpartition(".")[0]
            waiting.extend([*imports, *([parent] if parent else [])])
        for pattern in data:
            for path in self._data_files(pattern):
                modules[path.relative_to(self.root).as_posix()] = self._hash_data(path)
        lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(modules.items()))
        return Code(hashlib.sha256(lines.encode()).hexdigest(), dict(sorted(modules.items())))

    def find(self, module: str) -> Path | None:
        """File of a module of the package, or None; found by path, without importing anything."""
        parts = module.split(".")
        if parts[0] != self.package:
            return None
        base = self.root.joinpath(*parts)
        for candidate in (base / "__init__.py", base.with_name(base.name + ".py")):
            if candidate.is_file():
                return candidate
        return None

    def save(self) -> None:
        """Keep the memo for the next command."""
        if self._memo_path is not None and self._dirty:
            write_memo(self._memo_path, {"format": _MEMO_FORMAT, "files": self._memo})
            self._dirty = False

    def _data_files(self, pattern: str) -> list[Path]:
        if pattern.startswith("/") or ".." in Path(pattern).parts:
            raise StageError(f"data {pattern!r} must lie inside the package", where=self.package_dir)
        found = sorted(p for p in self.package_dir.glob(pattern) if p.is_file())
        if not found and not any(c in pattern for c in "*?["):
            raise StageError(f"declared data file {pattern!r} is missing", where=self.package_dir)
        return found

    def _hash_data(self, path: Path) -> str:
        known = self._memo.get(str(path))
        now = signature(path.stat())
        if known and known[0] == now:
            return str(known[1])
        digest = sha256_file(path)
        self._memo[str(path)] = [now, digest, []]
        self._dirty = True
        return digest

    def _read(self, path: Path, module: str) -> tuple[str, list[str]]:
        if path in self._seen:
            return self._seen[path]
        now = signature(path.stat())
        known = self._memo.get(str(path))
        if known and known[0] == now:
            result = (str(known[1]), list(known[2]))
        else:
            try:
                tree = ast.parse(path.read_bytes(), filename=str(path))
            except (SyntaxError, ValueError) as error:
                raise BadInput(f"this file is not valid Python ({error})", where=path) from error
            is_package = path.name == "__init__.py"
            imports = _imports(tree, module if is_package else module.rpartition(".")[0], self.package)
            if is_package and module == self.package:
                tree.body = [s for s in tree.body if not _names_pipeline(s)]
            result = (hashlib.sha256(_dump(tree).encode("utf-8", "surrogatepass")).hexdigest(), imports)
            self._memo[str(path)] = [now, *result]
            self._dirty = True
        self._seen[path] = result
        return result


def _names_pipeline(statement: ast.stmt) -> bool:
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    if isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    return any(isinstance(t, ast.Name) and t.id in _NAMING for t in targets)


def _imports(tree: ast.Module, package: str, top: str) -> list[str]:
    """Dotted names a module may import inside `top`; names that turn out not to be modules are harmless."""
    found: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")
                parents = parents[: len(parents) - node.level + 1]
                base = ".".join([*parents, base] if base else parents)
            found.append(base)
            found += [f"{base}.{alias.name}" for alias in node.names]
    return sorted({name for name in found if name.split(".")[0] == top})


def _dump(node: Any) -> str:
    """Text of a syntax tree without positions, docstrings and empty fields (so that Python versions mostly agree)."""
    if isinstance(node, ast.AST):
        parts = []
        for name, value in ast.iter_fields(node):
            if name in ("type_comment", "kind") or value is None or value == []:
                continue
            if isinstance(value, list):
                value = [v for v in value if not _is_bare_string(v)]
            parts.append(f"{name}={_dump(value)}")
        return f"{type(node).__name__}({','.join(parts)})"
    if isinstance(node, list):
        return "[" + ",".join(_dump(v) for v in node) + "]"
    return f"{type(node).__name__}:{node!r}"


def _is_bare_string(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
