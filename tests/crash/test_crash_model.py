"""A store against a model of it in memory: whatever is published, damaged, deleted, collected, verified, repaired.

The model knows which folders are whole. The store may forget nothing that is whole and wanted, and must never serve
what is not.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from unittest import mock

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, invariant, rule

from pipeline.action import action
from pipeline.files import unique
from pipeline.ledger import Record
from pipeline.upkeep import collect, find_garbage, verify
from pipeline.workspace import Workspace

EXAMPLES = int(os.environ.get("BANMO_MODEL_EXAMPLES", "40"))
_STAMP = "2026-01-01T00:00:00.000Z"
_OLD = 10 * 86400


class StoreModel(RuleBasedStateMachine):
    """One workspace and what it should hold."""

    published = Bundle("published")
    intact = Bundle("intact")

    def __init__(self) -> None:
        super().__init__()
        self.root = Path(tempfile.mkdtemp(prefix="banmo-model-"))
        self.workspace = Workspace(self.root / "w")
        self.content: dict[str, dict[str, bytes]] = {}
        """Digest -> files, of every folder ever published."""
        self.whole: dict[str, bool] = {}
        """Digest -> whether its folder lies in the store undamaged."""
        self.records: dict[str, str] = {}
        """Key -> digest, of every record that should be there."""
        self.patches = [mock.patch("pipeline.objects.flush"), mock.patch("os.fsync")]
        for patch in self.patches:
            patch.start()

    def teardown(self) -> None:
        """Remove everything."""
        for patch in self.patches:
            patch.stop()
        for folder, _, _ in os.walk(self.root):
            os.chmod(folder, 0o755)
        shutil.rmtree(self.root)

    # ------------------------------------------------------------------ what happens

    @rule(target=published, number=st.integers(0, 3), text=st.sampled_from(["", "a", "bb", "a\n"]))
    def publish(self, number: int, text: str) -> str:
        """An action is made, or made again."""
        self.workspace.ledger.refresh()
        files = {"x.txt": text.encode(), "inner/y.bin": bytes([number]) * 10}
        out = self.workspace.tmp / unique()
        for name, data in files.items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (out / name).write_bytes(data)
        stored = self.workspace.objects.publish("s", out)
        made = action(stage="s", version=1, code="c", settings={"n": number, "t": text}, inputs={})
        self.workspace.ledger.write(
            Record(
                key=made.key,
                stage="s",
                video=None,
                action=made.text,
                modules={},
                digest=stored.digest,
                files=2,
                bytes=stored.bytes,
                seconds=1.0,
                started=_STAMP,
                finished=_STAMP,
                run="model",
            )
        )
        self.content[stored.digest] = files
        self.whole[stored.digest] = True
        self.records[made.key] = stored.digest
        return made.key

    @rule(key=published, kind=st.sampled_from(["flip", "truncate", "remove", "add", "seal", "folder", "link", "swap"]))
    def damage(self, key: str, kind: str) -> None:
        """Something happens to a folder behind the store's back."""
        digest = self.records.get(key)
        if digest is None or not self.whole[digest]:
            return
        folder = self.workspace.objects.path("s", digest)
        for place in (folder, folder / "inner"):
            place.chmod(0o755)
        target = folder / "inner" / "y.bin"
        target.chmod(0o644)
        if kind == "flip":
            target.write_bytes(b"\xff" + target.read_bytes()[1:])
        elif kind == "truncate":
            target.write_bytes(b"")
        elif kind == "remove":
            target.unlink()
        elif kind == "add":
            (folder / "more.txt").write_text("more")
        elif kind == "seal":
            self.workspace.objects.seal_path("s", digest).unlink()
        elif kind == "link":
            target.unlink()
            target.symlink_to("/dev/null")
        elif kind == "swap":
            (folder / "x.txt").chmod(0o644)
            data = (folder / "x.txt").read_bytes()
            (folder / "x.txt").write_bytes(target.read_bytes())
            target.write_bytes(data)
        else:
            shutil.rmtree(folder)
        self.whole[digest] = False

    @rule(key=consumes(published), kind=st.sampled_from(["torn", "gone", "renamed"]))
    def damage_record(self, key: str, kind: str) -> None:
        """A record is lost or torn."""
        path = self.workspace.ledger.path("s", key)
        if key not in self.records or not path.exists():
            return
        if kind == "torn":
            path.write_bytes(path.read_bytes()[:-30])
        elif kind == "gone":
            path.unlink()
        else:
            path.rename(path.with_name("0" * 64 + ".json"))
        del self.records[key]

    @rule(deep=st.booleans(), repair=st.booleans())
    def verify(self, deep: bool, repair: bool) -> None:
        """Damage is named; repair takes it out of the way."""
        self.workspace.ledger.refresh()
        found = verify(self.workspace, deep=deep, repair=repair)
        told = "\n".join(found.faults)
        if deep:
            for digest in set(self.records.values()):
                assert (digest in told) is not self.whole[digest], (digest, told)
        if repair and deep:
            self.workspace.ledger.refresh()
            again = verify(self.workspace, deep=True)
            assert all("missing" in fault for fault in again.faults), again.faults

    @rule()
    def collect(self) -> None:
        """Everything but the wanted keys is old enough to go."""
        self.workspace.ledger.refresh()
        keys = sorted(self.records)
        wanted = set(keys[: len(keys) // 2])
        with mock.patch("time.time", return_value=_now() + _OLD):
            collect(self.workspace, lambda: find_garbage(self.workspace, 0, wanted))
        self.workspace.ledger.refresh()
        for key in set(keys) - wanted:
            del self.records[key]
        kept = set(self.records.values())
        for digest in self.whole:
            if digest not in kept:
                self.whole[digest] = False
                assert not self.workspace.objects.path("s", digest).exists()

    @rule()
    def forget_the_memos(self) -> None:
        """The cache is removed."""
        shutil.rmtree(self.workspace.cache, ignore_errors=True)

    # ------------------------------------------------------------------ what always holds

    @invariant()
    def what_is_whole_is_served_and_nothing_else(self) -> None:
        """A hit is a record with a sound folder of the right bytes."""
        for key, digest in self.records.items():
            record = self.workspace.ledger.find("s", key)
            assert record is not None and record.digest == digest
            assert self.workspace.objects.sound("s", digest) is self.whole[digest]
            if self.whole[digest]:
                folder = self.workspace.objects.path("s", digest)
                assert {n: (folder / n).read_bytes() for n in self.content[digest]} == self.content[digest]


def _now() -> float:
    import time

    return time.time()


StoreModel.TestCase.settings = settings(
    max_examples=EXAMPLES,
    stateful_step_count=20,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
TestStoreModel = StoreModel.TestCase
