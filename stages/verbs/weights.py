"""``banmo weights``: networks by name: which are known, which are here, fetch one, add your own, check them."""

from __future__ import annotations

import argparse
import shutil
import sys
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

from pipeline import BadInput, Results

SUMMARY = "networks for the slots of the stages: list, get, add your own, check"
EXAMPLES = (
    "banmo weights list",
    'banmo weights get isnet                        then in pipeline.toml: [masks] network = "isnet"',
    "banmo weights add my.onnx --name mine --slot masks --contract my.toml",
    "banmo weights fit dinov2-small --as dinov2-cats    reduce its tokens to 16 channels over the clips of a workspace",
    "banmo weights check                            every network that is here",
    "banmo weights check my.onnx --slot features",
)
NEEDS_WORKSPACE = False


def arguments(parser: argparse.ArgumentParser) -> None:
    """Flags."""
    add = parser.add_argument
    add("action", choices=("list", "get", "add", "fit", "check"), help="what to do")
    add("what", nargs="*", metavar="NAME", help="names (get, fit, check), or an ONNX file (add, check)")
    add("--name", metavar="NAME", help="add: what to call it; default: the name of the file")
    add("--slot", choices=("masks", "flow", "features"), help="add, check: the stage that takes it")
    add("--contract", type=Path, metavar="TOML", help="add, check: what the network expects; see docs/slots.md")
    add("--as", dest="other", metavar="NAME", help="fit: what to call the result; default: the name with -fitted")
    add("--licence", default="", metavar="TEXT", help="add: a note of its licence, shown by list")
    add(
        "--from",
        dest="source",
        metavar="URL",
        help="get: another address of the same file; its digest must be the same",
    )


def run(args: argparse.Namespace, results: Results | None) -> int:
    """Do what is asked; 0 when it worked, 1 when a check found a fault."""
    if args.action == "list":
        return _list()
    if args.action == "get":
        return _get(args)
    if args.action == "add":
        return _add(args)
    if args.action == "fit":
        return _fit(args)
    return _check(args)


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


def _list() -> int:
    from pipeline.console import size
    from stages import registry

    known, here = registry.read_registry(), registry.here()
    rows = []
    for name, entry in known.items():
        state = "here" if name in here else "-"
        length = size(entry.bytes) if entry.bytes else ""
        rows.append((name, entry.slot, state, length, entry.licence, entry.summary))
    for name, folder in here.items():
        if name not in known:
            facts = registry.about(folder)
            length = size((folder / registry.MODEL).stat().st_size)
            rows.append(
                (name, str(facts.get("slot", "")), "here", length, str(facts.get("licence", "")), "added by you")
            )
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    for row in rows:
        _say("  ".join(f"{text:<{width}}" for text, width in zip(row, [*widths, 0], strict=True)).rstrip())
    _say(f"\nin {registry.home()}; set it with BANMO_WEIGHTS. Fetch one: banmo weights get NAME")
    return 0


def _get(args: argparse.Namespace) -> int:
    from stages import registry
    from stages.download import digest_of, fetch

    known = registry.read_registry()
    if not args.what:
        raise BadInput("banmo weights get wants a name", hint=f"known: {', '.join(known)}")
    for name in args.what:
        if name not in known:
            raise BadInput(f"there is no network {name!r}", hint=f"known: {', '.join(known)}")
    for name in args.what:
        entry = known[name]
        _say(f"{name}: {entry.summary}\n  licence {entry.licence}, from {entry.source}\n  {args.source or entry.url}")
        if (
            name in registry.here()
            and digest_of(registry.here()[name] / registry.MODEL, entry.digest_kind) == entry.digest
        ):
            _say("  is here already")
            continue
        url, line = args.source or entry.url, _Line()

        def bring(target: Path, entry: registry.Entry = entry, url: str = url, line: _Line = line) -> None:
            waiting = registry.home() / "parts" / f"{entry.name}-{entry.digest[:12]}.onnx"
            fetch(url, waiting, kind=entry.digest_kind, digest=entry.digest, size=entry.bytes, progress=line.show)
            shutil.move(waiting, target)

        facts = {
            "name": name,
            "slot": entry.slot,
            "licence": entry.licence,
            "source": entry.source,
            "url": entry.url,
            entry.digest_kind: entry.digest,
        }
        with registry.locked(name):
            folder = registry.keep(name, bring, entry.contract, facts, partial(_judge, slot=entry.slot))
        line.end()
        _say(f'  here: {folder}\n  use it: [{entry.slot}] network = "{name}"')
    return 0


