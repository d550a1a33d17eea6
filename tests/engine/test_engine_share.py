"""Pushing, pulling, a shared store, comparing runs. Nothing that arrives is trusted."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from pipeline import Results
from pipeline.remote import Remote, safe
from pipeline.transfer import pull, push
from pipeline.workspace import Workspace
from tests.engine.laboratory import Lab


def another(lab: Lab, name: str = "other") -> Lab:
    """A second machine with the same clips and pipeline."""
    found = Lab(lab.root / name, lab.capture)
    found.root.mkdir()
    shutil.copytree(lab.package, found.package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(lab.clips, found.clips)
    return found


def a_folder_of(lab: Lab, place: Path) -> Path:
    """A published folder's file in a store elsewhere."""
    digest = lab.records()["words/cat"].digest
    return place / "objects" / "words" / digest / "000.txt"


def test_a_finished_workspace_travels_and_is_verified_on_arrival(lab: Lab, tmp_path: Path) -> None:
    lab.run()
    place = tmp_path / "nas" / "cats"
    dry = lab.command("push", str(place), "-n", "--json")
    assert dry.code == 0 and dry.json["folders"] == 8 and not place.exists()
    assert lab.command("push", str(place)).code == 0
    again = lab.command("push", str(place), "--json").json
    assert again["folders"] == 0 and again["present"] == 8 and again["runs"] == []

    other = another(lab)
    assert other.command("pull", str(place)).code == 0
    assert Results(other.workspace).folder("final").digest == lab.digests()["final"], "readable without its videos"
    assert (other.workspace / "latest" / "final" / "final.txt").is_file()
    assert other.command("verify", "--deep").code == 0
    outcome = other.run()
    assert "everything is up to date: 8 results" in outcome.out, "what another machine made is a hit"


def test_what_is_damaged_elsewhere_does_not_arrive(lab: Lab, tmp_path: Path) -> None:
    lab.run("--until", "upper")
    place = tmp_path / "nas"
    lab.command("push", str(place))
    target = a_folder_of(lab, place)
    target.write_text("forged")
    (place / "actions" / "upper" / f"{lab.records()['upper/dog'].key}.json").write_text("{torn")
    other = another(lab)
    outcome = other.command("pull", str(place))
    assert outcome.code == 4 and "words/cat" in outcome.out
    assert "words/cat" not in other.records() and "upper/dog" not in other.records()
    assert other.command("verify", "--deep").code == 0
    target.unlink()
    target.symlink_to("/etc/passwd")
    assert another(lab, "third").command("pull", str(place)).code == 4


def test_names_from_elsewhere_do_not_become_paths(lab: Lab, tmp_path: Path) -> None:
    lab.run("--until", "words")
    place = tmp_path / "nas"
    lab.command("push", str(place))
    for run in (place / "runs").iterdir():
        plan = json.loads((run / "plan.json").read_text())
        first = plan["steps"][0]
        evil = [{**first, "video": "../../../evil"}, {**first, "stage": "../evil"}, {**first, "digest": "../../evil"}]
        plan["steps"] += [*evil, {**first, "key": "../../evil"}, 7, None]
        (run / "plan.json").write_text(json.dumps(plan))
    other = another(lab)
    other.command("pull", str(place))
    assert not [p for p in tmp_path.rglob("*evil*")]
    assert sorted(p.name for p in (other.workspace / "latest" / "videos").iterdir()) == ["cat", "dog"]
    for name in ("../x", "/x", "a//b", "a/./b", "a/../b", "", "a\\b", "a\nb", "a\0b"):
        assert not safe(name)
    assert safe("inner/b ü.bin")


