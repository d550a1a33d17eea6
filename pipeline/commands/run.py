"""``banmo run``: plan, ask where a decision is needed, execute, say what was done."""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.console import PlainDisplay, duration, print_plan
from pipeline.errors import ExitCode
from pipeline.executor import Executor
from pipeline.exports import export
from pipeline.graph import Selection
from pipeline.guard import decision, needs_decision
from pipeline.local import LocalExecutor, Tokens, machine_cpus, machine_gpus
from pipeline.plan import HIT, Planner, Step
from pipeline.preflight import check_disk
from pipeline.project import Options, Project
from pipeline.runs import RunFolder, shows
from pipeline.scheduler import Scheduler
from pipeline.settings import check_execution, to_toml
from pipeline.tally import Report
from pipeline.videos import orphans


@dataclass(frozen=True)
class Flags:
    """Flags of ``run`` alone."""

    dry_run: bool = False
    check: bool = False
    fail_fast: bool = False
    json: bool = False


def run_command(args: argparse.Namespace, options: Options) -> int:
    """Parse and run."""
    selection = Selection(tuple(args.stage), args.until, tuple(args.redo), tuple(args.video))
    return run(options, selection, Flags(args.dry_run, args.check, args.fail_fast, args.json))


def run(options: Options, selection: Selection, flags: Flags) -> int:
    """Make everything that is not up to date; returns the exit status."""
    clock = time.monotonic()
    while True:
        code = _attempt(options, selection, flags, clock)
        if code is not None:
            return code


def _attempt(options: Options, selection: Selection, flags: Flags, clock: float) -> int | None:
    """Plan and execute; None when ``gc`` took something away between the two, so that the plan may be wrong."""
    project = Project.open(options, create=True)
    collection = project.workspace.collection()
    nodes, forced = project.select(selection)
    planner = project.planner(forced)
    steps = planner.plan(nodes)
    project.sources.save()
    pending = [s for s in steps if s.status != HIT]
    if flags.dry_run or flags.check:
        _say_plan(steps, pending, flags)
        return ExitCode.PENDING if flags.check and pending else ExitCode.DONE
    guarded = [s for s in steps if needs_decision(s, forced, project.settings.pipeline.guard_minutes)]
    if guarded:
        raise decision(guarded)
    project.workspace.remember(project.remembered)
    for name in orphans(project.videos_dir, project.definition.given_suffixes, project.videos):
        sys.stdout.write(f"note: {name} belongs to no video here\n")
    if not pending:
        return _nothing_to_do(project, planner, steps, selection, clock)
    check_disk(project, planner, pending)
    folder = RunFolder(project.workspace)
    folder.open()  # from here on nothing is collected
    if project.workspace.collection() != collection:
        folder.discard()
        return None
    return _execute(project, planner, steps, selection, flags, clock, folder)


def _say_plan(steps: list[Step], pending: list[Step], flags: Flags) -> None:
    if flags.json:
        sys.stdout.write(json.dumps(plan_json(steps), indent=1) + "\n")
    elif pending:
        sys.stdout.write(f"{len(pending)} of {len(steps)} to run:\n")
        print_plan(steps)
    else:
        sys.stdout.write("everything is up to date\n")


def _nothing_to_do(project: Project, planner: Planner, steps: list[Step], selection: Selection, clock: float) -> int:
    exported = None
    if selection.is_everything():
        _show_in_latest(project, planner, steps)
        exported = export(project, planner)
    warnings = {s.node.label: s.record.warnings for s in steps if s.record and s.record.warnings}
    _say_warnings(warnings)
    took = duration(time.monotonic() - clock)
    sys.stdout.write(f"everything is up to date: {len(steps)} results, checked in {took}\n")
    if exported:
        sys.stdout.write(f"exports: {exported}\n")
    return ExitCode.DONE


def _execute(
    project: Project, planner: Planner, steps: list[Step], selection: Selection, flags: Flags, clock: float,
    folder: RunFolder,
) -> int:  # fmt: skip
    out = sys.stdout
    pending = [s for s in steps if s.status != HIT]
    try:
        out.write(f"{len(pending)} of {len(steps)} to run:\n")
        print_plan(steps)
        out.flush()
        project.workspace.clean_scratch()
        folder.write_plan(plan_json(steps), to_toml(project.settings))
        folder.make_latest()
        executor, cpus = _executor(project, folder, pending)
        with contextlib.ExitStack() as stack:
            display: Any = PlainDisplay(out)
            if out.isatty():
                from pipeline.live import LiveDisplay

                expected = {s.node.label: s.record.seconds for s in steps if s.record}
                display = stack.enter_context(LiveDisplay(steps, expected, cpus))
            scheduler = Scheduler(planner, steps, folder, executor, display, fail_fast=flags.fail_fast)
            report = scheduler.run()
        folder.write_plan(plan_json([planner.steps[s.node.label] for s in steps], planner), to_toml(project.settings))
    finally:
        folder.close()
    exported = None
    if len(report.done) + len(report.hits) == len(steps) and selection.is_everything():
        exported = export(project, planner)
    return _conclude(report, exported, time.monotonic() - clock)


