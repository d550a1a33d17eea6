"""Every reader of foreign files against damaged input: it answers or says what is wrong, quickly, and nothing else.

``make fuzz`` gives each reader 100,000 inputs (BANMO_FUZZ) within BANMO_FUZZ_MINUTES for each, and prints what it saw;
BANMO_FUZZ_SEED draws others. A failing input is printed with its reader, so that it can become a test of its own.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import random
import resource
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.cli import split_overrides
from pipeline.console import PlainDisplay, progress_text
from pipeline.definition import Definition, StageInfo
from pipeline.errors import BadInput
from pipeline.events import EventReader, of_worker
from pipeline.executor import read_outcome
from pipeline.ledger import Ledger
from pipeline.locks import Locks
from pipeline.objects import Objects, digest_of, parse_manifest
from pipeline.remote import safe
from pipeline.settings import resolve
from pipeline.slurm import read_note
from pipeline.slurm_queue import parse_squeue
from tests.fuzz.mutations import mutate

COUNT = int(os.environ.get("BANMO_FUZZ", "300"))
MINUTES = float(os.environ.get("BANMO_FUZZ_MINUTES", "5"))
SEED = int(os.environ.get("BANMO_FUZZ_SEED", "0"))
HANG_S = 10.0
MOST_BYTES = 6 << 30


@dataclass(frozen=True)
class Reader:
    """A reader: what it makes of a file, samples of what is valid, and the errors in which it says no."""

    read: Callable[[Path], Any]
    samples: list[bytes]
    says_no: tuple[type[Exception], ...]
    suffix: str = ".txt"


class Hang(BaseException):
    """It took more processor time than any input may."""


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Limits on memory, and on the processor's time for one input (set anew by `signal.setitimer`)."""

    def ring(*_: object) -> None:
        raise Hang

    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGVTALRM, ring)
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, before[1]))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


def field(name: str, kind: dict[str, Any], default: Any) -> dict[str, Any]:
    return {"name": name, "type": kind, "default": default, "help": ""}


def definition() -> Definition:
    """A pipeline of one stage with a setting of every type."""
    fields = (
        field("count", {"kind": "int"}, 3),
        field("share", {"kind": "float"}, 0.5),
        field("on", {"kind": "bool"}, True),
        field("name", {"kind": "str"}, ""),
        field("table", {"kind": "file"}, ""),
        field("way", {"kind": "choice", "choices": ["a", "b"]}, "a"),
        field("maybe", {"kind": "optional", "item": {"kind": "int"}}, None),
        field("many", {"kind": "list", "item": {"kind": "float"}}, []),
        field("pair", {"kind": "tuple", "items": [{"kind": "int"}, {"kind": "str"}]}, [1, "x"]),
        field("deep.er", {"kind": "int"}, 1),
    )
    return Definition(Path("/nowhere"), {"s": StageInfo("s", "m:s", None, fields=fields)}, {}, {"p": {}}, None)


SETTINGS = b"""[pipeline]
salt = "x"
skip_videos = ["a", "b"]
[execution]
cpus = 2
[s]
count = 4
share = 0.25
on = false
name = "n"
table = "some/file"
way = "b"
maybe = 3
many = [1, 2.5]
pair = [2, "y"]
[s.deep]
er = 5
"""

BVH = b"""HIERARCHY
ROOT hips
{
  OFFSET 0 1 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT knee
  {
    OFFSET 0 -0.5 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -0.5 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.033
0 1 0 0 0 0 10 0 0
0 1 0 0 5 0 20 0 0
"""

HINTS = b"""[[hint]]
frame = 0
box = [2, 2, 20, 15]
[[hint]]
time_s = 0.05
inside = [[5, 5], [6, 7]]
outside = [[1, 1]]
"""

CONTRACT = b'size = [256, 256]\nmean = [0.5, 0.5, 0.5]\nstd = [0.5, 0.5, 0.5]\nlayout = "nchw"\nchannels = "rgb"\n'


def matrices(count: int) -> list[Any]:
    return [[[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 3.0], [0, 0, 0, 1]] for i in range(count)]


