"""``init``, ``verify``, ``gc``, ``pin``, ``bless``, ``export``, ``doctor``: looking after a workspace."""

from __future__ import annotations

import argparse
import dataclasses
import getpass
import sys
from datetime import UTC, datetime

from pipeline.commands.show import nodes_named, open_quietly, print_json
from pipeline.console import duration, size
from pipeline.doctor import examine
from pipeline.errors import BadInput, ExitCode, did_you_mean
from pipeline.exports import export
from pipeline.files import write_json
from pipeline.ledger import Record
from pipeline.plan import HIT, RUN, Step
from pipeline.project import Options, Project, package_of, template_of
from pipeline.reasons import brief
from pipeline.runs import list_runs
from pipeline.settings import ExecutionSection
from pipeline.upkeep import as_json, collect, find_garbage, pins, verify
from pipeline.workspace import Workspace


def init_command(args: argparse.Namespace, options: Options) -> int:
    """Make a workspace."""
    root = args.directory or options.workspace
    existed = (root / "FORMAT").is_file()
    workspace = Workspace.open(root, create=True, template=template_of(options))
    memory = workspace.remembered()
    workspace.remember({**memory, "definition": package_of(options, memory)})
    word = "is a workspace already" if existed else "made"
    sys.stdout.write(f"{workspace.root} {word}; next: banmo run VIDEOS --workspace {root}\n")
    return ExitCode.DONE


def verify_command(args: argparse.Namespace, options: Options) -> int:
    """Check the store; exit 4 on damage."""
    share = _share(args.sample) if args.sample else 1.0
    workspace = Workspace.open(options.workspace)
    if args.repair:
        with workspace.exclusive():
            if workspace.live():
                raise BadInput("a run is at work in this workspace", hint="wait until it has ended")
            workspace.collected()
            found = verify(workspace, deep=args.deep or bool(args.sample), share=share, repair=True)
    else:
        found = verify(workspace, deep=args.deep or bool(args.sample), share=share)
    if args.json:
        print_json(as_json(found))
    else:
        for fault in found.faults:
            sys.stdout.write(f"damaged  {fault}\n")
        for name in found.repaired:
            sys.stdout.write(f"moved aside  {name}\n")
        how = f"{found.hashed} hashed" if found.hashed else "counts and sizes"
        sys.stdout.write(f"{found.objects} folders ({how}), {found.records} records, {len(found.faults)} faults\n")
        if found.faults:
            sys.stdout.write("`banmo run` makes again what is damaged\n")
    return ExitCode.DAMAGED if found.faults else ExitCode.DONE


def _share(text: str) -> float:
    try:
        value = float(text.removesuffix("%")) / 100
    except ValueError:
        value = -1.0
    if not 0 < value <= 1:
        raise BadInput(f"--sample {text!r} is not a percentage", hint="--sample 10%")
    return value


def gc_command(args: argparse.Namespace, options: Options) -> int:
    """Say what can go, or delete it."""
    workspace = Workspace.open(options.workspace)
    keep, wanted = args.keep, set[str]()
    try:
        project = open_quietly(options)
        keep = project.settings.execution.keep_runs if keep is None else keep
        loadable = [n for n in project.graph.nodes if not n.info.error]
        wanted = {s.action.key for s in _plan_what_can_be(project, loadable) if s.action}
    except BadInput as error:  # videos moved away, say: the kept runs still protect their results
        sys.stderr.write(f"note: the present plan is unknown ({error})\n")
    keep = ExecutionSection().keep_runs if keep is None else keep
    runs_kept = keep
    garbage = find_garbage(workspace, keep, wanted)
    if args.apply and garbage:
        garbage = collect(workspace, lambda: find_garbage(workspace, runs_kept, wanted))
    if args.json:
        folders = [str(p.relative_to(workspace.root)) for p in garbage.folders]
        print_json(
            {
                "records": [f"{s}/{k}" for s, k in garbage.records],
                "objects": [f"{k}/{d}" for k, d in garbage.objects],
                "folders": folders,
                "bytes": garbage.bytes,
                "deleted": bool(args.apply),
            }
        )
        return ExitCode.DONE
    verb = "deleted" if args.apply else "would go"
    sys.stdout.write(
        f"{len(garbage.objects)} results, {len(garbage.records)} records, {len(garbage.folders)} folders of runs and "
        f"unfinished work {verb}: {size(garbage.bytes)}\n"
    )
    if not args.apply and garbage:
        sys.stdout.write("`banmo gc --apply` deletes them\n")
    return ExitCode.DONE


