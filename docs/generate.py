"""Write the settings template and the settings page from the code.

``python docs/generate.py`` writes ``workspace_template/pipeline.toml`` and ``docs/settings.md``; ``--check`` only says
whether they are in step (exit 1 if not). A test runs the check.
"""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from pipeline import definition, settings

HEAD = """\
# Settings of this workspace. Every line that is commented out shows a default; take away the "#" and change it.
# Precedence: defaults < preset < this file < command line (`banmo run --masks.threshold 0.6`).
# Unknown keys are refused. Paths are relative to this file. Changing a setting reruns its stage and what follows.
"""
OWN_HELP = {
    "pipeline": "What to reconstruct.",
    "execution": "How to run. Nothing here changes a result.",
    "store": "Where else results may be. Nothing here changes a result.",
}
UNITS = {"px": "pixels", "deg": "degrees", "s": "seconds", "minutes": "minutes", "fps": "frames a second"}


def tables() -> list[tuple[str, str, tuple[dict[str, Any], ...]]]:
    """Every section: name, what it is for, its fields, in data order."""
    known = definition.load("stages")
    broken = [f"{name}: {info.error}" for name, info in known.stages.items() if info.error]
    if broken:
        raise SystemExit("cannot read the settings of " + "; ".join(broken))
    found = []
    for name, fields in settings.sections(known).items():
        about = OWN_HELP.get(name) or known.stages[name].doc
        found.append((name, about, tuple(fields)))
    return found


def unit(name: str) -> str:
    """The unit a setting's name carries, in words; empty if none."""
    last = name.rsplit("_", 1)[-1]
    return UNITS.get(last, "")


def kind(spec: dict[str, Any]) -> str:
    """A setting's type in words."""
    return settings.expected(spec["type"])


def template() -> str:
    """``workspace_template/pipeline.toml``."""
    parts = [HEAD]
    for section, about, fields in tables():
        lines = [*_comment(about.split("\n\n")[0]), f"[{section}]"]
        for spec in fields:
            what = spec["help"].rstrip(".") or spec["name"]
            measure = ", ".join(word for word in (kind(spec), unit(spec["name"])) if word)
            lines += _comment(f"{what}. ({measure})")
            if spec["default"] is None:
                lines.append(f'# {spec["name"]} = ""   # none')
            else:
                lines.append(f"# {spec['name']} = {settings.toml_value(spec['default'])}")
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def page() -> str:
    """``docs/settings.md``."""
    out = [
        "# Settings",
        "",
        "Written from the code by `make docs`. In `pipeline.toml` a section is a table; on the command line a setting",
        "is `--section.key value`. Precedence: defaults, preset, `pipeline.toml`, command line.",
    ]
    for section, about, fields in tables():
        out += ["", f"## {section}", "", " ".join(about.split("\n\n")[0].split())]
        if fields:
            out += ["", "| setting | default | what it is |", "| --- | --- | --- |"]
        for spec in fields:
            default = "none" if spec["default"] is None else settings.toml_value(spec["default"])
            what = " ".join(spec["help"].split()).replace("|", "\\|")
            out.append(f"| `{spec['name']}` | `{default}` | {what} *{kind(spec).replace('|', ' or ')}* |")
    return "\n".join(out) + "\n"


def _comment(text: str) -> list[str]:
    return ["# " + line for line in textwrap.wrap(" ".join(text.split()), 116)]


def main(arguments: list[str]) -> int:
    """Write both files, or compare them with ``--check``."""
    wanted = {ROOT / "workspace_template" / "pipeline.toml": template(), ROOT / "docs" / "settings.md": page()}
    stale = [path for path, text in wanted.items() if not path.is_file() or path.read_text(encoding="utf-8") != text]
    if "--check" in arguments:
        for path in stale:
            sys.stderr.write(f"{path.relative_to(ROOT)} is out of step with the code: make docs\n")
        return 1 if stale else 0
    for path in stale:
        path.write_text(wanted[path], encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