POSES = json.dumps({"K": [[50, 0, 16], [0, 50, 12], [0, 0, 1]], "object_to_camera": matrices(3)}).encode()


OTHER_INTRINSICS = [
    json.dumps({"intrinsics": way, "object_to_camera": matrices(3)}).encode()
    for way in ({"fx": 50, "fy": 49.5, "cx": 16, "cy": 12}, [50, 50, 16, 12], [[50, 0, 16], [0, 50, 12], [0, 0, 1]])
]


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    """A folder in memory where there is one: the inputs are many and small."""
    import shutil
    import tempfile

    memory = Path("/dev/shm")
    root = Path(tempfile.mkdtemp(prefix="banmo-fuzz-", dir=memory if os.access(memory, os.W_OK) else None))
    (root / "frames.json").write_text('{"source_width": 32, "source_height": 24, "frames": []}')
    yield root
    shutil.rmtree(root)


def clip(root: Path) -> Any:
    """Just as much of a clip as readers of what lies beside it ask for."""
    times = np.arange(3) / 30
    names = ["0", "1", "2"]
    return SimpleNamespace(
        root=root, width=32, height=24, source_idx=np.arange(3), time_s=times, source_time_s=times, names=names
    )


def png() -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.arange(24 * 32, dtype=np.uint8).reshape(24, 32)).save(stream, "PNG")
    return stream.getvalue()


def glb() -> bytes:
    import trimesh

    found: bytes = trimesh.creation.box().export(file_type="glb")
    return found


def onnx_model() -> bytes:
    onnx = pytest.importorskip("onnx")
    weight = onnx.helper.make_tensor("w", onnx.TensorProto.FLOAT, [2, 2], [1.0, 2.0, 3.0, 4.0])
    tensors = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, [2, 2]) for n in "xy"]
    node = onnx.helper.make_node("MatMul", ["x", "w"], ["y"])
    graph = onnx.helper.make_graph([node], "g", tensors[:1], tensors[1:], [weight])
    found: bytes = onnx.helper.make_model(graph).SerializeToString()
    return found


def record_sample(root: Path) -> bytes:
    from dataclasses import asdict

    from pipeline.action import action
    from pipeline.ledger import Record

    made = action(stage="s", version=1, code="c", settings={"a": 1.5, "b": ["x"]}, inputs={"i": "d" * 64})
    stamp = "2026-01-01T00:00:00Z"
    record = Record(made.key, "s", "cat", made.text, {"m": "h"}, "e" * 64, 2, 10, 1.5, stamp, stamp, "r")
    (root / "actions" / "s").mkdir(parents=True, exist_ok=True)
    return json.dumps(asdict(record)).encode()


def named(module: str, name: str) -> Any:
    """Something of a stage's module; the reader is skipped where that is not there."""
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        pytest.skip(f"no {module}.{name} ({error})")


def read_settings(path: Path) -> Any:
    found = resolve(definition(), path, [])
    assert set(found.values) == {"pipeline", "execution", "store", "s"}
    return found


def read_words(path: Path) -> Any:
    words = [w for w in path.read_bytes().decode("utf-8", "surrogateescape").split("\n") if "\0" not in w]
    rest, overrides = split_overrides(words)
    assert all(isinstance(w, str) for w in rest)
    return resolve(definition(), None, overrides)


def read_record(path: Path) -> Any:
    """A record is served under its own key only."""
    data = path.read_bytes()
    key = json.loads(record_sample(path.parent))["key"]
    target = path.parent / "actions" / "s" / f"{key}.json"
    target.write_bytes(data)
    record = Ledger(path.parent / "actions").find("s", key)
    if record is not None:
        assert record.key == key and record.stage == "s" and len(record.digest) == 64 and record.label
    return record


