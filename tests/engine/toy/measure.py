"""words -> measure"""

from __future__ import annotations

from pathlib import Path

from pipeline import Folder, Run, Video, stage


@stage(per=Video)
def measure(words: Folder, out: Path, run: Run) -> None:
    """Lengths of words."""
    sizes = [str(len(p.read_text())) for p in sorted(words.path.iterdir())]
    (out / "sizes.txt").write_text("\n".join(sizes))
