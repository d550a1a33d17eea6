"""videos -> words"""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline import BadInput, Given, InputFile, Run, Source, Video, stage


@dataclass(frozen=True)
class WordSettings:
    """Settings of `words`."""

    count: int = 3
    """How many files to make."""
    delay_s: float = 0.0
    """Time each one takes."""
    table: InputFile = InputFile("")  # noqa: RUF009  (immutable)
    """Some file that matters by its content."""
    trouble: str = ""
    """What goes wrong."""


@stage(per=Video, version=1, given=(".hint.txt", ".extra"))
def words(video: Source, given: Given, settings: WordSettings, out: Path, run: Run) -> None:
    """Words of a video."""
    sys.stdout.write("garbage on standard output \x00\xff {not json\n")
    if video.is_folder:
        text = " ".join(p.name for p in sorted(video.path.iterdir()))
    else:
        text = video.path.read_text(encoding="utf-8", errors="replace")
    if settings.trouble == "bad_input" and "cat" in (run.video or ""):
        raise BadInput("it has no words", where=video.path, hint="write some")
    if settings.trouble == "fail" and "cat" in (run.video or ""):
        raise RuntimeError("words failed\non purpose")
    if settings.trouble == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if settings.trouble == "nothing":
        return
    if settings.trouble == "link":
        (out / "link").symlink_to("/etc/passwd")
    hint = given.get(".hint.txt")
    table = Path(settings.table).read_text() if settings.table else ""
    for i in run.progress(range(settings.count)):
        time.sleep(settings.delay_s)
        (out / f"{i:03d}.txt").write_text(f"{i} {text} {hint.read_text() if hint else ''}{table}")
    run.metric("count", settings.count)
    if settings.count > 5:
        run.warn("so many words")


@words.check
def _check(out: Path, settings: WordSettings) -> None:
    if settings.trouble == "check":
        raise ValueError("the check refuses")


@words.estimate
def _estimate(video: Source, settings: WordSettings) -> int:
    return 10**18 if settings.trouble == "huge" else 1000 * settings.count
