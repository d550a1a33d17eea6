"""merge -> final"""

from __future__ import annotations

from pathlib import Path

from pipeline import Folder, Scene, stage


@stage(per=Scene)
def final(merge: Folder, out: Path) -> None:
    """The end."""
    (out / "parts").mkdir()
    for path in sorted(merge.path.iterdir()):
        (out / "parts" / path.name).write_bytes(path.read_bytes())
    (out / "final.txt").write_text(str(sorted(p.name for p in merge.path.iterdir())))