def _add(args: argparse.Namespace) -> int:
    from stages import registry
    from stages.contracts import MAX_CONTRACT_BYTES
    from stages.download import digest_of

    if len(args.what) != 1 or not args.slot:
        raise BadInput("banmo weights add wants one ONNX file and --slot", hint="--slot masks, flow or features")
    path = Path(args.what[0]).expanduser()
    if not path.is_file():
        raise BadInput("there is no such file", where=path)
    name = args.name or path.stem.lower()
    if name in registry.read_registry():
        raise BadInput(f"{name!r} is the name of a known network", hint="choose another with --name")
    contract: dict[str, Any] = {}
    if args.contract is not None:
        _judge(path, args.slot, args.contract)  # says what is wrong with the file as the user named it
        if args.contract.stat().st_size <= MAX_CONTRACT_BYTES:
            contract |= tomllib.loads(args.contract.read_text(encoding="utf-8"))
            contract.pop("about", None)
    facts = {
        "name": name,
        "slot": args.slot,
        "licence": args.licence,
        "source": path.name,
        "sha256": digest_of(path, "sha256"),
    }
    with registry.locked(name):
        folder = registry.keep(
            name, lambda target: shutil.copyfile(path, target), contract, facts, lambda f: _judge(f, args.slot)
        )
    _say(f'here: {folder}\nuse it: [{args.slot}] network = "{name}"')
    return 0


def _fit(args: argparse.Namespace) -> int:
    from stages import registry
    from stages.tokens import fit_axes

    if len(args.what) != 1:
        raise BadInput("banmo weights fit wants the name of one network of tokens", hint="such as dinov2-small")
    name = args.what[0]
    folder = registry.find(name)
    if folder is None:
        raise BadInput(f"there is no network {name!r} here", hint="banmo weights list")
    target = args.other or f"{name}-fitted"
    if target in registry.read_registry():
        raise BadInput(f"{target!r} is the name of a known network", hint="choose another with --as")
    with registry.locked(target):
        made, told = fit_axes(Path(folder), target, Results(args.workspace))
    _say(f'{told}\nhere: {made}\nuse it: [features] network = "{target}"')
    return 0


def _check(args: argparse.Namespace) -> int:
    from stages import registry
    from stages.download import digest_of

    here = registry.here()
    wanted = args.what or list(here)
    if not wanted:
        _say("no network is here; banmo weights list says which there are")
    faults = 0
    for word in wanted:
        folder = here.get(word)
        if folder is None and not Path(word).expanduser().exists():
            raise BadInput(f"there is no network or file {word!r} here", hint=f"here: {', '.join(here) or 'none'}")
        facts = registry.about(folder) if folder is not None else {}
        slot = args.slot or facts.get("slot")
        if slot not in registry.SLOTS:
            raise BadInput(f"for which stage is {word}?", hint="--slot masks, flow or features")
        try:
            if folder is not None:
                kind = "sha256" if "sha256" in facts else "md5"
                if digest_of(folder / registry.MODEL, kind) != facts.get(kind):
                    raise BadInput(f"{word}: the file has changed since it came", hint=f"banmo weights get {word}")
            _say(f"{word}: {_judge(folder or Path(word).expanduser(), slot, args.contract)}")
        except BadInput as error:
            faults += 1
            _say(f"{word}: FAULT: {error}")
    return 1 if faults else 0


def _judge(network: Path, slot: str, contract: Path | None = None) -> str:
    """Open a network and show it a picture; raises BadInput when it does not do what its slot wants."""
    from stages.slots import trial

    return trial(network, slot, contract or "")


class _Line:
    """One line that tells how far a download is, redrawn on a terminal, silent elsewhere."""

    def __init__(self) -> None:
        self.live = sys.stderr.isatty()
        self.shown = -1

    def show(self, done: int, total: int) -> None:
        """Tell, when another per cent (or megabyte) has come."""
        now = 100 * done // total if total else done // 1_000_000
        if self.live and now != self.shown:
            self.shown = now
            sys.stderr.write(f"\r\x1b[K  {done / 1e6:.1f} MB" + (f" of {total / 1e6:.1f}, {now} %" if total else ""))
            sys.stderr.flush()

    def end(self) -> None:
        """Clear it."""
        if self.live:
            sys.stderr.write("\r\x1b[K")