def read_manifest(path: Path) -> Any:
    """A seal with other content than its name is damage, and its names never lead out of the folder."""
    data = path.read_bytes()
    entries = parse_manifest(data.decode("utf-8", "replace"))
    store = Objects(path.parent / "objects", seen=path.parent / "seen", tmp=path.parent / "tmp")
    digest = digest_of(MANIFEST.decode())
    (path.parent / "objects" / "s" / digest).mkdir(parents=True, exist_ok=True)
    store.seal_path("s", digest).write_bytes(data)
    assert store.deep_check("s", digest), "its files are not there"
    for name in entries or {}:
        assert not safe(name) or not (Path("/folder") / name).is_relative_to("/folder/..")
    return entries


def read_events(path: Path) -> Any:
    """Whatever a worker writes into its events, displays show one plain line of it."""
    found = [of_worker(event) for event in EventReader(path).read()]
    screen = io.StringIO()
    display = PlainDisplay(screen, interval_s=0.0)
    for event in found:
        display.event("words/cat", event)
        progress_text(event)
    assert all(c.isprintable() or c == "\n" for c in screen.getvalue())
    return found


def read_outcome_file(path: Path) -> Any:
    (path.parent / "outcome.json").write_bytes(path.read_bytes())
    found = read_outcome(path.parent)
    assert found is None or found.status in ("done", "failed", "bad_input", "interrupted")
    return found


def read_job(path: Path) -> Any:
    """The number of a job goes to Slurm's commands, its attempt becomes a path."""
    note = read_note(path)
    assert note is None or ("/" not in note["attempt"] and note["job"].replace("_", "").isdigit())
    return note


def read_locks(path: Path) -> Any:
    folder = path.parent / "leases"
    folder.mkdir(exist_ok=True)
    (folder / "kind").write_bytes(path.read_bytes())
    found = Locks.of(folder, path.parent)
    assert found.kind in ("kernel", "expiring") and 0 < found.expire_s <= 3600
    return found


MANIFEST = b"".join(b"%064x  inner/%d.txt\n" % (i, i) for i in range(3))
EVENTS = b'{"event": "progress", "done": 3, "total": 9}\n{"event": "done", "label": "a"}\n'
OF_WORKERS = (
    b'{"event": "started", "pid": 7}\n{"event": "progress", "done": 1.5, "total": null, "what": "x",'
    b' "extra": {"loss": 0.3, "n": 4, "s": "t"}}\n{"event": "warning", "text": "w"}\n'
    b'{"event": "waiting", "text": "q"}\n'
)
OUTCOME = b'{"status": "done", "message": "", "record": "%064x", "warnings": ["a", "b"]}' % 7
JOB = b'{"job": "13_4", "attempt": "try-2026-01-01T00-00-00-abcd-01234567", "log": "/w/runs/r/logs/x.txt"}'
SQUEUE = b"12|RUNNING|None\n13_4|PENDING|Resources\n13_[5-9]|PENDING|Priority\n"
WORDS = b"run\n--s.count\n4\n--set\ns.share=0.2\n--s.many=1,2\n--s.pair\n[3, 'z']\nclips\n--s.on\n--\n--s.x\n"


