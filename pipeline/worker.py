"""Runs one action in one process: ``python -m pipeline.worker REQUEST.json``.

The request names the stage, its inputs, settings and scratch; the outcome is a file beside the request. Standard
input is a pipe from the parent: when it closes, the parent is gone and the worker stops. SIGTERM asks the stage to
stop; what it checkpointed stays. Exit status: 0 done, 1 failed, 2 the input is at fault, 75 stopped and resumable.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
import time
import traceback
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import Timeout

from pipeline.arguments import arguments
from pipeline.contract import Stage
from pipeline.describe import bind, load_stage
from pipeline.errors import (
    FULL,
    FULL_STATUS,
    BadInput,
    ExitCode,
    Interrupted,
    PipelineError,
    StageError,
    disk_full,
    printable,
)
from pipeline.events import EventWriter
from pipeline.files import failpoint, read_json, remove_tree, write_json
from pipeline.ledger import Record
from pipeline.locks import Patience
from pipeline.ranks import Ranks
from pipeline.running import Run
from pipeline.source import CodeReader
from pipeline.videos import state_of
from pipeline.workspace import Workspace

log = logging.getLogger("worker")


def main(argv: list[str]) -> int:
    """Run the request; returns the exit status."""
    request_path = Path(argv[0])
    request = read_json(request_path)
    if not isinstance(request, dict):
        sys.stderr.write(f"{request_path}: no request there\n")
        return ExitCode.USAGE
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname).1s %(message)s", datefmt="%H:%M:%S"
    )
    ranks = Ranks.from_environment()
    attempt = request_path.parent
    try:
        return Worker(request, attempt, ranks).run()
    except OSError as error:
        if error.errno not in FULL:
            raise
        _print_traceback()
        return FULL_STATUS


class Worker:
    """One attempt at one action, or one rank of it. `attempt` is the scratch folder of all its ranks."""

    def __init__(self, request: dict[str, Any], attempt: Path, ranks: Ranks | None = None) -> None:
        self.request, self.meeting = request, attempt
        self.ranks = ranks or Ranks()
        self.attempt = attempt / f"rank-{self.ranks.rank}" if self.ranks.rank else attempt
        self.attempt.mkdir(parents=True, exist_ok=True)
        self.workspace = Workspace(Path(request["workspace"]))
        self.events = EventWriter(attempt / "events.jsonl", {"label": request["label"]})
        self.context = Run(
            checkpoint_dir=self.workspace.checkpoints / request["key"],
            video=request["video"],
            videos=tuple(request["videos"]),
            device=request["device"],
            threads=request["threads"],
            rank=self.ranks.rank,
            world_size=self.ranks.world_size,
            sink=self.events,
            log=logging.getLogger(request["stage"]),
        )
        self.record: Record | None = None

    def run(self) -> int:
        """Run, write the outcome, return the exit status."""
        self._watch()
        if self.ranks.world_size > 1:
            node = os.environ.get("SLURMD_NODENAME") or socket.gethostname()
            log.info("rank %d of %d on %s", self.ranks.rank, self.ranks.world_size, node)
        with self.workspace.locks.at(self.attempt / "alive"):
            status, message, code = self._guarded()
            outcome = {
                "status": status,
                "message": message,
                "record": self.record.key if self.record else None,
                "warnings": self.context.warnings,
            }
            if code != ExitCode.DONE:
                remove_tree(self.attempt / "out")  # where the disk is full, this makes room to say so
            if self.attempt.is_dir():  # whoever waited for rank 0 may have cleared it away
                write_json(self.attempt / "outcome.json", outcome)
        return code

    def _guarded(self) -> tuple[str, str, int]:
        try:
            if self.ranks.rank:
                self._assist()
            else:
                self._run_leased()
            return "done", "", ExitCode.DONE
        except Interrupted:
            log.info("stopped on request; checkpoints are kept")
            return "interrupted", "stopped on request", ExitCode.INTERRUPTED
        except BadInput as error:
            log.error("%s", error)
            return "bad_input", str(error), ExitCode.USAGE
        except PipelineError as error:
            log.error("%s", error)
            return "failed", str(error), ExitCode.FAILED
        except OSError as error:
            if error.errno in FULL:
                text = str(disk_full(error.filename or self.workspace.root))
                log.error("%s", text)
                return "bad_input", text, ExitCode.USAGE
            return self._failure(error)
        except KeyboardInterrupt:
            return "interrupted", "stopped on request", ExitCode.INTERRUPTED
        except BaseException as error:
            return self._failure(error)

    def _failure(self, error: BaseException) -> tuple[str, str, int]:
        _print_traceback()
        last = traceback.format_exception_only(type(error), error)[-1].strip()
        return "failed", printable(last), ExitCode.FAILED

    # ------------------------------------------------------------------ the action

    def _run_leased(self) -> None:
        lease = self.workspace.lease(self.request["key"])
        told = False
        while True:
            try:
                lease.acquire(timeout=0.3)
                break
            except Timeout:
                if not told:
                    self.events({"event": "waiting", "text": "another run is making this; waiting for it"})
                    told = True
                if self.context.stop_requested:
                    raise Interrupted("stopped while waiting for another run") from None
        try:
            existing = self.workspace.ledger.find(self.request["stage"], self.request["key"])
            if existing is not None and self._serves(existing):
                log.info("another run has made this meanwhile")
                self.record = existing
                self.ranks.call(self.meeting, work=False)
                return
            self._make()
        finally:
            lease.release()

    def _serves(self, record: Record) -> bool:
        if record.finished == self.request["supersedes"]:
            return False  # this is the one that the user wants made again
        return self.workspace.objects.sound(record.stage, record.digest)

    def _assist(self) -> None:
        """A rank other than 0: run the stage with rank 0, and throw away what it writes."""
        if not self.ranks.follow(self.meeting, lambda: self.context.stop_requested):
            return
        out = self._fresh_out()
        found = load_stage(self.request["reference"])
        self._same_code()
        found.function(**bind(found, found.function, self._known(found, out)))
        remove_tree(out)

    def _fresh_out(self) -> Path:
        out = self.attempt / "out"
        remove_tree(out)  # of a launch of this attempt that was cut short and requeued
        out.mkdir()
        return out

    def _make(self) -> None:
        request = self.request
        started = datetime.now(UTC)
        clock = time.monotonic()
        self.events({"event": "started", "pid": os.getpid()})
        out = self._fresh_out()
        found = load_stage(request["reference"])
        self._same_code()
        self.ranks.call(self.meeting, work=True)
        known = self._known(found, out)
        found.function(**bind(found, found.function, known))
        for check in found.checks:
            check(**bind(found, check, known))
        self._same_sources()
        failpoint("before_publish")
        stored = self.workspace.objects.publish(request["stage"], out)
        self.record = Record(
            key=request["key"],
            stage=request["stage"],
            video=request["video"],
            action=request["action"],
            modules=request["modules"],
            digest=stored.digest,
            files=stored.files,
            bytes=stored.bytes,
            seconds=round(time.monotonic() - clock + request["spent_s"], 3),
            started=_stamp(started),
            finished=_stamp(datetime.now(UTC)),
            run=request["run"],
            metrics=self.context.metrics,
            warnings=self.context.warnings,
            host=socket.gethostname(),
            versions=_versions(),
        )
        self.workspace.ledger.write(self.record)
        remove_tree(self.workspace.checkpoints / request["key"])

    def _known(self, found: Stage, out: Path) -> dict[str, Any]:
        patience = Patience(float(self.request["latency_s"]) if self.workspace.is_far else 0.0)
        return arguments(self.request, found, patience) | {"out": out, "run": self.context}

    def _same_code(self) -> None:
        """Refuse to file the work of other code under this key."""
        package = Path(self.request["package_dir"])
        module = self.request["reference"].partition(":")[0]
        code = CodeReader(package).fingerprint(module, tuple(self.request["data"]))
        if code.digest != self.request["action"]["code"]:
            raise StageError("the code changed after the run was planned", hint="run again")

    def _same_sources(self) -> None:
        for source in self.request["sources"]:
            for path, before in source["states"].items():
                if state_of(Path(path)) != before:
                    raise BadInput(
                        "it changed while it was being read", where=path, hint="run again when it is complete"
                    )

    # ------------------------------------------------------------------ stopping

    def _watch(self) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2):  # the last two: a cluster's warnings
            signal.signal(number, lambda *_: self.context.request_stop())
        if self.request.get("watch_parent"):
            threading.Thread(target=self._watch_parent, daemon=True).start()

    def _watch_parent(self) -> None:
        """Standard input closes when the parent dies: stop cleanly, and at once when that takes too long."""
        try:
            while os.read(0, 1024):
                pass
        except OSError:
            pass
        self.context.request_stop()
        time.sleep(float(self.request["grace_s"]))
        log.error("the parent is gone and the stage does not stop; leaving")
        os._exit(ExitCode.INTERRUPTED)


def _print_traceback() -> None:
    """Into the log, which may lie on a full disk itself."""
    with contextlib.suppress(OSError):
        traceback.print_exc(file=sys.stderr)


def _stamp(moment: datetime) -> str:
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _versions() -> dict[str, str]:
    """Versions of Python and of the libraries this action has loaded."""
    found = {"python": sys.version.split()[0]}
    for name, module in sorted(sys.modules.items()):
        version = getattr(module, "__dict__", {}).get("__version__")  # asking the module itself may warn
        ours = "." in name or name.startswith("_") or name in sys.stdlib_module_names
        if not ours and isinstance(version, str):
            found[name] = version
    return found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