def _plan_what_can_be(project: Project, nodes: list) -> list[Step]:  # type: ignore[type-arg]
    planner = project.planner()
    known = set()
    steps = []
    for node in nodes:
        sources = [n for many in project.graph.inputs(node).values() for n in many]
        if all(n.label in known for n in sources):
            known.add(node.label)
            steps.append(planner.decide(node))
    return steps


def pin_command(args: argparse.Namespace, options: Options) -> int:
    """List, set or drop pins."""
    workspace = Workspace.open(options.workspace)
    held = pins(workspace)
    runs = list_runs(workspace)
    if args.remove:
        if args.remove not in held:
            raise BadInput(f"there is no pin {args.remove!r}", hint=did_you_mean(args.remove, held))
        del held[args.remove]
    elif args.run:
        run = runs[0] if args.run == "latest" and runs else args.run
        if run not in runs:
            raise BadInput(f"there is no run {args.run!r}", hint=did_you_mean(args.run, [*runs[:5], "latest"]))
        if not args.name:
            raise BadInput("a pin needs a name", hint=f"banmo pin {run} NAME")
        held[args.name] = run
    else:
        if args.json:
            print_json({"pins": held, "runs": runs})
            return ExitCode.DONE
        for run in runs:
            names = [n for n, r in held.items() if r == run]
            sys.stdout.write(f"{run}{'  pinned as ' + ', '.join(names) if names else ''}\n")
        return ExitCode.DONE
    write_json(workspace.root / "pins.json", held)
    return ExitCode.DONE


def bless_command(args: argparse.Namespace, options: Options) -> int:
    """Accept earlier results under changed code: a new record for the new key, pointing at the same folder."""
    project = open_quietly(options)
    nodes = nodes_named(project, args.stage, args.video)
    planner = project.planner()
    blessed = 0
    planner.plan(project.graph.needed(nodes))
    for node in nodes:
        step = planner.decide(node)
        if step.status == HIT:
            continue
        if step.status != RUN or {r.kind for r in step.reasons} != {"code"} or step.record is None:
            reason = brief(step.reasons) if step.status == RUN else f"it waits for {', '.join(step.waits_for[:2])}"
            raise BadInput(f"{node.label} cannot be blessed: {reason}", hint="only a change of code can be")
        if not project.workspace.objects.sound(step.record.stage, step.record.digest):
            raise BadInput(f"{node.label} cannot be blessed: its folder is damaged", hint="banmo run")
        record = _blessed(step, step.record)
        project.workspace.ledger.write(record)
        planner.finished(node, record)
        blessed += 1
        sys.stdout.write(
            f"{node.label}: the result of {step.record.finished} stands ({duration(step.record.seconds)} saved)\n"
        )
    if not blessed:
        sys.stdout.write(f"{args.stage} is up to date; nothing to bless\n")
    return ExitCode.DONE


def _blessed(step: Step, old: Record) -> Record:
    assert step.action is not None and step.node.info.code is not None
    try:
        who = getpass.getuser()
    except (KeyError, OSError):
        who = "unknown"
    note = {"who": who, "when": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"), "from": old.key}
    return dataclasses.replace(
        old,
        key=step.action.key,
        action=step.action.text,
        modules=step.node.info.code.modules,
        video=step.node.video_name,
        blessed=note,
    )


def export_command(args: argparse.Namespace, options: Options) -> int:
    """Copy what a user holds out of the store."""
    project = open_quietly(options)
    planner = project.planner()
    nodes = [node for stage in project.definition.exported for node in nodes_named(project, stage, None)]
    planner.plan(project.graph.needed(nodes))
    if (
        args.to is not None
        and args.to.exists()
        and any(args.to.iterdir())
        and not (args.to / "provenance.json").exists()
    ):
        raise BadInput("this folder is not empty and not an earlier export", where=args.to, hint="name a new one")
    target = export(project, planner, args.to.absolute() if args.to else None)
    if target is None:
        wanted = " and ".join(project.definition.exported)
        raise BadInput(f"{wanted} has no result that is up to date", hint="banmo run")
    sys.stdout.write(f"exports: {target}\n")
    return ExitCode.DONE


def doctor_command(args: argparse.Namespace, options: Options) -> int:
    """Examine machine and workspace; exit 1 when something needs mending."""
    rows = examine(options)
    if args.json:
        print_json([dataclasses.asdict(r) for r in rows])
    else:
        for row in rows:
            sys.stdout.write(f"{'ok  ' if row.ok else 'MEND'}  {row.name:<12} {row.text}\n")
    return ExitCode.DONE if all(r.ok for r in rows) else ExitCode.FAILED
