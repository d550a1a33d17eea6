"""What went wrong, where, and what to do about it; and the exit codes of every command.

An error that a person is to read is a :class:`PipelineError`: one sentence made of `where`, `what` and `hint`.
Anything else that reaches the top is a fault of the program and shows its traceback in the log.
"""

from __future__ import annotations

import difflib
import errno
from collections.abc import Iterable
from enum import IntEnum


class ExitCode(IntEnum):
    """What a command's exit status means."""

    DONE = 0
    FAILED = 1
    """An action failed; the others are kept."""
    USAGE = 2
    """The command line, a setting or an input is at fault."""
    DECISION = 3
    """Only code changed and redoing is expensive: ``--redo`` or ``bless``."""
    DAMAGED = 4
    """``verify`` found damage."""
    PENDING = 10
    """``run --check``: there is work to do."""
    INTERRUPTED = 75
    """Stopped from outside; the same command resumes."""
    STOPPED = 130
    """Stopped by Ctrl-C; the same command resumes."""


def printable(text: str) -> str:
    """`text` on one line, with control characters and undecodable bytes shown as escapes."""
    text = " ".join(text.split(" "))
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


class PipelineError(Exception):
    """An error for people: what happened, where, and what to do."""

    exit_code = ExitCode.FAILED

    def __init__(self, what: str, *, where: object = "", hint: str = "") -> None:
        self.what, self.where, self.hint = str(what), str(where), str(hint)
        super().__init__(what)

    def __str__(self) -> str:
        what = printable(self.what.strip().rstrip("."))
        where = printable(self.where.strip())
        hint = printable(self.hint.strip())
        text = f"{where}: {what}" if where and where not in what else what
        return f"{text}; {hint}" if hint else text

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.what, self.where, self.hint)


def _rebuild(kind: type[PipelineError], what: str, where: str, hint: str) -> PipelineError:
    return kind(what, where=where, hint=hint)


class BadInput(PipelineError):
    """The user's input (a video, a file beside it, a setting, the command line) is at fault. Exit code 2."""

    exit_code = ExitCode.USAGE


class DecisionNeeded(PipelineError):
    """Only code changed and the earlier result was expensive: the user decides. Exit code 3."""

    exit_code = ExitCode.DECISION


class StageError(PipelineError):
    """A stage broke its contract: it wrote nothing, or something that cannot be kept."""


class Interrupted(Exception):
    """A stage stopped because it was asked to; what it checkpointed is kept."""


FULL = (errno.ENOSPC, errno.EDQUOT)
"""Numbers of the system's errors by which it says that nothing more can be written."""


FULL_STATUS = 28
"""Exit status of a worker that could not even write how it ended."""


def disk_full(root: object) -> BadInput:
    """What to say to people when the disk of the workspace `root` is full."""
    return BadInput("the disk is full", where=root, hint="free some space and run again")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A hint that names the nearest known words, or lists them all when none is near."""
    words = sorted(set(known))
    near = difflib.get_close_matches(word, words, n=2, cutoff=0.6)
    if not near:
        near_lower = {w.lower(): w for w in words}
        near = [near_lower[w] for w in difflib.get_close_matches(word.lower(), near_lower, n=2, cutoff=0.6)]
    if near:
        return f"did you mean {' or '.join(near)}?"
    return f"known: {', '.join(words)}" if words else ""
