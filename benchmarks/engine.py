"""What the engine itself costs, without any vision: ``python -m benchmarks.engine [--videos 1000] [--actions 100000]``.

Prints, from one run (seconds on the clock, and of the processor, for neighbours may slow the clock): the no-op run of a
finished workspace (time and memory of a process of its own), the plan of many actions of which none has run, and
publishing a folder of many files against copying and hashing the same files.
The pipeline is the toy of the engine's tests: three results a video of three small files each, two for all.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any
from unittest import mock

from pipeline.contract import Folder, Given, Source
from pipeline.describe import bind, build, settings_class
from pipeline.files import flush, remove_tree, sha256_file
from pipeline.graph import Node
from pipeline.ledger import Record
from pipeline.objects import Objects, walk
from pipeline.plan import Planner
from pipeline.project import Options, Project
from pipeline.running import Run
from pipeline.settings import stage_values

TOY = Path(__file__).resolve().parent.parent / "tests" / "engine" / "toy"


def main(argv: list[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.engine", description=__doc__)
    parser.add_argument("--videos", type=int, default=1000)
    parser.add_argument("--actions", type=int, default=100_000)
    parser.add_argument("--files", type=int, default=3000)
    parser.add_argument("--bytes", type=int, default=200_000, help="size of each published file")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as the engine sets it for its workers
    with tempfile.TemporaryDirectory(prefix="banmo-engine-") as scratch:
        root = Path(scratch)
        shutil.copytree(TOY, root / "toy", ignore=shutil.ignore_patterns("__pycache__"))
        sys.path.insert(0, str(root))
        found = {
            "no_op": measure_no_op(root, args.videos, args.repeats),
            "plan": measure_plan(root, args.actions),
            "publish": measure_publish(root / "publish", args.files, args.bytes, args.repeats),
        }
    if args.json:
        sys.stdout.write(json.dumps(found, indent=1) + "\n")
        return 0
    for name, facts in found.items():
        words = "  ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in facts.items())
        sys.stdout.write(f"{name:<8} {words}\n")
    return 0


def measure_no_op(root: Path, videos: int, repeats: int) -> dict[str, Any]:
    """Seconds and peak memory of ``banmo run`` with nothing to do, Python's start included; the best of `repeats`."""
    options = _options(root / "noop", root / "toy", videos)
    with redirect_stdout(StringIO()):
        results = fill(options)
    command = [sys.executable, "-m", "pipeline.cli", "run", "--workspace", str(options.workspace)]
    command += ["--definition", str(root / "toy"), str(options.videos)]
    measured = (
        "import resource, subprocess, sys, time; clock = time.monotonic();"
        "told = subprocess.run(sys.argv[1:], check=True, capture_output=True, text=True).stdout;"
        "assert 'everything is up to date' in told, told[-500:];"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN);"
        "print(time.monotonic() - clock, used.ru_utime + used.ru_stime, used.ru_maxrss / 1000)"
    )
    rows = []
    for _ in range(repeats + 1):  # the first hashes what it has not seen and fills the memos
        child = subprocess.run([sys.executable, "-c", measured, *command], capture_output=True, text=True, check=True)
        rows.append([float(word) for word in child.stdout.split()])
    seconds, cpu, peak = zip(*rows, strict=True)
    return {
        "videos": videos,
        "results": results,
        "seconds": min(seconds[1:]),
        "cpu_seconds": min(cpu[1:]),
        "first_seconds": seconds[0],
        "peak_mb": max(peak),
    }


