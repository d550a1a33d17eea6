"""Executor for a Slurm cluster, through submitit (extra ``slurm``).

Actions of one stage that are ready together become one job array; each element asks for the cores and GPUs that the
stage declares. A distributed stage becomes one job of several tasks. The workspace must lie on a disk that every node
sees. Jobs outlive the run that submitted them: ``jobs/<key>.json`` names the job of an action, and the next run goes
on with it. Interrupting a run cancels its jobs; a closed terminal does not.

How a job ended is read from the worker's own outcome file first, then from the queue: accounting may be absent.
submitit pickles what it submits; that is one class of ours holding one path (:mod:`pipeline.slurm_job`), written here
and read by the job within seconds. Nothing that came from elsewhere is unpickled.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import shlex
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

from pipeline.definition import StageInfo, child_environment
from pipeline.errors import BadInput
from pipeline.executor import (
    Grant,
    Job,
    Launch,
    Outcome,
    Watched,
    event_reader,
    fault_of_a_rank,
    read_outcome,
)
from pipeline.files import read_json, remove_tree, write_json
from pipeline.settings import ExecutionSection
from pipeline.slurm_queue import Queue
from pipeline.workspace import Workspace

ALL_CORES = 8
"""Cores for a stage that takes all there are, where ``[execution] cpus`` does not say."""
_SIGNAL_S = 120
_LATENCY_S = 30.0
_MOST_REQUEUES = 100  # each time limit counts, and preemption too where limits are short


class SlurmExecutor:
    """Submits actions, and finds those that earlier runs submitted."""

    survives = True

    def __init__(self, workspace: Workspace, execution: ExecutionSection, run_dir: Path) -> None:
        """Raises BadInput when this is no Slurm login, or submitit is not installed."""
        if shutil.which("sbatch") is None or shutil.which("srun") is None:
            raise BadInput("there is no Slurm on this machine (no sbatch)", hint="--execution.executor local")
        if "%" in str(workspace.root):
            raise BadInput("Slurm cannot write to a path with a % in it", where=workspace.root)
        self._submitit = _submitit()
        self._workspace, self._execution, self._run_dir = workspace, execution, run_dir
        self._queue = Queue()
        sweep(workspace, self._queue)

    def take(self, info: StageInfo) -> Grant | None:
        """What the stage asks for; the cluster queues what has no room yet."""
        wanted = self._execution
        ranks = max(1, wanted.ranks) if info.distributed else 1
        cpus = info.cpus or wanted.cpus or ALL_CORES
        gpus = info.gpus if wanted.gpus < 0 else min(info.gpus, wanted.gpus)
        return Grant(cpus * ranks, ("granted by Slurm",) * (gpus * ranks), ranks)

    def give_back(self, grant: Grant) -> None:
        """Nothing is kept count of here."""

    def start(self, launches: list[Launch]) -> list[Job]:
        """Submit attempts of one stage: one job, or one array."""
        from pipeline.slurm_job import RunRequest

        first = launches[0]
        folder = self._run_dir / "slurm" / "%j"
        ranks, nodes = first.grant.ranks, min(max(1, self._execution.nodes), first.grant.ranks)
        if ranks % nodes:
            raise BadInput(f"{ranks} ranks cannot be spread evenly over {nodes} nodes", where="[execution]")
        requests = [RunRequest(str(x.attempt / "request.json"), str(x.log_path.absolute())) for x in launches]
        try:
            with _own_environment(), contextlib.redirect_stderr(io.StringIO()):  # submitit repeats sbatch's words
                executor = self._submitit.AutoExecutor(
                    folder=folder, cluster="slurm", slurm_max_num_timeout=_MOST_REQUEUES
                )
                executor.update_parameters(**self._parameters(first, nodes))
                jobs = executor.submit_array(requests) if len(requests) > 1 else [executor.submit(requests[0])]
        except (RuntimeError, OSError, subprocess.SubprocessError) as error:
            raise BadInput(f"Slurm refused {first.node.info.name}: {_last_line(error)}") from error
        except self._submitit.core.utils.FailedJobError as error:
            raise BadInput(f"Slurm refused {first.node.info.name}: {_last_line(error)}") from error
        found: list[Job] = []
        for launch, job in zip(launches, jobs, strict=True):
            note = {"job": str(job.job_id), "attempt": launch.attempt.name, "log": str(launch.log_path)}
            write_json(self._note(launch.request["key"]), note)
            found.append(SlurmJob(Watched.of(launch), str(job.job_id), self._note(launch.request["key"]), self._queue))
        return found

    def reattach(self, launch: Launch) -> Job | None:
        """The job that an earlier run submitted for this action, if it still waits or runs."""
        path = self._note(launch.request["key"])
        note = read_note(path)
        if note is None:
            return None
        attempt = self._workspace.tmp / note["attempt"]
        if not attempt.is_dir() or not self._queue.is_there(note["job"]):
            return None
        watched = Watched.of(launch)
        watched.attempt, watched.log_path = attempt, Path(note["log"])
        return SlurmJob(watched, note["job"], path, self._queue)

    def _note(self, key: str) -> Path:
        return self._workspace.jobs / f"{key}.json"

    def _parameters(self, launch: Launch, nodes: int) -> dict[str, Any]:
        wanted, info, grant = self._execution, launch.node.info, launch.grant
        per_node = grant.ranks // nodes
        package = Path(launch.request["package_dir"])
        python_path = child_environment(package)["PYTHONPATH"]
        found: dict[str, Any] = {
            "name": f"banmo-{info.name}",
            "nodes": nodes,
            "tasks_per_node": per_node,
            "cpus_per_task": grant.threads,
            "timeout_min": max(1, wanted.slurm_time_limit_min),
            "slurm_signal_delay_s": _SIGNAL_S,
            "slurm_array_parallelism": max(1, wanted.slurm_parallel),
            "slurm_setup": [f"export PYTHONPATH={shlex.quote(python_path)}"],
            "slurm_srun_args": ["--kill-on-bad-exit=1", f"--cpus-per-task={grant.threads}"],
            "slurm_additional_parameters": {"requeue": True},
        }
        if grant.gpus:
            found["gpus_per_node"] = len(grant.gpus) // grant.ranks * per_node
        if wanted.slurm_memory_gb > 0:
            found["mem_gb"] = wanted.slurm_memory_gb
        for name in ("partition", "account", "qos"):
            value = getattr(wanted, f"slurm_{name}")
            if value:
                found[f"slurm_{name}"] = value
        return found


class SlurmJob:
    """One submitted attempt."""

    def __init__(self, watched: Watched, job_id: str, note: Path, queue: Queue) -> None:
        self.watched, self.events = watched, self
        self.job_id = job_id
        self._note, self._queue = note, queue
        self._reader = event_reader(watched.attempt)
        self._stop_by: float | None = None
        self._gone_since: float | None = None
        self._told = ""
        self._notes: list[dict[str, Any]] = []

    def read(self) -> list[dict[str, Any]]:
        """New events of the worker, and of the queue."""
        notes, self._notes = self._notes, []
        return notes + self._reader.read()

    def poll(self) -> Outcome | None:
        """The worker's own word first; then what the queue says."""
        outcome = read_outcome(self.watched.attempt)
        state = self._queue.state(self.job_id)
        if outcome is not None and outcome.status != "interrupted":
            others = self.watched.grant.ranks > 1 and state is not None and not state.ended
            return None if others and self._late() else self._ended(outcome)  # the other ranks still write there
        self._tell(state)
        if state is not None and not state.ended:
            self._gone_since = None
            if self._stop_by is not None and time.monotonic() > self._stop_by:
                self.kill()
            return None
        # A job that is being requeued shows as failed for a moment; one that was cancelled does not come again.
        returns = outcome is not None and self._stop_by is None and state is not None and state.may_return
        if (outcome is None or returns) and self._late():
            return None
        if outcome is None:
            how = f" ({self._told})" if self._told else ""
            fault = fault_of_a_rank(self.watched.attempt) or f"its Slurm job {self.job_id} ended{how}"
            outcome = Outcome("interrupted" if self._stop_by is not None else "failed", fault)
        return self._ended(outcome)

    def ask_to_stop(self, grace_s: float) -> None:
        """Cancel it when it waits; let it save and end when it runs."""
        if self._stop_by is not None:
            return
        self._stop_by = time.monotonic() + grace_s
        with contextlib.suppress(OSError):
            (self.watched.attempt / "stop").touch()  # tells the job that this is no preemption
        state = self._queue.state(self.job_id)
        if state is not None and state.name == "RUNNING":
            self._queue.signal(self.job_id, "TERM")
        else:
            self._queue.cancel(self.job_id)

    def kill(self) -> None:
        """Cancel it."""
        if self._stop_by is None:
            self._stop_by = time.monotonic()
        self._queue.cancel(self.job_id)

    def _late(self) -> bool:
        """A network disk may show the outcome later than the queue shows the end."""
        now = time.monotonic()
        self._gone_since = self._gone_since or now
        return now - self._gone_since < (_LATENCY_S if self._stop_by is None else 1.0)

    def _ended(self, outcome: Outcome) -> Outcome:
        self._note.unlink(missing_ok=True)
        return outcome

    def _tell(self, state: Any) -> None:
        if state is None:
            return
        if state.name != "RUNNING":
            self.watched.last_sign = time.monotonic()  # waiting in a queue is no silence
        text = state.name if state.name == "RUNNING" else f"{state.name}, {state.reason}".rstrip(", ")
        if text != self._told and state.name != "COMPLETING":
            self._told = text
            self._notes.append({"event": "waiting", "text": f"Slurm job {self.job_id}: {text.lower()}"})


