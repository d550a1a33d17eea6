"""The command line: the verbs, their flags, their help. Each verb is a short function in ``pipeline.commands``."""

from __future__ import annotations

import argparse
import errno
import importlib
import io
import os
import re
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from pipeline.errors import FULL, BadInput, ExitCode, PipelineError, did_you_mean, disk_full
from pipeline.project import Options
from pipeline.verbs import Verb, add_arguments, run_verb, takes_settings, verbs_of

_EXIT_CODES = """exit codes: 0 done · 1 an action failed · 2 usage, settings or input at fault · 3 a decision is needed
            4 damage found · 10 work pending (--check) · 75 stopped, resumable · 130 stopped by Ctrl-C"""

# What the user can mend: no space, no permission, a read-only disk. Any other OSError is a fault of the program.
_USERS_ERRNOS = (*FULL, errno.EACCES, errno.EPERM, errno.EROFS)

_SETTINGS_HELP = "any setting of a stage: --STAGE.KEY VALUE (see `banmo settings`)"

# verb -> (module, help, examples)
_VERBS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "init": ("keep", "make a workspace from the template", ("banmo init workspace",)),
    "run": (
        "run",
        "make everything that is not up to date",
        (
            "banmo run clips/",
            "banmo run clips/ --preset standard --fit.minutes 30",
            "banmo run -n                       what would run, and why",
            "banmo run --until masks            only as far as the masks",
            "banmo run --redo fit               again, although it is up to date",
            "banmo run --skip-video cat-03      without one clip",
            "banmo run --executor slurm         on a cluster",
        ),
    ),
    "status": ("show", "a table of stages and videos", ("banmo status", "banmo status --json")),
    "why": ("show", "why a stage has to run", ("banmo why fit", "banmo why masks cat-03")),
    "inspect": (
        "look",
        "what a result holds, how it came about, where it lies",
        ("banmo inspect masks cat-03", "banmo inspect export"),
    ),
    "log": ("look", "the log of an action", ("banmo log fit", "banmo log -f masks cat-03")),
    "graph": ("show", "the graph, as Mermaid or DOT", ("banmo graph", "banmo graph --dot | dot -Tsvg > graph.svg")),
    "settings": (
        "show",
        "every setting: value, origin, meaning",
        ("banmo settings", "banmo settings masks", "banmo settings --toml > pipeline.toml"),
    ),
    "verify": (
        "keep",
        "check the store",
        ("banmo verify", "banmo verify --deep", "banmo verify --deep --repair"),
    ),
    "gc": ("keep", "what can go; --apply deletes it", ("banmo gc", "banmo gc --apply")),
    "pin": (
        "keep",
        "protect a run from gc",
        ("banmo pin                          the runs and the pins", "banmo pin 2026-09-28T10-15-00-k3fa paper"),
    ),
    "bless": ("keep", "accept a result although the code changed", ("banmo bless fit",)),
    "compare": (
        "share",
        "what differs between two runs: settings, results, times, figures",
        ("banmo compare 2026-09-28T10-15-00-k3fa latest", "banmo compare paper latest --json       pins have names"),
    ),
    "push": (
        "share",
        "copy the newest run's results to another store",
        ("banmo push /mnt/lab/cats", "banmo push s3://bucket/cats --all", "banmo push ssh://host/data/cats -n"),
    ),
    "pull": (
        "share",
        "copy results from another store, verified on arrival",
        ("banmo pull /mnt/lab/cats", "banmo pull s3://bucket/cats --workspace cats"),
    ),
    "export": ("keep", "copy the last stage's files out", ("banmo export", "banmo export --to ~/cat-model")),
    "doctor": ("keep", "look at this machine and workspace", ("banmo doctor",)),
}


_SHARE = ("compare", "push", "pull")


class _Parser(argparse.ArgumentParser):
    """argparse whose complaints suggest the right word and become BadInput."""

    def error(self, message: str) -> NoReturn:
        """Raise instead of exiting."""
        choice = re.search(r"invalid choice: '([^']*)'", message)
        if choice is not None:
            known = re.findall(r"'([^']+)'", message.partition("(choose from")[2]) or list(_VERBS)
            raise BadInput(f"there is no command {choice[1]!r}", hint=did_you_mean(choice[1], known))
        raise BadInput(message, hint=f"see `{self.prog} --help`")


