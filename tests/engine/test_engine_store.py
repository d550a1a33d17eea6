"""The store of folders and the ledger: what is published stays whole, what is damaged is never served."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import StageError
from pipeline.objects import Objects
from tests.engine.laboratory import Lab


def store(root: Path) -> Objects:
    return Objects(root / "objects", seen=root / "seen", tmp=root / "tmp")


def scratch(root: Path, name: str = "scratch", text: str = "hello") -> Path:
    folder = root / name
    (folder / "inner dir").mkdir(parents=True)
    (folder / "empty").mkdir()
    (folder / "a.txt").write_text(text)
    (folder / "inner dir" / "b ü.bin").write_bytes(bytes(range(256)))
    return folder


def test_published_folder_can_be_checked_with_coreutils(tmp_path: Path) -> None:
    stored = store(tmp_path).publish("masks", scratch(tmp_path))
    seal = stored.path.with_name(stored.path.name + ".sha256")
    printed = subprocess.run(["sha256sum", str(seal)], capture_output=True, text=True, check=True).stdout
    assert printed.split()[0] == stored.path.name == stored.digest
    check = subprocess.run(["sha256sum", "-c", str(seal)], cwd=stored.path, capture_output=True, text=True)
    assert check.returncode == 0 and check.stdout.count("OK") == 2
    assert stored.files == 2 and stored.bytes == 5 + 256
    assert not (stored.path / "empty").exists()
    assert stored.path.stat().st_mode & 0o222 == 0
    assert (stored.path / "a.txt").stat().st_mode & 0o222 == 0


def test_the_same_content_is_stored_once(tmp_path: Path) -> None:
    objects = store(tmp_path)
    first = objects.publish("masks", scratch(tmp_path, "one"))
    second = objects.publish("masks", scratch(tmp_path, "two"))
    other = objects.publish("masks", scratch(tmp_path, "three", "other"))
    assert first == second and other.digest != first.digest
    assert not (tmp_path / "two").exists()
    assert len(objects.everything()) == 2


def test_publishing_heals_a_damaged_folder_of_the_same_name(tmp_path: Path) -> None:
    objects = store(tmp_path)
    first = objects.publish("masks", scratch(tmp_path, "one"))
    (first.path / "a.txt").chmod(0o644)
    (first.path / "a.txt").write_text("hELLo")
    objects.publish("masks", scratch(tmp_path, "two"))
    assert objects.deep_check("masks", first.digest) == []
    assert list((tmp_path / "tmp").glob("damaged-masks-*")), "what was damaged is moved aside, not deleted"


@pytest.mark.parametrize("what", ["link", "fifo", "newline", "backslash", "nothing"])
def test_what_a_stage_may_not_leave_behind(tmp_path: Path, what: str) -> None:
    folder = tmp_path / "scratch"
    folder.mkdir()
    if what == "link":
        (folder / "x").symlink_to("/etc/passwd")
    elif what == "fifo":
        os.mkfifo(folder / "x")
    elif what == "newline":
        (folder / "a\nb").write_text("x")
    elif what == "backslash":
        (folder / "a\\b").write_text("x")
    with pytest.raises(StageError):
        store(tmp_path).publish("masks", folder)
    assert store(tmp_path).everything() == []


def _writable(path: Path) -> Path:
    path.chmod(0o644)
    path.parent.chmod(0o755)
    return path


def flip(folder: Path) -> str:
    path = _writable(folder / "000.txt")
    data = bytearray(path.read_bytes())
    data[0] ^= 1
    path.write_bytes(data)
    return "000.txt: its content was changed"


def truncate(folder: Path) -> str:
    path = _writable(folder / "001.txt")
    os.truncate(path, 1)
    return "001.txt: its content was changed"


def delete(folder: Path) -> str:
    _writable(folder / "002.txt").unlink()
    return "002.txt: missing"


def add(folder: Path) -> str:
    folder.chmod(0o755)
    (folder / "stray.txt").write_text("x")
    return "stray.txt: does not belong here"


def swap_files(folder: Path) -> str:
    one, two = _writable(folder / "000.txt"), _writable(folder / "001.txt")
    one.rename(folder / "t")
    two.rename(one)
    (folder / "t").rename(two)
    return "000.txt: its content was changed"


def swap_folders(folder: Path) -> str:
    other = next(p for p in folder.parent.iterdir() if p.is_dir() and p != folder)
    for path in (folder, other):
        path.chmod(0o755)
    folder.rename(folder.parent / "t")
    other.rename(folder)
    (folder.parent / "t").rename(other)
    return "its content was changed"


def remove_folder(folder: Path) -> str:
    folder.chmod(0o755)
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    return f"{folder.name}: missing"


def replace_by_link(folder: Path) -> str:
    folder.chmod(0o755)
    target = folder.parent.parent / "elsewhere"
    folder.rename(target)
    folder.symlink_to(target)
    return f"{folder.name}: missing"


def damage_seal(folder: Path) -> str:
    seal = folder.with_name(folder.name + ".sha256")
    seal.write_text(seal.read_text().replace("0", "1", 1))
    return ".sha256: its content was changed"


def remove_seal(folder: Path) -> str:
    folder.with_name(folder.name + ".sha256").unlink()
    return ".sha256: missing"


DAMAGE = [
    flip,
    truncate,
    delete,
    add,
    swap_files,
    swap_folders,
    remove_folder,
    replace_by_link,
    damage_seal,
    remove_seal,
]


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda f: f.__name__)
def test_damage_is_named_by_verify_and_healed_by_run(lab: Lab, damage: Callable[[Path], str]) -> None:
    lab.run("--until", "words")
    before = lab.digests()
    named = damage(lab.object_path("words/cat"))
    found = lab.command("verify", "--deep")
    assert found.code == 4
    assert named in found.out
    assert lab.pending("--until", "words")["words/cat"] == ["damaged"], "damage is never served as a hit"
    assert lab.run("--until", "words").code == 0
    assert lab.digests() == before
    clean = lab.command("verify", "--deep")
    assert clean.code == 0, clean.out


def test_run_notices_a_flipped_byte_by_itself(lab: Lab) -> None:
    lab.run("--until", "words")
    flip(lab.object_path("words/cat"))
    assert lab.pending("--until", "words") == {"words/cat": ["damaged"]}


def test_a_flip_behind_the_back_of_all_times_is_found_by_deep_and_then_by_run(lab: Lab) -> None:
    lab.run("--until", "words")
    flip(lab.object_path("words/cat"))
    digest = lab.records()["words/cat"].digest
    objects = store(lab.workspace)
    objects._seen = lab.workspace / "cache" / "seen"
    objects._remember("words", digest)  # as if the disk itself had changed the byte
    assert lab.command("verify").code == 0, "counts and sizes are right"
    assert lab.pending("--until", "words") == {}
    assert lab.command("verify", "--sample", "100%").code == 4
    assert lab.pending("--until", "words") == {"words/cat": ["damaged"]}


def test_verify_repair_and_json(lab: Lab) -> None:
    lab.run("--until", "words")
    flip(lab.object_path("words/cat"))
    found = lab.command("verify", "--deep", "--repair", "--json")
    assert found.code == 4
    assert len(found.json["repaired"]) == 1 and found.json["hashed"] == 2
    assert lab.command("verify", "--deep").code == 4, "its record names a folder that is gone"
    assert lab.run("--until", "words").code == 0
    assert lab.command("verify", "--deep").code == 0
    assert lab.command("verify", "--sample", "0%").code == 2


@pytest.mark.parametrize("torn", ["", "{", '{"format": 1}', "[]", '"x"', "{}" * 3, "\x00", "[" * 100000])
def test_a_torn_record_is_no_record(lab: Lab, torn: str) -> None:
    lab.run("--until", "words")
    record = lab.records()["words/cat"]
    path = lab.workspace / "actions" / "words" / f"{record.key}.json"
    path.write_text(torn)
    assert "words/cat" in lab.pending("--until", "words")
    assert lab.command("verify").code == 4
    assert lab.run("--until", "words").code == 0
    assert lab.command("verify", "--deep").code == 0


def test_a_forged_record_does_not_fool_anybody(lab: Lab) -> None:
    lab.run("--until", "words")
    records = lab.records()
    cat, dog = records["words/cat"], records["words/dog"]
    folder = lab.workspace / "actions" / "words"
    (folder / f"{cat.key}.json").write_text((folder / f"{dog.key}.json").read_text())
    assert "words/cat" in lab.pending("--until", "words"), "a record's text must hash to its name"
    value = json.loads((folder / f"{dog.key}.json").read_text())
    value["digest"] = "../../../etc"
    (folder / f"{dog.key}.json").write_text(json.dumps(value))
    assert "words/dog" in lab.pending("--until", "words")


def test_memos_may_be_removed_at_any_time(lab: Lab) -> None:
    import shutil

    lab.run()
    shutil.rmtree(lab.workspace / "cache")
    shutil.rmtree(lab.workspace / "leases")
    assert lab.pending() == {}
