"""words -> upper"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline import Folder, Run, Video, stage
from toy.shouting import shout


@dataclass(frozen=True)
class UpperSettings:
    """Settings of `upper`."""

    mark: str = "!"
    """What to put at the end."""


@stage(per=Video)
def upper(words: Folder, settings: UpperSettings, out: Path, run: Run) -> None:
    """Loud words."""
    (out / "inner").mkdir()
    for path in run.progress(sorted(words.path.iterdir())):
        (out / "inner" / path.name).write_text(shout(path.read_text(), settings.mark))


@upper.sheet
def _sheet(out: Path, words: Folder, picture: Path) -> None:
    picture.write_bytes(b"\x89PNG " + str(len(list((out / "inner").iterdir()))).encode())