def split_overrides(argv: list[str]) -> tuple[list[str], list[tuple[str, str]]]:
    """Take ``--section.key value`` and ``--set section.key=value`` out of the words.

    A setting without a value means true. Words after ``--`` are left alone.
    """
    rest: list[str] = []
    found: list[tuple[str, str]] = []
    words = iter(range(len(argv)))
    for i in words:
        word = argv[i]
        if word == "--":
            return rest + argv[i:], found
        name, equals, value = word.removeprefix("--").partition("=")
        if word == "--set" or word.startswith("--set="):
            text = value
            if not equals:
                text = argv[i + 1] if i + 1 < len(argv) else ""
                next(words, None)
            name, equals, value = text.partition("=")
            if not equals or "." not in name:
                raise BadInput(f"--set {text!r} is not section.key=value", hint="--set masks.threshold=0.4")
            found.append((name.replace("-", "_"), value))
        elif re.match(r"--[A-Za-z_][\w-]*\.[\w.-]*", word):
            if not equals:
                following = argv[i + 1] if i + 1 < len(argv) else "--"
                value = "true" if following.startswith("--") else following
                if not following.startswith("--"):
                    next(words, None)
            found.append((name.replace("-", "_"), value))
        else:
            rest.append(word)
    return rest, found


def build_parser(own: Mapping[str, Verb] | None = None, called: str = "") -> argparse.ArgumentParser:
    """The parser of all verbs; `own` are those of the pipeline, of which only the one `called` is imported."""
    parser = _Parser(
        prog="banmo",
        description="A folder of videos in, an animatable 3D model out.",
        epilog="start with: banmo run clips/\n\n" + _EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="COMMAND", parser_class=_Parser)
    for name, (_, summary, examples) in _VERBS.items():
        verb = verbs.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            epilog="examples:\n" + "\n".join(f"  {e}" for e in examples) + "\n\n" + _EXIT_CODES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        _arguments(name, verb)
    for name, described in (own or {}).items():
        if name not in _VERBS:
            _add_own(verbs, described, called == name)
    return parser