def test_a_cut_push_is_gone_on_with(lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("--until", "words")
    place = tmp_path / "nas"
    remote, workspace = Remote(str(place)), Workspace(lab.workspace)
    real, left = Remote.write, [2]

    def failing(self: Remote, name: str, data: bytes) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        real(self, name, data)

    monkeypatch.setattr(Remote, "write", failing)
    with pytest.raises(KeyboardInterrupt):
        push(workspace, remote)
    monkeypatch.setattr(Remote, "write", real)
    other = another(lab)
    assert other.command("pull", str(place)).code == 2, "no store there yet: its mark comes last"
    assert push(workspace, remote).folders <= 1
    assert other.command("pull", str(place)).code == 0 and len(other.records()) == 2


def test_a_shared_store_saves_the_work(lab: Lab, tmp_path: Path) -> None:
    lab.run()
    place = tmp_path / "nas"
    lab.command("push", str(place))
    other = another(lab)
    shared = ("--store.shared", str(place))
    outcome = other.run(*shared)
    assert outcome.code == 0 and "everything is up to date: 8 results" in outcome.out
    assert other.digests() == lab.digests()
    third = another(lab, "third")
    a_folder_of(lab, place).write_text("forged")
    outcome = third.run(*shared)
    assert outcome.code == 0 and "1 done, 7 up to date" in outcome.out, "made here what is damaged there"
    assert third.digests() == lab.digests()
    shutil.rmtree(place)
    outcome = another(lab, "fourth").run(*shared, "--until", "words")
    assert outcome.code == 0 and "2 done" in outcome.out, "an empty place is no harm"


def test_places_that_cannot_be_are_one_sentence(lab: Lab, tmp_path: Path) -> None:
    lab.run("--until", "words")
    for url in ("nowhere://x/y", str(tmp_path / "clips" / "cat.mp4" / "x")):
        outcome = lab.command("push", url)
        assert outcome.code == 2 and outcome.err.count("\n") == 1, outcome.err
    assert lab.command("pull", str(tmp_path / "nothing")).code == 2


def test_a_bucket(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """An S3-compatible server on this machine."""
    pytest.importorskip("s3fs", reason="the extra `s3` is not installed")
    server_module = pytest.importorskip("moto.server", reason="moto's server is not installed")
    lab.run("--until", "upper")
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    try:
        options = {"key": "k", "secret": "s", "endpoint_url": f"http://{host}:{port}"}
        Remote("s3://cats", options)._fs.mkdir("cats")
        remote = Remote("s3://cats/first", options)
        moved = push(Workspace(lab.workspace), remote)
        assert moved.folders == 4 and not moved.damaged
        other = another(lab)
        workspace = Workspace.open(other.workspace, create=True)
        assert pull(workspace, remote).folders == 4
        assert other.digests() == lab.digests()
        assert other.command("verify", "--deep").code == 0
        name = f"objects/words/{lab.records()['words/cat'].digest}/000.txt"
        remote.write(name, b"forged")
        third = another(lab, "third")
        assert pull(Workspace.open(third.workspace, create=True), remote).damaged == ["words/cat"]

        # From the command line, where the place and the keys come from the environment as everywhere with S3.
        for variable, value in (("ACCESS_KEY_ID", "k"), ("SECRET_ACCESS_KEY", "s"), ("DEFAULT_REGION", "us-east-1")):
            monkeypatch.setenv(f"AWS_{variable}", value)
        monkeypatch.setenv("AWS_ENDPOINT_URL", options["endpoint_url"])
        outcome = lab.command("push", "s3://cats/second", "--json")
        assert outcome.code == 0 and outcome.json["folders"] == 4, outcome.err
        fourth = another(lab, "fourth")
        outcome = fourth.run("--until", "upper", "--store.shared", "s3://cats/second")
        assert outcome.code == 0 and "everything is up to date: 4 results" in outcome.out
        assert fourth.digests() == lab.digests()
        outcome = lab.command("push", "s3://no-such-bucket/x")
        assert outcome.code == 2 and outcome.err.count("\n") == 1, outcome.err
    finally:
        server.stop()


def test_runs_are_compared(lab: Lab) -> None:
    lab.run("--words.count", "2")
    lab.run("--words.count", "4")
    runs = sorted(p.name for p in (lab.workspace / "runs").iterdir())
    lab.command("pin", runs[0], "first")
    outcome = lab.command("compare", "first", "latest")
    assert outcome.code == 0 and "words.count  2 -> 4" in outcome.out
    assert "words/cat  changed" in outcome.out and "count  2 -> 4" in outcome.out
    found = lab.command("compare", runs[0], runs[1], "--json").json
    assert found["settings"] == {"words.count": [2, 4]} and len(found["results"]) == 8
    assert "0 results are the same" not in lab.command("compare", "latest", "latest").out
    assert lab.command("compare", "frist", "latest").err.startswith("banmo: there is no run")
