"""Fetch one large file: resumed where it was cut off, checked against its digest, moved into place in one step.

Nothing is written to the target before the whole file is there and its digest is right. What has come so far lies in
``<target>.part``; a server that cannot resume, or whose file has changed, makes it start again.
"""

from __future__ import annotations

import hashlib
import http.client
import os
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

from pipeline import BadInput

CHUNK = 1 << 18
MAX_BYTES = 2_000_000_000
TIMEOUT_S = 30.0
ATTEMPTS = 5
"""Connections made before giving up; what came stays, and the next call goes on from there."""
_LOCAL = ("localhost", "127.0.0.1", "::1")
Progress = Callable[[int, int], None]


class _Again(Exception):
    """The connection broke; what has come so far is good."""


def digest_of(path: Path, kind: str) -> str:
    """Digest of a file in hex; `kind` is "sha256" or "md5"."""
    found = hashlib.new(kind, usedforsecurity=False)
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            found.update(block)
    return found.hexdigest()


def fetch(
    url: str,
    target: Path,
    *,
    kind: str,
    digest: str,
    size: int = 0,
    progress: Progress = lambda done, total: None,
    attempts: int = ATTEMPTS,
    timeout_s: float = TIMEOUT_S,
    pause_s: float = 1.0,
) -> None:
    """Bring the file at `url` to `target`; its digest (`kind` "sha256" or "md5") must be `digest`.

    `size` is its length in bytes, 0 where that is not known. Raises BadInput with one sentence when there is no
    network, the server refuses, or the file is not the one expected (which is then removed).
    """
    _allowed(url)
    part = target.with_name(target.name + ".part")
    target.parent.mkdir(parents=True, exist_ok=True)
    if part.exists() and part.stat().st_size > (size or MAX_BYTES):
        part.unlink()
    for attempt in range(attempts):
        try:
            _go_on(url, part, size, progress, timeout_s)
            break
        except _Again as error:
            if attempt + 1 == attempts:
                came = part.stat().st_size if part.exists() else 0
                raise BadInput(
                    f"{_host(url)} cannot be reached, or the connection breaks ({error})",
                    hint=f"call the same command again: it goes on after {came / 1e6:.1f} MB" if came else
                    "is this machine online? a file fetched elsewhere goes in by `banmo weights add FILE --name NAME`",
                ) from error  # fmt: skip
            time.sleep(pause_s * 2**attempt)
    found = digest_of(part, kind)
    if found != digest:
        part.unlink()
        raise BadInput(
            f"what {_host(url)} sent is not the file expected ({kind} {found[:12]}..., not {digest[:12]}...)",
            hint="nothing of it was kept",
        )
    with part.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, target)


def _go_on(url: str, part: Path, size: int, progress: Progress, timeout_s: float) -> None:
    """Ask for what is missing and add it to `part`; raises _Again when the connection breaks."""
    held = part.stat().st_size if part.exists() else 0
    if size and held == size:
        return
    request = urllib.request.Request(url, headers={"User-Agent": "banmo-pipeline", "Accept-Encoding": "identity"})
    if held:
        request.add_header("Range", f"bytes={held}-")
    try:
        with closing(_OPENER.open(request, timeout=timeout_s)) as answer:
            if held and not _goes_on_at(answer, held):
                held = 0
            total = held + int(answer.headers.get("Content-Length") or 0)
            if size and total != size and answer.headers.get("Content-Length"):
                raise BadInput(f"{_host(url)} offers {total:,} bytes, {size:,} expected", where=url)
            whole = size or total
            limit = size or MAX_BYTES
            with part.open("ab" if held else "wb") as file:
                done = held
                for block in _blocks(answer):
                    done += len(block)
                    if done > limit:
                        raise BadInput(f"{_host(url)} sends more than the {limit:,} bytes expected", where=url)
                    file.write(block)
                    progress(done, whole)
            if whole and done < whole:
                raise _Again(f"cut off after {done:,} of {whole:,} bytes")
    except urllib.error.HTTPError as error:
        if error.code == 416 and held:  # the part is no beginning of what is there now
            part.unlink()
            raise _Again("the file there has changed") from error
        if error.code >= 500 or error.code == 429:
            raise _Again(f"it answers {error.code}") from error
        raise BadInput(f"{_host(url)} answers {error.code} {error.reason}", where=url) from error
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
        reason = getattr(error, "reason", "") or str(error) or type(error).__name__
        raise _Again(str(reason)) from error
    except OSError as error:
        raise BadInput(f"{part.name} cannot be written ({error.strerror})", where=part.parent) from error


def _blocks(answer: http.client.HTTPResponse) -> Iterator[bytes]:
    while block := answer.read(CHUNK):
        yield block


def _goes_on_at(answer: http.client.HTTPResponse, held: int) -> bool:
    """Whether the answer starts where the part ends; a plain 200 sends the whole file again."""
    return answer.status == 206 and answer.headers.get("Content-Range", "").startswith(f"bytes {held}-")


def _allowed(url: str) -> None:
    """Encrypted connections only; plain ones to this very machine (tests, mirrors behind a tunnel)."""
    try:
        parts = urlsplit(url)
        fine = parts.scheme == "https" or (parts.scheme == "http" and parts.hostname in _LOCAL)
    except ValueError:
        fine = False
    if not fine:
        raise BadInput("networks are fetched over https only", where=url)


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to other https addresses only."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):  # type: ignore[no-untyped-def]
        _allowed(newurl)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


_OPENER = urllib.request.build_opener(_Redirects)


def _host(url: str) -> str:
    return urlsplit(url).netloc
