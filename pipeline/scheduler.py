"""Runs a plan: launches what is ready, collects what ends, decides what waited; keeps going past failures."""

from __future__ import annotations

import os
import secrets
import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

from pipeline.errors import BadInput
from pipeline.executor import Executor, Grant, Job, Launch, Outcome, silent_after
from pipeline.files import remove_tree, write_json
from pipeline.graph import Node
from pipeline.guard import needs_decision
from pipeline.plan import HIT, RUN, WAIT, Planner, Step
from pipeline.request import build_request
from pipeline.runs import RunFolder
from pipeline.tally import Display, Report

_POLL_S = 0.05
_SILENT_S = 600.0


class Scheduler:
    """One run over the nodes of a plan."""

    def __init__(
        self,
        planner: Planner,
        steps: list[Step],
        folder: RunFolder,
        executor: Executor,
        display: Display,
        *,
        fail_fast: bool = False,
        on_result: Callable[[Node], None] | None = None,
    ) -> None:
        self.planner, self.folder, self.executor, self.display = planner, folder, executor, display
        self.fail_fast = fail_fast
        self.on_result = on_result
        self.workspace = planner.workspace
        self.report = Report()
        self._steps = {s.node.label: s for s in steps}
        self._waiting = [s.node for s in steps if s.status == WAIT]
        self._ready = [s.node for s in steps if s.status == RUN]
        self._jobs: dict[Node, Job] = {}
        self._order = {node.label: i for i, node in enumerate(planner.graph.nodes)}
        self._seen_results = (-1, -1)
        self._signals = 0
        self._left = False
        self._grace_s = planner.settings.execution.grace_s
        for step in steps:
            if step.status == HIT:
                self._show_hit(step)

    def run(self) -> Report:
        """Work until nothing is left to do, or until stopped."""
        clock = time.monotonic()
        previous = {n: signal.signal(n, self._on_signal) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        try:
            while (self._jobs and not self._left) or ((self._ready or self._waiting) and not self._stopping()):
                self._decide_waiting()
                self._launch()
                self._collect()
                self.display.refresh()
                if not self._jobs and not self._ready and self._waiting and not self._decidable():
                    break
                time.sleep(_POLL_S)
        finally:
            if not self.executor.survives:
                for job in self._jobs.values():
                    job.kill()
            for number, handler in previous.items():
                signal.signal(number, handler)
        self.report.not_started = [n.label for n in (*self._ready, *self._waiting)]
        self.report.seconds = time.monotonic() - clock
        return self.report

    # ------------------------------------------------------------------ deciding

    def _decidable(self) -> list[Node]:
        return [n for n in self._waiting if self._blocked_by(n) or not self._unknown_inputs(n)]

    def _unknown_inputs(self, node: Node) -> list[str]:
        inputs = [n for nodes in self.planner.graph.inputs(node).values() for n in nodes]
        return [n.label for n in inputs if n.label not in self.planner.results]

    def _blocked_by(self, node: Node) -> str | None:
        lost = {*self.report.failed, *self.report.bad_input, *self.report.interrupted, *self.report.blocked}
        return next((label for label in self._unknown_inputs(node) if label in lost), None)

    def _decide_waiting(self) -> None:
        """Look at the waiting nodes again, if anything has happened since."""
        if self._seen_results == self._results_so_far():
            return
        self._seen_results = self._results_so_far()
        for node in list(self._waiting):
            blocker = self._blocked_by(node)
            if blocker is not None:
                self._waiting.remove(node)
                self.report.blocked[node.label] = blocker
                self._tell(node, {"event": "blocked", "text": blocker})
            elif not self._unknown_inputs(node):
                self._waiting.remove(node)
                try:
                    step = self.planner.decide(node)
                except BadInput as error:
                    self._refuse(node, error)
                    continue
                self._steps[node.label] = step
                if step.status == HIT:
                    self._show_hit(step)
                elif needs_decision(step, self.planner.forced, self.planner.settings.pipeline.guard_minutes):
                    self.report.undecided.append(step)
                    self.report.blocked[node.label] = "a decision"
                    self._tell(node, {"event": "blocked", "text": "a decision"})
                else:
                    self._ready.append(node)

    def _results_so_far(self) -> tuple[int, int]:
        report = self.report
        lost = len(report.failed) + len(report.bad_input) + len(report.interrupted) + len(report.blocked)
        return len(self.planner.results), lost

    def _show_hit(self, step: Step) -> None:
        assert step.record is not None
        self.report.hits.append(step.node.label)
        if step.record.warnings:
            self.report.warnings[step.node.label] = list(step.record.warnings)
        self._tell(step.node, {"event": "hit"})
        self._result(step.node, step.record.digest)

    # ------------------------------------------------------------------ running

    def _launch(self) -> None:
        if self._stopping():
            return
        busy = {self._key(n) for n in self._jobs}
        launches: list[Launch] = []
        for node in sorted(self._ready, key=lambda n: self._order[n.label]):
            if self._key(node) in busy or self._made_meanwhile(node):
                continue  # the same action under another video's name
            grant = self.executor.take(node.info)
            if grant is None:
                continue
            busy.add(self._key(node))
            self._ready.remove(node)
            try:
                launch = self._prepare(node, grant)
            except BadInput as error:
                self.executor.give_back(grant)
                self._refuse(node, error)
                continue
            if launch is not None:
                launches.append(launch)
        for stage in dict.fromkeys(launch.node.info.name for launch in launches):
            self._start([launch for launch in launches if launch.node.info.name == stage])

    def _prepare(self, node: Node, grant: Grant) -> Launch | None:
        """An attempt; None when what it reads has changed since the plan was made: then it is decided anew."""
        step = self._steps[node.label]
        request = build_request(self.planner, step, self.folder.id, grant)
        if self.planner.action(node).key != self._key(node):
            self.executor.give_back(grant)
            self._waiting.append(node)
            self._seen_results = (-1, -1)
            return None
        if step.reasons and step.reasons[0].kind == "damaged" and step.record is not None:
            self.workspace.objects.set_aside(node.info.name, step.record.digest)
        attempt = self.workspace.tmp / f"try-{self.folder.id}-{secrets.token_hex(4)}"
        return Launch(node, attempt, request, self.folder.log_path(node), grant)

    def _start(self, launches: list[Launch]) -> None:
        """Start attempts of one stage, or go on with those that an earlier run left at work."""
        fresh: list[Launch] = []
        for launch in launches:
            earlier = self.executor.reattach(launch)
            if earlier is None:
                fresh.append(launch)
                continue
            self._jobs[launch.node] = earlier
            self._tell(launch.node, {"event": "launched", "text": "goes on from an earlier run"})
        try:
            for launch in fresh:
                launch.attempt.mkdir(parents=True)
                write_json(launch.attempt / "request.json", launch.request)
            jobs = self.executor.start(fresh) if fresh else []
        except BadInput as error:
            for launch in fresh:
                self.executor.give_back(launch.grant)
                remove_tree(launch.attempt)
                self._refuse(launch.node, error)
            return
        for launch, job in zip(fresh, jobs, strict=True):
            self._jobs[launch.node] = job
            reasons = [r.as_json() for r in self._steps[launch.node.label].reasons]
            self._tell(launch.node, {"event": "launched", "reasons": reasons})

    def _refuse(self, node: Node, error: BadInput) -> None:
        """What a node reads has become unreadable under way: it fails, the others go on."""
        self.report.bad_input[node.label] = str(error)
        self._tell(node, {"event": "bad_input", "text": str(error)})

    def _made_meanwhile(self, node: Node) -> bool:
        """Whether the result has appeared since the plan was made; then it is a hit."""
        if node in self.planner.forced or not self.workspace.ledger.path(node.info.name, self._key(node)).exists():
            return False
        if self._steps[node.label].reasons[0].kind == "damaged":
            return False
        step = self.planner.decide(node)
        if step.status != HIT:
            return False
        self._ready.remove(node)
        self._steps[node.label] = step
        self._show_hit(step)
        return True

    # ------------------------------------------------------------------ collecting

    def _collect(self) -> None:
        for node, job in list(self._jobs.items()):
            outcome = job.poll()
            for event in job.events.read():
                job.watched.last_sign = time.monotonic()
                self._tell(node, {k: v for k, v in event.items() if k != "label"})
            if outcome is None:
                self._mind_silence(node, job)
                continue
            del self._jobs[node]
            self.executor.give_back(job.watched.grant)
            self._finish(node, job, outcome)
            remove_tree(job.watched.attempt)

    def _mind_silence(self, node: Node, job: Job) -> None:
        """Say so, once, when a worker has given no sign of life for long; only the user knows whether it hangs."""
        if not job.watched.told_silent and silent_after(job) > _SILENT_S:
            job.watched.told_silent = True
            text = f"no progress for {_SILENT_S / 60:.0f} min; `banmo log {node.label.replace('/', ' ')}` may tell why"
            self._tell(node, {"event": "silent", "text": text})

    def _finish(self, node: Node, job: Job, outcome: Outcome) -> None:
        seconds = round(time.monotonic() - job.watched.started, 2)
        note = self.workspace.attempts / f"{self._key(node)}.json"
        if outcome.status == "done":
            record = self.workspace.ledger.find(node.info.name, self._key(node))
            if record is None:
                outcome = Outcome("failed", "it said it was done but left no record")
            else:
                self.planner.finished(node, record)
                self.report.done.append(node.label)
                if record.warnings:
                    self.report.warnings[node.label] = list(record.warnings)
                note.unlink(missing_ok=True)
                self._result(node, record.digest)
        if outcome.status != "done":
            spent = seconds + job.watched.spent_s if outcome.status == "interrupted" else 0.0
            if outcome.status == "interrupted" and not self._stopping():
                outcome = Outcome("failed", outcome.message + " although nobody asked")
            write_json(
                note,
                {
                    "status": outcome.status,
                    "message": outcome.message,
                    "log": os.path.relpath(job.watched.log_path, self.workspace.root),
                    "label": node.label,
                    "spent_s": spent,
                    "time": time.time(),
                },
            )
            if outcome.status == "interrupted":
                self.report.interrupted.append(node.label)
            elif outcome.status == "bad_input":
                self.report.bad_input[node.label] = outcome.message
            else:
                self.report.failed[node.label] = outcome.message
            if self.fail_fast:
                self._ask_all_to_stop()
        log = os.path.relpath(job.watched.log_path, self.workspace.root)
        self._tell(node, {"event": outcome.status, "text": outcome.message, "seconds": seconds, "log": log})

    def _key(self, node: Node) -> str:
        step = self._steps[node.label]
        assert step.action is not None
        return step.action.key

    def _result(self, node: Node, digest: str) -> None:
        self.folder.link(node, digest)
        if self.on_result is not None:
            self.on_result(node)

    def _tell(self, node: Node, event: dict[str, Any]) -> None:
        self.folder.events({"label": node.label, **event})
        self.display.event(node.label, event)

    # ------------------------------------------------------------------ stopping

    def _stopping(self) -> bool:
        if self._signals:
            return True
        return self.fail_fast and bool(self.report.failed or self.report.bad_input)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        self._signals += 1
        self.report.stopped_by = self.report.stopped_by or number
        if number == signal.SIGHUP and self.executor.survives:
            self._left = True  # the terminal is gone, the jobs are not: the next run finds them
        elif self._signals == 1:
            self.display.event("", {"event": "stopping"})
            self._ask_all_to_stop()
        else:
            for job in self._jobs.values():
                job.kill()

    def _ask_all_to_stop(self) -> None:
        for job in self._jobs.values():
            job.ask_to_stop(self._grace_s)
