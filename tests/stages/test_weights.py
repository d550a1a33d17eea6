"""weights: the registry, downloads from a server that is slow, breaks off, lies or is away, the command."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from pipeline import BadInput
from pipeline.cli import main
from stages import registry
from stages.download import fetch
from tests.stages.onnx_models import mask_model

DATA = np.random.default_rng(0).bytes(1_000_000)
SHA256 = hashlib.sha256(DATA).hexdigest()


class Server:
    """A file on a local server; `cut_after` bytes the first answers break off, `pause_s` lies between blocks."""

    def __init__(self, data: bytes = DATA) -> None:
        self.data, self.status, self.location = data, 200, ""
        self.cut_after: list[int] = []
        self.resumes, self.pause_s, self.tells_length = True, 0.0, True
        self.ranges: list[str | None] = []
        self.url = ""

    def answer(self, handler: BaseHTTPRequestHandler) -> None:
        asked = handler.headers.get("Range")
        self.ranges.append(asked)
        if self.status != 200:
            handler.send_response(self.status)
            if self.location:
                handler.send_header("Location", self.location)
            handler.end_headers()
            return
        start = int(asked.removeprefix("bytes=").removesuffix("-")) if asked and self.resumes else 0
        if start >= len(self.data):
            handler.send_response(416)
            handler.end_headers()
            return
        body = self.data[start:]
        handler.send_response(206 if start else 200)
        if start:
            handler.send_header("Content-Range", f"bytes {start}-{len(self.data) - 1}/{len(self.data)}")
        if self.tells_length:
            handler.send_header("Content-Length", str(len(body)))
        handler.end_headers()
        if self.cut_after:
            handler.wfile.write(body[: self.cut_after.pop(0)])
            handler.wfile.flush()
            handler.connection.close()
            return
        for at in range(0, len(body), 200_000):
            handler.wfile.write(body[at : at + 200_000])
            time.sleep(self.pause_s)


@contextmanager
def serving(server: Server) -> Iterator[Server]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            server.answer(self)

        def log_message(self, format: str, *args: object) -> None:
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    server.url = f"http://127.0.0.1:{http.server_port}/model.onnx"
    try:
        yield server
    finally:
        http.shutdown()
        http.server_close()


def bring(server: Server, target: Path, digest: str = SHA256, **more: object) -> None:
    fetch(server.url, target, **{"kind": "sha256", "digest": digest, "pause_s": 0.0, "timeout_s": 5.0, **more})  # type: ignore[arg-type]


def test_a_whole_file_arrives_and_progress_is_told(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    with serving(Server()) as server:
        bring(server, tmp_path / "a" / "m.onnx", progress=lambda done, total: told.append((done, total)))
    assert (tmp_path / "a" / "m.onnx").read_bytes() == DATA
    assert told[-1] == (len(DATA), len(DATA)) and [d for d, _ in told] == sorted(d for d, _ in told)
    assert list((tmp_path / "a").iterdir()) == [tmp_path / "a" / "m.onnx"]


def test_a_broken_connection_is_resumed_within_one_call(tmp_path: Path) -> None:
    server = Server()
    server.cut_after = [300_000, 250_000]
    with serving(server):
        bring(server, tmp_path / "m.onnx", size=len(DATA))
    assert (tmp_path / "m.onnx").read_bytes() == DATA
    starts = [int(r.removeprefix("bytes=").removesuffix("-")) for r in server.ranges if r]
    assert server.ranges[0] is None and len(starts) == 2 and 0 < starts[0] <= 300_000 and starts[0] < starts[1]


def test_what_came_is_kept_for_the_next_call(tmp_path: Path) -> None:
    server = Server()
    server.cut_after = [400_000]
    with serving(server):
        with pytest.raises(BadInput, match=r"goes on after 0\.4 MB"):
            bring(server, tmp_path / "m.onnx", attempts=1)
        assert not (tmp_path / "m.onnx").exists() and (tmp_path / "m.onnx.part").stat().st_size == 400_000
        bring(server, tmp_path / "m.onnx")
    assert server.ranges == [None, "bytes=400000-"]
    assert (tmp_path / "m.onnx").read_bytes() == DATA


@pytest.mark.parametrize("how", ["no ranges", "shorter now"])
def test_a_server_that_cannot_resume_starts_again(tmp_path: Path, how: str) -> None:
    server = Server()
    server.resumes = how != "no ranges"
    (tmp_path / "m.onnx.part").write_bytes(b"x" * (500_000 if how == "no ranges" else 1_500_000))
    with serving(server):
        bring(server, tmp_path / "m.onnx")
    assert (tmp_path / "m.onnx").read_bytes() == DATA


def test_a_slow_server_is_waited_for_a_silent_one_is_not(tmp_path: Path) -> None:
    server = Server()
    server.pause_s = 0.1
    with serving(server):
        bring(server, tmp_path / "m.onnx", timeout_s=2.0)
        assert (tmp_path / "m.onnx").read_bytes() == DATA
        server.pause_s = 1.5
        with pytest.raises(BadInput, match=r"connection breaks|cannot be reached"):
            bring(server, tmp_path / "n.onnx", timeout_s=0.3, attempts=1)


def test_another_file_than_the_one_expected_is_not_kept(tmp_path: Path) -> None:
    with serving(Server(DATA[:-1] + b"!")) as server, pytest.raises(BadInput, match="not the file expected") as caught:
        bring(server, tmp_path / "m.onnx", size=len(DATA))
    assert "nothing of it was kept" in str(caught.value)
    assert list(tmp_path.iterdir()) == []
    with serving(Server()) as server:
        bring(server, tmp_path / "m.onnx", kind="md5", digest=hashlib.md5(DATA, usedforsecurity=False).hexdigest())
    assert (tmp_path / "m.onnx").read_bytes() == DATA


@pytest.mark.parametrize("tells", [True, False])
def test_more_than_expected_is_refused_before_it_fills_the_disk(tmp_path: Path, tells: bool) -> None:
    server = Server()
    server.tells_length = tells
    with serving(server), pytest.raises(BadInput, match=r"offers 1,000,000 bytes|sends more than the 600,000 bytes"):
        bring(server, tmp_path / "m.onnx", size=600_000)
    assert not (tmp_path / "m.onnx").exists()
    assert not (tmp_path / "m.onnx.part").exists() or (tmp_path / "m.onnx.part").stat().st_size <= 600_000


@pytest.mark.parametrize(("status", "word"), [(404, "answers 404"), (403, "answers 403"), (503, "it answers 503")])
def test_refusals_of_the_server(tmp_path: Path, status: int, word: str) -> None:
    server = Server()
    server.status = status
    with serving(server), pytest.raises(BadInput, match=word):
        bring(server, tmp_path / "m.onnx", attempts=2)
    assert len(server.ranges) == (2 if status == 503 else 1), "only what may pass is tried again"
    assert list(tmp_path.iterdir()) == []


def test_no_network(tmp_path: Path) -> None:
    with serving(Server()) as server:
        gone = server.url
    with pytest.raises(BadInput, match="is this machine online"):
        fetch(gone, tmp_path / "m.onnx", kind="sha256", digest=SHA256, attempts=2, pause_s=0.0)


def test_only_encrypted_addresses_also_after_a_redirect(tmp_path: Path) -> None:
    for url in ("http://example.org/m.onnx", "file:///etc/passwd", "ftp://example.org/m", "nonsense"):
        with pytest.raises(BadInput, match="https only"):
            fetch(url, tmp_path / "m.onnx", kind="sha256", digest=SHA256)
    for location in ("http://example.org/m.onnx", "file:///etc/passwd"):
        server = Server()
        server.status, server.location = 302, location
        with serving(server), pytest.raises(BadInput, match=r"https only|answers 302"):
            bring(server, tmp_path / "m.onnx", attempts=1)


# --------------------------------------------------------------------------------------------- the registry


def test_the_registry_is_sound_and_its_contracts_are_read() -> None:
    from stages.contracts import PICTURE, contract_of

    known = registry.read_registry()
    assert {e.slot for e in known.values()} == {"masks", "flow", "features"}
    for entry in known.values():
        contract = contract_of(entry.contract, PICTURE, entry.name)
        assert entry.url.startswith("https://") and entry.licence and contract.size is not None
        assert (contract.kind == "tokens") == (entry.slot == "features")
    assert known["raft"].bytes == 64_119_337 and known["raft"].contract["output"] == -1


FINE = 'slot = "masks"\nsummary = "s"\nurl = "https://x"\nlicence = "l"\nsource = "s"\n'


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[a]\n" + FINE, "lacks a digest"),
        ("[a]\n" + FINE + 'md5 = "xyz"', "lacks a digest"),
        ("[a]\n" + FINE.replace("masks", "mask"), "none of masks"),
        ("[a]\n" + FINE + "sha = 1", "unknown key 'sha'"),
        ("[a]\n" + FINE.replace('licence = "l"\n', ""), "lacks licence"),
        ("['../a']\n" + FINE, "named in small letters"),
        ("a = 1", "must be a table"),
        ("[a]\n" + FINE + f"md5 = '{'0' * 32}'\nbytes = -1", "bytes is a number"),
        ("[a", "TOML"),
    ],
)
def test_faults_of_a_registry(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "weights.toml"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"weights\.toml") as caught:
        registry.read_registry(path)
    assert word in str(caught.value)


def test_where_networks_lie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BANMO_WEIGHTS", str(tmp_path / "w"))
    assert registry.home() == tmp_path / "w" and registry.here() == {}
    monkeypatch.delenv("BANMO_WEIGHTS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "c"))
    assert registry.home() == tmp_path / "c" / "banmo" / "weights"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert registry.home() == tmp_path / ".cache" / "banmo" / "weights"


def test_a_folder_is_made_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BANMO_WEIGHTS", str(tmp_path))

    def refuse(folder: Path) -> None:
        raise BadInput("no good")

    registry.keep("mine", lambda target: target.write_bytes(b"old") and None, {}, {"licence": 'a "b"\n\\c'})
    with pytest.raises(BadInput, match="no good"):
        registry.keep("mine", lambda target: target.write_bytes(b"new") and None, {}, {}, refuse)
    assert (tmp_path / "mine" / "network.onnx").read_bytes() == b"old"
    assert registry.about(tmp_path / "mine") == {"licence": 'a "b" \\c'}
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]
    for name in ("../up", "UP", "", ".hidden", "a/b"):
        with pytest.raises(BadInput, match="cannot be a name"):
            registry.keep(name, lambda target: None, {}, {})
        assert registry.find(name) is None
    assert registry.find("mine") == str(tmp_path / "mine") and registry.find("nobody") is None
    with pytest.raises(BadInput, match="banmo weights get raft"):
        registry.find("raft")


# --------------------------------------------------------------------------------------------- the command


def test_add_list_and_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("BANMO_WEIGHTS", str(tmp_path / "w"))
    monkeypatch.chdir(tmp_path)
    model = mask_model(tmp_path / "mine.onnx")
    (tmp_path / "mine.toml").write_text("size = [64, 64]\n")
    command = ["weights", "add", str(model), "--slot", "masks", "--contract", str(tmp_path / "mine.toml")]
    assert main([*command, "--licence", "my own"]) == 0
    assert '[masks] network = "mine"' in capsys.readouterr().out
    assert main(["weights", "list"]) == 0
    shown = capsys.readouterr().out
    assert "my own" in shown and "added by you" in shown and "BSD-3-Clause" in shown
    assert main(["weights", "check"]) == 0
    assert "takes 64x64" in (line := capsys.readouterr().out) and "on cpu" in line
    with (tmp_path / "w" / "mine" / "network.onnx").open("ab") as file:
        file.write(b"\x00")
    assert main(["weights", "check", "mine"]) == 1
    assert "has changed since it came" in capsys.readouterr().out
    assert main(["weights", "check", str(model), "--slot", "flow"]) == 1
    assert "takes 1 inputs, 2 expected" in capsys.readouterr().out
    for wrong in (["add", str(model)], ["get"], ["get", "nobody"], ["check", "nobody"], ["check", str(model)]):
        assert main(["weights", *wrong]) == 2
    assert main(["weights", "add", str(model), "--slot", "masks", "--name", "raft"]) == 2
    assert not (tmp_path / "workspace").exists(), "it needs no workspace and makes none"


def test_get(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("BANMO_WEIGHTS", str(tmp_path / "w"))
    model = mask_model(tmp_path / "m.onnx").read_bytes()
    entry = registry.Entry(
        "toy", "masks", "a toy", "https://x", "MIT", "us", "sha256", hashlib.sha256(model).hexdigest()
    )
    broken = registry.Entry("bad", "flow", "a toy", "https://x", "MIT", "us", "sha256", entry.digest)
    monkeypatch.setattr(registry, "read_registry", lambda: {"toy": entry, "bad": broken})
    with serving(Server(model)) as server:
        assert main(["weights", "get", "toy", "--from", server.url]) == 0
        shown = capsys.readouterr().out
        assert shown.index("licence MIT") < shown.index("here:")
        assert main(["weights", "get", "toy", "--from", server.url]) == 0
        assert "is here already" in capsys.readouterr().out and len(server.ranges) == 1
        assert main(["weights", "get", "bad", "--from", server.url]) == 2, "the right bytes, but no flow network"
    assert "takes 1 inputs, 2 expected" in capsys.readouterr().err
    assert sorted(registry.here()) == ["toy"]
    assert main(["weights", "check", "toy"]) == 0


def test_a_setting_takes_a_name_where_no_such_file_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipeline.definition import Definition, StageInfo
    from pipeline.settings import resolve

    monkeypatch.setenv("BANMO_WEIGHTS", str(tmp_path / "w"))
    monkeypatch.chdir(tmp_path)
    registry.keep("mine", lambda target: target.write_bytes(b"x") and None, {}, {})
    fields = ({"name": "network", "type": {"kind": "file"}, "default": "", "help": ""},)
    stages = {"masks": StageInfo("masks", "stages.masks:masks", None, fields=fields)}
    definition = Definition(tmp_path, stages, {}, {}, None, ("masks",), "stages.registry:find")

    def network(word: str) -> str:
        return str(resolve(definition, None, [("masks.network", word)]).values["masks"]["network"])

    assert network("mine") == str(tmp_path / "w" / "mine")
    assert network("unheard-of") == str(tmp_path / "unheard-of") and network("") == ""
    (tmp_path / "mine").write_bytes(b"a file of that name comes first")
    assert network("mine") == str(tmp_path / "mine")
    with pytest.raises(BadInput, match="banmo weights get u2netp"):
        network("u2netp")