def reader_of(name: str, root: Path) -> Reader:
    """The reader of this name."""
    if name == "settings":
        return Reader(read_settings, [SETTINGS], (BadInput,), ".toml")
    if name == "command line":
        return Reader(read_words, [WORDS], (BadInput,))
    if name == "records":
        return Reader(read_record, [record_sample(root)], (), ".json")
    if name == "manifests":
        return Reader(read_manifest, [MANIFEST], ())
    if name == "events":
        return Reader(read_events, [EVENTS, OF_WORKERS], ())
    if name == "outcomes":
        return Reader(read_outcome_file, [OUTCOME], ())
    if name == "jobs":
        return Reader(read_job, [JOB], (), ".json")
    if name == "locks":
        return Reader(read_locks, [b"expiring 60\n", b"kernel 0.5\n"], ())
    if name == "queue":
        return Reader(lambda p: parse_squeue(p.read_bytes().decode("utf-8", "replace")), [SQUEUE], ())
    if name == "given poses":
        read = named("stages.poses", "read_given")
        return Reader(lambda p: read(p, clip(p.parent)), [POSES, *OTHER_INTRINSICS], (BadInput,), ".json")
    if name == "stored poses":
        formats = importlib.import_module("stages.formats")
        return Reader(formats.read_poses, [POSES], (formats.FormatError,), ".json")
    if name == "hints":
        read = named("stages.masks", "read_hints")
        return Reader(lambda p: read(p, clip(p.parent)), [HINTS], (BadInput,), ".toml")
    if name == "masks":
        return Reader(named("stages.decoding", "load_image"), [png()], (BadInput,), ".png")
    if name == "glb":
        read, error = named("stages.animating.glb", "read_glb"), named("stages.animating.glb", "GlbError")
        return Reader(lambda p: read(p.read_bytes()), [glb()], (error,), ".glb")
    if name == "bvh":
        read, error = named("stages.animating.bvh", "read_bvh"), named("stages.animating.bvh", "BvhError")
        return Reader(lambda p: read(p.read_bytes().decode("utf-8", "replace")), [BVH], (error,), ".bvh")
    if name == "camera paths":
        read, error = named("stages.rendering.paths", "parse_path"), named("stages.rendering.paths", "PathError")
        text = b'{"keys": [{"time_s": 0, "position": [0, 1, 3]}, {"time_s": 1, "position": [1, 1, 3]}]}'
        return Reader(lambda p: read(p.read_bytes().decode("utf-8", "replace")), [text], (error,), ".json")
    if name == "weights.toml":
        registry = Path(named("stages.registry", "REGISTRY"))
        return Reader(named("stages.registry", "read_registry"), [registry.read_bytes()], (BadInput,), ".toml")
    if name == "contracts":
        read, kind = named("stages.contracts", "read_contract"), named("stages.contracts", "Contract")
        return Reader(lambda p: read(p, kind()), [CONTRACT], (BadInput,), ".toml")
    if name == "onnx":
        return Reader(named("stages.onnx_safety", "inspect"), [onnx_model()], (), ".onnx")
    raise KeyError(name)


NAMES = (
    "settings", "command line", "records", "manifests", "events", "outcomes", "jobs", "locks", "queue", "given poses",
    "stored poses", "hints", "masks", "glb", "bvh", "camera paths", "weights.toml", "contracts", "onnx",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_reader(name: str, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reader = reader_of(name, place)
    chance = random.Random(f"{SEED} {name}")
    path = place / f"input{reader.suffix}"
    deadline = time.monotonic() + 60 * MINUTES
    accepted = refused = count = 0
    with bounded(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for count in range(1, COUNT + 1):
            data = mutate(reader.samples, chance)
            path.write_bytes(data)
            signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S)
            try:
                reader.read(path)
                accepted += 1
            except reader.says_no as error:
                refused += 1
                assert str(error), "it says why"
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt):
                    raise
                signal.setitimer(signal.ITIMER_VIRTUAL, 0)
                pytest.fail(f"{name}, input {count}: {type(error).__name__}: {error}\n{data[:3000]!r}")
            if time.monotonic() > deadline:
                break
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    if "BANMO_FUZZ" in os.environ:
        with capsys.disabled():
            sys.stdout.write(f"\n{name:<14} {count} inputs, {accepted} accepted, {refused} refused\n")
    assert count == COUNT or "BANMO_FUZZ" in os.environ, "the quick mode has time for all of them"


BEYOND = b"9" * 400


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("given poses", b'{"K": ' + b"[" * 3000),
        ("given poses", POSES.replace(b"3.0", BEYOND)),
        ("given poses", POSES.replace(b"50", BEYOND)),
        ("stored poses", POSES.replace(b"3.0", BEYOND)),
        ("hints", b"[[hint]]\nframe = " + BEYOND + b"\nbox = [2, 2, 20, 15]\n"),
        ("hints", b"[[hint]]\nframe = 0\nbox = [2, 2, " + BEYOND + b", 15]\n"),
    ],
)
def test_found_by_fuzzing(name: str, data: bytes, place: Path) -> None:
    """What the long mode has found stays refused in a sentence."""
    reader = reader_of(name, place)
    path = place / f"found{reader.suffix}"
    path.write_bytes(data)
    with pytest.raises(reader.says_no):
        reader.read(path)