def read_note(path: Path) -> dict[str, str] | None:
    """The job of an action, None when there is none or the file is damaged."""
    note = read_json(path)
    if not isinstance(note, dict) or not all(isinstance(note.get(k), str) for k in ("job", "attempt", "log")):
        return None
    plain = note["attempt"].startswith("try-") and "/" not in note["attempt"]
    return note if plain and note["job"].replace("_", "").isdigit() else None


def sweep(workspace: Workspace, queue: Queue) -> None:
    """Forget jobs that have ended while nobody watched, and remove their scratch."""
    for path in sorted(workspace.jobs.glob("*.json")) if workspace.jobs.is_dir() else []:
        note = read_note(path)
        if note is not None:
            attempt = workspace.tmp / note["attempt"]
            outcome = read_outcome(attempt)
            final = outcome is not None and outcome.status != "interrupted"
            state = queue.state(note["job"])
            comes = state is not None and (not state.ended or (outcome is not None and state.may_return))
            if attempt.is_dir() and not final and comes:
                continue
            remove_tree(attempt)
        path.unlink(missing_ok=True)


def _submitit() -> Any:
    try:
        import submitit
        import submitit.helpers
    except ImportError as error:
        raise BadInput("running on Slurm needs submitit", hint="pip install 'banmo-pipeline[slurm]'") from error
    logging.getLogger("submitit").setLevel(logging.WARNING)
    return submitit


@contextlib.contextmanager
def _own_environment() -> Any:
    """sbatch copies the environment of whoever calls it: leave out what belongs to another job or launch."""
    kept = dict(os.environ)
    for name in kept:
        foreign = name.startswith(("SLURM_", "SBATCH_")) and name != "SLURM_CONF"
        if foreign or name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
            del os.environ[name]
    try:
        yield
    finally:
        os.environ.update(kept)


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    told = [line for line in lines if line.startswith("sbatch: error:")]
    return (told or lines or [type(error).__name__])[0].removeprefix("sbatch: error: ")
