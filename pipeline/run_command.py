"""``banmo run``: plan, ask where a decision is needed, execute, say what was done."""

from __future__ import annotations

import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline.console import PlainDisplay, duration, print_plan
from pipeline.errors import ExitCode
from pipeline.exports import export
from pipeline.graph import Selection
from pipeline.local import Tokens, machine_cpus, machine_gpus
from pipeline.plan import HIT, Step
from pipeline.project import Options, Project
from pipeline.runs import RunFolder, shows
from pipeline.scheduler import Report, Scheduler
from pipeline.settings import to_toml


@dataclass(frozen=True)
class RunOptions:
    """Flags of ``run`` alone."""

    dry_run: bool = False
    check: bool = False
    fail_fast: bool = False


def run(options: Options, selection: Selection, flags: RunOptions) -> int:
    """Execute; returns the exit status."""
    clock = time.monotonic()
    project = Project.open(options, create=True)
    nodes, forced = project.select(selection)
    planner = project.planner(forced)
    steps = planner.plan(nodes)
    project.sources.save()
    pending = [s for s in steps if s.status != HIT]
    out = sys.stdout
    if flags.dry_run or flags.check:
        if pending:
            out.write(f"{len(pending)} of {len(steps)} to run:\n")
            print_plan(steps)
        else:
            out.write("everything is up to date\n")
        return ExitCode.PENDING if flags.check and pending else ExitCode.DONE
    project.workspace.remember(project.remembered)
    if not pending:
        _finish_view(project, steps, selection)
        exported = export(project, steps) if selection.is_everything() else None
        out.write(f"everything is up to date ({len(steps)} results, {duration(time.monotonic() - clock)})\n")
        if exported:
            out.write(f"exports: {exported}\n")
        return ExitCode.DONE
    return _execute(project, steps, planner, selection, flags, clock)


def _execute(project, steps, planner, selection, flags, clock):  # type: ignore[no-untyped-def]
    out = sys.stdout
    pending = [s for s in steps if s.status != HIT]
    out.write(f"{len(pending)} of {len(steps)} to run:\n")
    print_plan(steps)
    out.flush()
    project.workspace.clean_scratch()
    folder = RunFolder(project.workspace)
    folder.open()
    try:
        folder.write_plan(_plan_json(steps), to_toml(project.settings))
        folder.make_latest()
        execution = project.settings.execution
        cpus = min(execution.cpus or machine_cpus(), machine_cpus())
        gpus = machine_gpus() if any(s.node.info.gpus for s in pending) else []
        gpus = gpus if execution.gpus < 0 else gpus[: execution.gpus]
        scheduler = Scheduler(
            planner, steps, folder, Tokens(cpus, gpus), PlainDisplay(out), fail_fast=flags.fail_fast
        )
        report = scheduler.run()
        final = [planner.steps[s.node.label] for s in steps]
        folder.write_plan(_plan_json(final, planner), to_toml(project.settings))
    finally:
        folder.close()
    complete = len(report.done) + len(report.hits) == len(steps)
    exported = None
    if complete and selection.is_everything():
        exported = export(project, [planner.steps[s.node.label] for s in steps], planner)
    return _conclude(project, report, exported, time.monotonic() - clock)


def _plan_json(steps, planner=None):  # type: ignore[no-untyped-def]
    rows = []
    for s in steps:
        record = planner.results.get(s.node.label) if planner else s.record if s.status == HIT else None
        rows.append(
            {
                "stage": s.node.info.name,
                "video": s.node.video_name,
                "status": s.status,
                "key": s.action.key if s.action else None,
                "digest": record.digest if record else None,
                "reasons": [r.as_json() for r in s.reasons],
            }
        )
    return {"steps": rows}


def _finish_view(project: Project, steps: list[Step], selection: Selection) -> None:
    wanted = {(s.node.info.name, s.node.video_name): s.record.digest for s in steps if s.record}
    if not selection.is_everything() or shows(project.workspace, wanted):
        return
    folder = RunFolder(project.workspace)
    folder.open()
    try:
        folder.write_plan(_plan_json(steps), to_toml(project.settings))
        for step in steps:
            assert step.record is not None
            folder.link(step.node, step.record.digest)
        folder.make_latest()
    finally:
        folder.close()


def _conclude(project: Project, report: Report, exported: Path | None, seconds: float) -> int:
    out, err = sys.stdout, sys.stderr
    for label, texts in report.warnings.items():
        for text in texts:
            out.write(f"warning: {label}: {text}\n")
    parts = [f"{len(report.done)} done", f"{len(report.hits)} up to date"]
    for name, many in (
        ("failed", len(report.failed) + len(report.bad_input)),
        ("stopped", len(report.interrupted)),
        ("waiting", len(report.blocked) + len(report.not_started)),
    ):
        if many:
            parts.append(f"{many} {name}")
    out.write(f"{', '.join(parts)} in {duration(seconds)}\n")
    if exported:
        out.write(f"exports: {exported}\n")
    out.flush()
    for label, text in report.failed.items():
        err.write(f"banmo: {label} failed: {text}\n")
    for text in dict.fromkeys(report.bad_input.values()):
        err.write(f"banmo: {text}\n")
    if report.stopped_by == signal.SIGINT:
        return ExitCode.STOPPED
    if report.stopped_by:
        return ExitCode.INTERRUPTED
    if report.failed:
        return ExitCode.FAILED
    if report.bad_input:
        return ExitCode.USAGE
    return ExitCode.DONE
