"""Real copies of what a user holds in ``exports/``, swapped in whole; the user's own files there are kept.

They are the files of the last stage, or of all stages that the pipeline names in ``EXPORTS``. In an HTML file among
them an empty JSON element with the id ``provenance`` is filled with what no result may hold: times and reasons.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
import tomllib
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput
from pipeline.files import read_json, replacing, write_json
from pipeline.ledger import Record
from pipeline.objects import walk
from pipeline.plan import Planner
from pipeline.project import Project
from pipeline.results import Results

PROVENANCE = "provenance.json"
_SLOT = '<script type="application/json" id="provenance">null</script>'


def export(project: Project, planner: Planner, to: Path | None = None) -> Path | None:
    """Copy the exported stages' folders to ``exports/`` unless they are there; None when one has no result."""
    nodes = [node for stage in project.definition.exported for node in project.graph.of_stage(stage)]
    records = {n.label: planner.results[n.label] for n in nodes if n.label in planner.results}
    if len(records) < len(nodes):
        return None
    target = (to or project.workspace.exports).resolve()  # a link to another disk stays a link
    if _is_there(target, records):
        return target
    with project.workspace.exclusive():
        _export(project, planner, records, target)
    return target


def _export(project: Project, planner: Planner, records: dict[str, Record], target: Path) -> None:
    if _is_there(target, records):
        return
    with replacing(target) as fresh:
        wanted, before = _wanted(records), _before(target)
        for record in records.values():
            if not project.workspace.objects.sound(record.stage, record.digest):
                raise BadInput(f"the result of {record.label} is damaged", hint="run again")
            place = fresh / record.video if record.video else fresh
            _copy(project.workspace.objects.path(record.stage, record.digest), place)
        provenance = _provenance(project, wanted, planner.results)
        _explain(fresh, provenance, project)
        files = {name: [s.st_size, s.st_mtime_ns] for name, _, s in walk(fresh)}
        write_json(fresh / PROVENANCE, {**provenance, "files": files})
        _keep_foreign(target, fresh, before["files"])


def _wanted(records: dict[str, Record]) -> dict[str, str]:
    return {label: record.digest for label, record in records.items()}


def _explain(fresh: Path, provenance: dict[str, Any], project: Project) -> None:
    """Fill the empty element of HTML files: what ran, how long, when and why; escaped so that it stays data."""
    pages = [p for p in sorted(fresh.glob("*.html")) if _SLOT in p.read_text(encoding="utf-8", errors="replace")]
    if not pages:
        return
    ran = [
        {"stage": r.stage, "video": r.video, "seconds": round(r.seconds, 3), "when": r.when, "reason": r.reason}
        for r in Results(project.workspace.root).records()
    ]
    text = json.dumps({**provenance, "ran": ran}, ensure_ascii=False, default=str)
    for old, new in (("&", "\\u0026"), ("<", "\\u003c"), (">", "\\u003e")):
        text = text.replace(old, new)
    for path in pages:
        page = path.read_text(encoding="utf-8")
        path.write_text(page.replace(_SLOT, _SLOT.replace("null", "%s") % text), encoding="utf-8")


def _before(target: Path) -> dict[str, Any]:
    """What an earlier export says of itself."""
    value = read_json(target / PROVENANCE)
    return value if isinstance(value, dict) and isinstance(value.get("files"), dict) else {"files": {}}


def _is_there(target: Path, records: dict[str, Record]) -> bool:
    before = _before(target)
    return before.get("digests") == _wanted(records) and _complete(target, before["files"])


def _copy(source: Path, target: Path) -> None:
    for name, path, _ in walk(source):
        place = target / name
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)


def _complete(target: Path, files: dict[str, Any]) -> bool:
    try:
        return all((target / name).stat().st_size == facts[0] for name, facts in files.items())
    except (OSError, TypeError, IndexError):
        return False


def _keep_foreign(target: Path, fresh: Path, ours: dict[str, Any]) -> None:
    """Carry over files that we did not put there, or that were edited since, into the fresh folder."""
    if not target.is_dir() or target.is_symlink():
        return
    stamp = time.strftime("%Y-%m-%dT%H-%M-%S")
    for name, path, status in walk(target):
        if name == PROVENANCE or ours.get(name) == [status.st_size, status.st_mtime_ns]:
            continue
        edited = name in ours or (fresh / name).exists()
        place = fresh / f"kept-{stamp}" / name if edited else fresh / name
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, place, follow_symlinks=False)


def _provenance(project: Project, wanted: dict[str, str], results: dict[str, Record]) -> dict[str, Any]:
    said = {label: words for label, record in results.items() if (words := _texts(record.metrics))}
    return {
        "digests": wanted,
        "videos": {v.name: {"file": v.display, "sha256": project.sources.of(v.path)} for v in project.videos},
        "preset": project.settings.preset,
        "actions": {label: record.key for label, record in results.items()},
        "settings": {s: v for s, v in project.settings.values.items() if s in project.definition.stages},
        "files_of_settings": _files_of_settings(project),
        "said": said,
        "networks": _brought_along(project.definition.package_dir, said),
        "software": {name: version for record in results.values() for name, version in record.versions.items()},
    }


def _texts(metrics: dict[str, Any]) -> dict[str, str]:
    """What a stage recorded in words: which method or network it took, for one."""
    return {name: value for name, value in metrics.items() if isinstance(value, str)}


def _brought_along(package_dir: Path, said: dict[str, dict[str, str]]) -> dict[str, dict[str, Any]]:
    """Files that come with the pipeline and were used: licence, source and digest of each, and by which actions.

    ``weights/about.toml`` beside the pipeline has a table a file; ``known_by`` in it lists what a stage says when it
    used the file, as ``text`` or ``name=text``.
    """
    about = next((f for d in (package_dir, package_dir.parent) if (f := d / "weights" / "about.toml").is_file()), None)
    if about is None:
        return {}
    found: dict[str, dict[str, Any]] = {}
    for name, table in tomllib.loads(about.read_text(encoding="utf-8")).items():
        known = set(table.pop("known_by", ()))
        users = sorted(a for a, words in said.items() if any({v, f"{k}={v}"} & known for k, v in words.items()))
        if users:
            digest = hashlib.sha256((about.parent / name).read_bytes()).hexdigest()
            found[name] = {**table, "sha256": digest, "used_by": users}
    return found


def _files_of_settings(project: Project) -> dict[str, dict[str, Any]]:
    """Of each setting that names a file or a folder: where it is, and the table ``[about]`` of a TOML file in it.

    Such a table says where a file comes from and under what licence.
    """
    found: dict[str, dict[str, Any]] = {}
    for stage, values in project.settings.values.items():
        for name, value in values.items() if stage in project.definition.stages else ():
            path = Path(str(value)) if isinstance(value, str | Path) and str(value) else None
            if path is None or not path.is_absolute() or not path.exists():
                continue
            beside = sorted(path.glob("*.toml")) if path.is_dir() else [path.with_suffix(".toml")]
            about = next((t for t in map(_about, beside) if t), {})
            found[f"{stage}.{name}"] = {"path": str(path), "about": about}
    return found


def _about(path: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8")).get("about", {})
    except (OSError, ValueError, RecursionError):
        return {}
    return {k: v for k, v in table.items() if isinstance(v, str | int | float)} if isinstance(table, dict) else {}