def _add_own(verbs: Any, described: Verb, called: bool) -> None:
    """Add a verb of the pipeline."""
    verb = verbs.add_parser(
        described.name,
        help=described.summary,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    verb.add_argument("--workspace", type=Path, default=Path("workspace"), metavar="DIR", help="default: ./workspace")
    verb.add_argument("--definition", default="", metavar="PACKAGE", help=argparse.SUPPRESS)
    if called:
        summary, examples = add_arguments(described, verb)
        verb.description = f"{summary[:1].upper()}{summary[1:].rstrip('.')}."
        verb.epilog = "examples:\n" + "\n".join(f"  {e}" for e in examples) + "\n\n" + _EXIT_CODES


def _early_options(words: list[str]) -> Options:
    """Workspace and pipeline, before the verbs of that pipeline are known."""
    parser = _Parser(add_help=False, allow_abbrev=False)
    parser.add_argument("--workspace", type=Path, default=Path("workspace"))
    parser.add_argument("--definition", default="")
    known, _ = parser.parse_known_args([w for w in words if w not in ("-h", "--help")])
    return Options(workspace=known.workspace, definition=known.definition)


def _arguments(name: str, verb: argparse.ArgumentParser) -> None:
    add = verb.add_argument
    if name == "init":
        add("directory", nargs="?", type=Path, metavar="DIR", help="folder to make (default: --workspace)")
    add("--workspace", type=Path, default=Path("workspace"), metavar="DIR", help="default: ./workspace")
    if name not in ("verify", "pin", "log", *_SHARE):
        add("--definition", default="", metavar="PACKAGE", help="package that defines the pipeline (default: stages)")
    if name in ("run", "status", "why", "inspect", "graph", "settings", "bless", "gc", "export"):
        add("--preset", metavar="NAME", help="settings by purpose; see `banmo settings`")
        add("--skip-video", action="append", default=[], metavar="VIDEO", help="leave a video out")
        add("--set", metavar="STAGE.KEY=VALUE", help=_SETTINGS_HELP)
    if name == "run":
        add("videos", nargs="?", type=Path, metavar="VIDEOS", help="folder of clips (remembered for next time)")
        add("--stage", action="append", default=[], metavar="STAGE", help="only this stage and what it needs")
        add("--until", metavar="STAGE", help="stop after this stage")
        add("--redo", action="append", default=[], metavar="STAGE", help="run it even if it is up to date")
        add("--video", action="append", default=[], metavar="VIDEO", help="only the stages of this video")
        add("-n", "--dry-run", action="store_true", help="say what would run, and stop")
        add("--check", action="store_true", help="as -n, and exit 10 when there is work")
        add("--executor", choices=("local", "slurm"), help="where to run; short for --execution.executor")
        add("--fail-fast", action="store_true", help="stop everything at the first failure")
    if name in ("why", "inspect", "log", "bless"):
        add("stage", metavar="STAGE")
        add("video", nargs="?", metavar="VIDEO")
    if name == "log":
        add("-f", "--follow", action="store_true", help="keep printing what comes")
        add("-n", "--lines", type=int, default=50, help="how many of the last lines (default 50; 0 = all)")
    if name == "graph":
        add("--dot", action="store_true", help="Graphviz DOT instead of Mermaid")
    if name == "settings":
        add("section", nargs="?", metavar="SECTION")
        add("--toml", action="store_true", help="as a commented pipeline.toml")
    if name == "verify":
        add("--deep", action="store_true", help="hash every file")
        add("--sample", metavar="PERCENT", help="with --deep: only this share of the folders, drawn anew each time")
        add("--repair", action="store_true", help="move damaged folders aside, so that the next run makes them again")
    if name == "gc":
        add("--apply", action="store_true", help="delete; without it only say what would go")
        add("--keep", type=int, metavar="N", help="runs to keep (default: execution.keep_runs)")
    if name == "compare":
        add("old", metavar="RUN", help="id of a run, a pin, or `latest`")
        add("new", metavar="RUN", help="the run to compare it with")
    if name in ("push", "pull"):
        add("url", metavar="URL", help="a folder, s3://bucket/prefix, ssh://host/path, …")
        add("--all", action="store_true", help="the results of every run, not only of the newest")
        add("-n", "--dry-run", action="store_true", help="say what would travel, and stop")
    if name == "pin":
        add("run", nargs="?", metavar="RUN", help="id of a run, or `latest`")
        add("name", nargs="?", metavar="NAME")
        add("--remove", metavar="NAME", help="let go of a pin")
    if name == "export":
        add("--to", type=Path, metavar="DIR", help="default: exports/ in the workspace")
    if name in ("run", "status", "why", "inspect", "verify", "gc", "pin", "doctor", "graph", "settings", *_SHARE):
        add("--json", action="store_true", help="for machines")


def options_of(args: argparse.Namespace, overrides: list[tuple[str, str]]) -> Options:
    """The options all commands share."""
    if getattr(args, "executor", None):
        overrides = [*overrides, ("execution.executor", args.executor)]
    return Options(
        workspace=args.workspace,
        definition=getattr(args, "definition", ""),
        preset=getattr(args, "preset", None),
        overrides=overrides,
        videos=getattr(args, "videos", None),
        skip_videos=tuple(getattr(args, "skip_video", ())),
    )


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    args = argparse.Namespace(workspace="the disk")
    try:
        rest, overrides = split_overrides(words)
        verb = next((w for w in rest if not w.startswith("-")), "")
        own = {} if verb in _VERBS else verbs_of(_early_options(rest))
        parser = build_parser(own, verb)
        args, unknown = parser.parse_known_args(rest)
        if unknown:
            raise BadInput(
                f"unknown flag {unknown[0]!r} for {args.verb}", hint=_flag_hint(parser, args.verb, unknown[0])
            )
        if args.verb in own and args.verb not in _VERBS:
            if overrides and not takes_settings(own[args.verb]):
                raise BadInput(f"{args.verb} takes no settings of stages", hint=f"see `banmo {args.verb} --help`")
            args.overrides = overrides
            os.environ.setdefault("GOMP_SPINCOUNT", "2000")  # before torch is imported; see child_environment
            return run_verb(own[args.verb], args, options_of(args, []))
        module: Any = importlib.import_module(f"pipeline.commands.{_VERBS[args.verb][0]}")
        return int(getattr(module, f"{args.verb}_command")(args, options_of(args, overrides)))
    except PipelineError as error:
        sys.stdout.flush()
        sys.stderr.write(f"banmo: {error}\n")
        return int(error.exit_code)
    except KeyboardInterrupt:
        sys.stderr.write("banmo: stopped\n")
        return ExitCode.STOPPED
    except BrokenPipeError:
        sys.stderr.close()
        return 128 + signal.SIGPIPE
    except OSError as error:
        if error.errno not in _USERS_ERRNOS:
            raise
        told = disk_full(error.filename or args.workspace) if error.errno in FULL else None
        sys.stderr.write(f"banmo: {told or BadInput(str(error.strerror), where=error.filename or 'the disk')}\n")
        return ExitCode.USAGE


def _flag_hint(parser: argparse.ArgumentParser, verb: str, word: str) -> str:
    action = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    known = [s for a in action.choices[verb]._actions for s in a.option_strings]
    return did_you_mean(word, known) if word.startswith("-") else f"see `banmo {verb} --help`"


if __name__ == "__main__":
    sys.exit(main())