def measure_plan(root: Path, actions: int) -> dict[str, Any]:
    """Seconds and memory to plan so many actions of which none has run, in this process."""
    options = _options(root / "plan", root / "toy", (actions - 2 + 2) // 3)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    clock, used = time.monotonic(), time.process_time()
    project = Project.open(options, create=True)
    planner = project.planner()
    steps = planner.plan(project.graph.nodes)
    seconds, cpu = time.monotonic() - clock, time.process_time() - used
    clock = time.monotonic()
    project.planner().plan(project.graph.nodes)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return {
        "actions": len(steps),
        "seconds": seconds,
        "cpu_seconds": cpu,
        "again_seconds": time.monotonic() - clock,
        "bytes_an_action": 1024 * grown / len(steps),
    }


def measure_publish(root: Path, files: int, size: int, repeats: int) -> dict[str, Any]:
    """Publishing a folder against copying and hashing the same files; medians of `repeats`, in turns within one run.

    A publication ends on the disk, a copy in memory, so there are two fair comparisons: publishing what lies there
    against copying and hashing it; and copying and publishing against copying, hashing and flushing.
    """
    source = root / "source"
    source.mkdir(parents=True)
    for i in range(files):
        (source / f"{i:05d}.bin").write_bytes(os.urandom(size))
    flush(root)
    times: dict[str, list[float]] = {name: [] for name in ("copy", "hash", "flush", "copy_again", "publish")}
    for i in range(repeats):
        copy, scratch = root / f"copy-{i}", root / f"scratch-{i}"
        store = Objects(root / f"store-{i}", seen=root / f"seen-{i}", tmp=root / f"tmp-{i}")
        by_hand = (("copy", lambda to=copy: _copy(source, to)), ("hash", lambda to=copy: _hash(to)),
                   ("flush", lambda: flush(root)))  # fmt: skip
        ours = (("copy_again", lambda to=scratch: _copy(source, to)),
                ("publish", lambda to=scratch, into=store: into.publish("frames", to)))  # fmt: skip
        for steps in (by_hand, ours) if i % 2 else (ours, by_hand):  # who comes second finds a busier disk
            for name, step in steps:
                times[name].append(_timed(step))
            flush(root)
        for path in (copy, store.root):
            remove_tree(path)
        flush(root)
    rounds = [dict(zip(times, row, strict=True)) for row in zip(*times.values(), strict=True)]
    plain = [t["publish"] / (t["copy"] + t["hash"]) for t in rounds]
    durable = [(t["copy_again"] + t["publish"]) / (t["copy"] + t["hash"] + t["flush"]) for t in rounds]
    return {
        "files": files,
        "bytes": files * size,
        **{f"{name}_seconds": statistics.median(values) for name, values in times.items()},
        "publish_over_copy_and_hash": statistics.median(plain),
        "copy_and_publish_over_copy_hash_and_flush": statistics.median(durable),
        "rounds": repeats,
    }


def fill(options: Options) -> int:
    """Finish a workspace of the toy pipeline within this process, without workers; returns the number of results."""
    project = Project.open(options, create=True)
    planner = project.planner()
    clock = time.time()
    with mock.patch("pipeline.objects.flush"), mock.patch("os.fsync"):  # durability is not what is measured here
        for node in project.graph.nodes:
            step = planner.decide(node)
            assert step.action is not None and node.info.code is not None
            out = project.workspace.tmp / "out"
            out.mkdir(parents=True)
            _call(project, planner, node, out)
            stored = project.workspace.objects.publish(node.info.name, out)
            record = Record(
                key=step.action.key, stage=node.info.name, video=node.video_name, action=step.action.text,
                modules=node.info.code.modules, digest=stored.digest, files=stored.files, bytes=stored.bytes,
                seconds=0.0, started=_stamp(clock), finished=_stamp(clock), run="benchmark",
            )  # fmt: skip
            project.workspace.ledger.write(record)
            planner.finished(node, record)
    project.workspace.remember(project.remembered)
    return len(planner.results)


def _call(project: Project, planner: Planner, node: Node, out: Path) -> None:
    module, _, name = node.info.reference.partition(":")
    stage = getattr(importlib.import_module(module), name)
    known: dict[str, Any] = {"out": out, "run": Run(video=node.video_name, checkpoint_dir=out.parent / "checkpoint")}
    for source, nodes in project.graph.inputs(node).items():
        folders = {
            n.video_name: Folder(project.workspace.objects.path(source, planner.results[n.label].digest)) for n in nodes
        }
        many = node.video is None and nodes[0].video is not None
        known[source] = folders if many else next(iter(folders.values()))
    if node.video is not None:
        known |= {"video": Source(node.video.path, node.video.name), "given": Given()}
    kind = settings_class(stage)
    if kind is not None:
        known["settings"] = build(kind, stage_values(project.settings, node.info))
    with redirect_stdout(StringIO()):
        stage.function(**bind(stage, stage.function, known))
    remove_tree(out.parent / "checkpoint")


def _options(root: Path, package: Path, videos: int) -> Options:
    clips = root / "clips"
    clips.mkdir(parents=True)
    for i in range(videos):
        (clips / f"clip-{i:06d}.mp4").write_text(f"clip {i}")
    return Options(workspace=root / "w", definition=str(package), videos=clips)


def _copy(source: Path, target: Path) -> None:
    target.mkdir(parents=True)
    for name, path, _ in walk(source):
        shutil.copyfile(path, target / name)


def _hash(folder: Path) -> None:
    for _, path, _ in walk(folder):
        sha256_file(path)


def _timed(work: Callable[[], object]) -> float:
    clock = time.monotonic()
    work()
    return time.monotonic() - clock


def _stamp(seconds: float) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S.000Z", time.gmtime(seconds))


if __name__ == "__main__":
    sys.exit(main())
