"""Runs a plan: launches what is ready, collects what ends, decides what waited; keeps going past failures."""

from __future__ import annotations

import os
import secrets
import signal
import time
from collections.abc import Callable
from itertools import chain
from types import FrameType
from typing import Any

from pipeline.errors import BadInput
from pipeline.events import of_worker
from pipeline.executor import Executor, Grant, Job, Launch, Outcome, silent_after
from pipeline.files import remove_tree, write_json, write_memo
from pipeline.graph import Node
from pipeline.guard import needs_decision
from pipeline.ledger import Record
from pipeline.plan import HIT, RUN, WAIT, Planner, Step
from pipeline.request import build_request
from pipeline.runs import RunFolder
from pipeline.tally import Display, Report
from pipeline.waiting import Waiting

_POLL_S = 0.05
_SILENT_S = 600.0
_KILLED_S = 5.0


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
        self._waiting = Waiting(planner.graph, (s.node for s in steps if s.status == WAIT), planner.results)
        self._ready: dict[str, list[Node]] = {}  # by stage, in the order of the data
        self._jobs: dict[Node, Job] = {}
        self._stage_order = list(planner.graph.definition.stages)
        self._signals = 0
        self._left = False
        self._grace_s = planner.settings.execution.grace_s
        for step in steps:
            if step.status == HIT:
                self._show_hit(step)
            elif step.status == RUN:
                self._make_ready(step.node)

    def run(self) -> Report:
        """Work until nothing is left to do, or until stopped."""
        clock = time.monotonic()
        previous = {n: signal.signal(n, self._on_signal) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        try:
            while (self._jobs and not self._left) or (self._work_left() and not self._stopping()):
                self._decide_waiting()
                self._launch()
                self._collect()
                self.display.refresh()
                if not self._jobs and not any(self._ready.values()) and not self._waiting.free:
                    break
                time.sleep(_POLL_S)
        finally:
            if not self.executor.survives:
                for job in self._jobs.values():
                    _end(job)
            for number, handler in previous.items():
                signal.signal(number, handler)
        self.report.not_started = [n.label for n in (*chain(*self._ready.values()), *self._waiting)]
        self.report.seconds = time.monotonic() - clock
        return self.report

    def _work_left(self) -> bool:
        return any(self._ready.values()) or bool(self._waiting)

    # ------------------------------------------------------------------ deciding

    def _make_ready(self, node: Node) -> None:
        self._ready.setdefault(node.info.name, []).append(node)

    def _decide_waiting(self) -> None:
        """Decide the nodes whose inputs are known by now; a hit among them may free others."""
        while free := self._waiting.take_free():
            for node in free:
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
                    self._block(node, "a decision")
                else:
                    self._make_ready(node)

    def _block(self, node: Node, blocker: str) -> None:
        self.report.blocked[node.label] = blocker
        self._tell(node, {"event": "blocked", "text": blocker})
        self._lose(node)

    def _lose(self, node: Node) -> None:
        """There will be no result of this node: who waits for it waits in vain."""
        for reader, gone in self._waiting.lost(node.label):
            self.report.blocked[reader.label] = gone
            self._tell(reader, {"event": "blocked", "text": gone})

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
        for stage in [name for name in self._stage_order if self._ready.get(name)]:
            later: list[Node] = []
            queue = self._ready[stage]
            queue.reverse()
            while queue:
                grant = self.executor.take(queue[-1].info)
                if grant is None:
                    break
                node = queue.pop()
                launch = self._try(node, grant, busy, later)
                if launch is None:
                    self.executor.give_back(grant)
                else:
                    busy.add(self._key(node))
                    launches.append(launch)
            queue.reverse()
            self._ready[stage] = later + queue
        for stage in dict.fromkeys(launch.node.info.name for launch in launches):
            self._start([launch for launch in launches if launch.node.info.name == stage])

    def _try(self, node: Node, grant: Grant, busy: set[str], later: list[Node]) -> Launch | None:
        """An attempt at a ready node, or None when there is nothing to start for it now."""
        if self._key(node) in busy:
            later.append(node)  # the same action under another video's name
            return None
        if self._made_meanwhile(node):
            return None
        try:
            return self._prepare(node, grant)
        except BadInput as error:
            self._refuse(node, error)
            return None

    def _prepare(self, node: Node, grant: Grant) -> Launch | None:
        """An attempt; None when what it reads has changed since the plan was made: then it is decided anew."""
        step = self._steps[node.label]
        request = build_request(self.planner, step, self.folder.id, grant)
        if self.planner.action(node).key != self._key(node):
            self._waiting.add(node)
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
        self._lose(node)

    def _made_meanwhile(self, node: Node) -> bool:
        """Whether the result has appeared since the plan was made; then it is a hit."""
        if node in self.planner.forced or not self.workspace.ledger.path(node.info.name, self._key(node)).exists():
            return False
        if self._steps[node.label].reasons[0].kind == "damaged":
            return False
        step = self.planner.decide(node)
        if step.status != HIT:
            return False
        self._steps[node.label] = step
        self._show_hit(step)
        return True

    # ------------------------------------------------------------------ collecting

    def _collect(self) -> None:
        for node, job in list(self._jobs.items()):
            outcome = job.poll()
            for event in map(of_worker, job.events.read()):
                job.watched.last_sign = time.monotonic()
                self._tell(node, event)
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
            record = self._record_of(node)
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
            write_memo(
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
            self._lose(node)
            if self.fail_fast:
                self._ask_all_to_stop()
        log = os.path.relpath(job.watched.log_path, self.workspace.root)
        self._tell(node, {"event": outcome.status, "text": outcome.message, "seconds": seconds, "log": log})

    def _record_of(self, node: Node) -> Record | None:
        """The record that a worker has written; from another machine it may show up late."""
        stage, key = node.info.name, self._key(node)
        if self.workspace.is_far:
            self.planner.patience.until(lambda: self.workspace.ledger.find(stage, key) is not None)
        return self.workspace.ledger.find(stage, key)

    def _key(self, node: Node) -> str:
        step = self._steps[node.label]
        assert step.action is not None
        return step.action.key

    def _result(self, node: Node, digest: str) -> None:
        self._waiting.result(node.label)
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


def _end(job: Job) -> None:
    """Kill what still runs when the run breaks off, wait for its end, and clear its scratch away."""
    job.kill()
    deadline = time.monotonic() + _KILLED_S
    while job.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    remove_tree(job.watched.attempt)
