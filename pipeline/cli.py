"""The command line: one short function a verb."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pipeline.errors import BadInput, PipelineError
from pipeline.project import Options


def split_overrides(argv: list[str]) -> tuple[list[str], list[tuple[str, str]]]:
    """Take ``--section.key value`` and ``--set section.key=value`` out of the words."""
    rest: list[str] = []
    found: list[tuple[str, str]] = []
    words = iter(range(len(argv)))
    for i in words:
        word = argv[i]
        if word == "--":
            rest += argv[i:]
            break
        name, equals, value = word.removeprefix("--").partition("=")
        if word == "--set" or (word.startswith("--set=")):
            text = value if equals else argv[i + 1] if i + 1 < len(argv) else ""
            if not equals:
                next(words, None)
            name, equals, value = text.partition("=")
            if not equals or "." not in name:
                raise BadInput(f"--set {text!r} is not section.key=value", hint="--set masks.threshold=0.4")
            found.append((name.replace("-", "_"), value))
        elif word.startswith("--") and "." in name and not name.startswith((".", "/")):
            if not equals:
                following = argv[i + 1] if i + 1 < len(argv) else "--"
                if following.startswith("--"):
                    value = "true"
                else:
                    value = following
                    next(words, None)
            found.append((name.replace("-", "_"), value))
        else:
            rest.append(word)
    return rest, found


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        rest, overrides = split_overrides(words)
        parser = argparse.ArgumentParser(prog="banmo")
        verbs = parser.add_subparsers(dest="verb", required=True)
        run = verbs.add_parser("run")
        run.add_argument("videos", nargs="?", type=Path)
        run.add_argument("--workspace", type=Path, default=Path("workspace"))
        run.add_argument("--definition", default="")
        run.add_argument("--preset")
        run.add_argument("--stage", action="append", default=[])
        run.add_argument("--until")
        run.add_argument("--redo", action="append", default=[])
        run.add_argument("--video", action="append", default=[])
        run.add_argument("--skip-video", action="append", default=[])
        run.add_argument("-n", "--dry-run", action="store_true")
        run.add_argument("--check", action="store_true")
        run.add_argument("--fail-fast", action="store_true")
        args = parser.parse_args(rest)
        options = Options(
            args.workspace, args.definition, args.preset, overrides, args.videos, tuple(args.skip_video)
        )
        from pipeline.run_command import RunOptions, run as run_command
        from pipeline.graph import Selection

        selection = Selection(tuple(args.stage), args.until, tuple(args.redo), tuple(args.video))
        return run_command(options, selection, RunOptions(args.dry_run, args.check, args.fail_fast))
    except PipelineError as error:
        sys.stderr.write(f"banmo: {error}\n")
        return int(error.exit_code)


if __name__ == "__main__":
    sys.exit(main())