def _executor(project: Project, folder: RunFolder, pending: list[Step]) -> tuple[Executor, int]:
    """Where to run, and with how many cores at once."""
    execution = project.settings.execution
    check_execution(execution)
    if execution.executor == "slurm":
        from pipeline.slurm import SlurmExecutor

        return SlurmExecutor(project.workspace, execution, folder.path), max(1, execution.slurm_parallel)
    cpus = min(execution.cpus or machine_cpus(), machine_cpus())
    gpus = machine_gpus() if any(s.node.info.gpus for s in pending) else []
    gpus = gpus if execution.gpus < 0 else gpus[: execution.gpus]
    return LocalExecutor(Tokens(cpus, gpus), execution.ranks), cpus


def plan_json(steps: list[Step], planner: Planner | None = None) -> dict[str, Any]:
    """A plan for machines: every node with its status, key, folder and reasons."""
    rows = []
    for step in steps:
        record = step.record if step.status == HIT else None
        if planner is not None:
            record = planner.results.get(step.node.label)
        rows.append(
            {
                "stage": step.node.info.name,
                "video": step.node.video_name,
                "status": step.status,
                "key": step.action.key if step.action else None,
                "digest": record.digest if record else None,
                "waits_for": step.waits_for,
                "reasons": [r.as_json() for r in step.reasons],
            }
        )
    return {"steps": rows}


def _show_in_latest(project: Project, planner: Planner, steps: list[Step]) -> None:
    """Nothing ran, but ``latest`` may show something else, from settings tried in between."""
    wanted = {(s.node.info.name, s.node.video_name): planner.results[s.node.label].digest for s in steps}
    if shows(project.workspace, wanted):
        return
    folder = RunFolder(project.workspace)
    folder.open()
    try:
        folder.write_plan(plan_json(steps), to_toml(project.settings))
        for step in steps:
            folder.link(step.node, planner.results[step.node.label].digest)
        folder.make_latest()
    finally:
        folder.close()


def _say_warnings(warnings: dict[str, list[str]]) -> None:
    for label, texts in warnings.items():
        for text in texts:
            sys.stdout.write(f"warning: {label}: {' '.join(text.split())}\n")


def _conclude(report: Report, exported: Path | None, seconds: float) -> int:
    out, err = sys.stdout, sys.stderr
    _say_warnings(report.warnings)
    parts = [f"{len(report.done)} done", f"{len(report.hits)} up to date"]
    waiting = {**report.blocked, **dict.fromkeys(report.not_started, "")}
    for name, many in (
        ("failed", len(report.failed) + len(report.bad_input)),
        ("stopped", len(report.interrupted)),
        ("not run", len(waiting)),
    ):
        if many:
            parts.append(f"{many} {name}")
    out.write(f"{', '.join(parts)} in {duration(seconds)}\n")
    if exported:
        out.write(f"exports: {exported}\n")
    out.flush()
    for label, text in report.failed.items():
        stage, _, video = label.partition("/")
        err.write(f"{stage} failed{f' on {video}' if video else ''}\n")
        err.write(f"  why   {text}\n")
        err.write(f"  log   banmo log {label.replace('/', ' ')}\n")
        if video:
            err.write(f"  next  mend the cause and run again, or leave it out: banmo run --skip-video {video}\n")
    for text in dict.fromkeys(report.bad_input.values()):
        err.write(f"banmo: {text}\n")
    if report.stopped_by == signal.SIGINT:
        err.write("stopped; the same command goes on from here\n")
        return ExitCode.STOPPED
    if report.stopped_by:
        return ExitCode.INTERRUPTED
    if report.failed:
        return ExitCode.FAILED
    if report.bad_input:
        return ExitCode.USAGE
    if report.undecided:
        err.write(f"banmo: {decision(report.undecided)}\n")
        return ExitCode.DECISION
    return ExitCode.DONE
